#!/usr/bin/env python
"""Counts the ticks of healthy recorded episodes in which the guard finds a fault: there should be none.

    scripts/false_faults.py --known=data/bag --held_out data/bag_held_out data/bag_lifts --output=results/guard/bag.json

The guard is made of one dataset (lerobot-edit-dataset merges several), and looks on while the others are replayed. A
filter that knows what a guard knows may be given instead: --filter=<filter>.
"""

import argparse
from itertools import chain
from pathlib import Path

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.guard_study import alarms, recorded
from lerobot_latentsafe.guarding import new_guard
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter

GUARD = LawOptions(name="guard")


def guard_of(root: Path) -> LatentSafePolicy:
    meta = LeRobotDatasetMetadata("local/known", root=root)
    return new_guard(meta, Contract.read(meta))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--known", type=Path)
    parser.add_argument("--filter")
    parser.add_argument("--held_out", type=Path, nargs="+", required=True)
    parser.add_argument("--episodes", type=int, default=200, help="held out, at most")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    policy = load_filter(arguments.filter, law=GUARD) if arguments.filter else guard_of(arguments.known)
    cameras, each = policy.config.trained_on.cameras, arguments.episodes // len(arguments.held_out)
    parts = []
    for root in arguments.held_out:
        meta = LeRobotDatasetMetadata("local/held_out", root=root)
        parts.append(recorded(meta, list(range(min(each, meta.total_episodes))), cameras))
    found = alarms(policy, chain(*parts))
    print(found)
    write_json(arguments.output, {**found, **provenance(seeds=[])})


if __name__ == "__main__":
    main()
