#!/usr/bin/env python
"""How far ACT policies of the SO-101 leave the range of commands, and of displacements, that their data show.

    scripts/so101_ranges.py --policies <policy> ... --datasets <folder> ... --n=50

A displacement is a target minus the present joint. Writes results/so101/act_ranges.json: for each policy the share of
steps that leave the range, and by more than some shares of it; a filter clips what leaves it by no more than 0.1.
"""

import argparse
from pathlib import Path

from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.so101 import FIRST_SEED, ranges_left


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policies", nargs="+", required=True)
    parser.add_argument("--datasets", nargs="+", required=True, type=Path, help="that each of them learned from")
    parser.add_argument("--n", type=int, default=50, help="starts")
    parser.add_argument("--output", type=Path, default=Path("results/so101/act_ranges.json"))
    arguments = parser.parse_args()
    table = {}
    for policy, root in zip(arguments.policies, arguments.datasets, strict=True):
        table[root.name] = ranges_left(policy, LeRobotDataset(f"latentsafe/{root.name}", root=root), arguments.n)
        print(root.name, table[root.name])
    write_json(arguments.output, {**table, **provenance(seeds=[FIRST_SEED])})


if __name__ == "__main__":
    main()
