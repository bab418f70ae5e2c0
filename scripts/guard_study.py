#!/usr/bin/env python
"""Makes a guard of recorded episodes, then breaks one thing after the other in episodes that it does not know.

    scripts/guard_study.py --root=data/so101_mix --output=results/guard/so101.json

Writes how long the guard took to make, how many of each fault it noticed, its false alarms, and what a tick costs.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.guard_study import FAULTS, alarms, caught, load_recorded
from lerobot_latentsafe.guarding import new_guard


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--held_out", type=Path, help="another dataset of the same robot; by default the same")
    parser.add_argument("--episodes", type=int, default=50, help="of the guard, and as many held out")
    parser.add_argument("--n", type=int, default=100, help="of each fault")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    meta = LeRobotDatasetMetadata("local/known", root=arguments.root)
    order = np.random.default_rng(0).permutation(meta.total_episodes).tolist()
    known = sorted(order[: arguments.episodes])
    started = time.perf_counter(), time.process_time()
    policy = new_guard(meta, Contract.read(meta).only(known))
    took = {"seconds": time.perf_counter() - started[0], "cpu_seconds": time.process_time() - started[1]}
    print("made in", took, flush=True)
    cameras = policy.config.trained_on.cameras
    if arguments.held_out:
        held_out = load_recorded(arguments.held_out, list(range(arguments.episodes)), cameras)
    else:
        held_out = load_recorded(arguments.root, sorted(order[arguments.episodes : 2 * arguments.episodes]), cameras)
    healthy = alarms(policy, iter(held_out))
    print(healthy, flush=True)
    table = {}
    for fault in FAULTS:
        if fault == "cameras swapped" and len(cameras) < 2:
            continue
        table[fault] = caught(policy, held_out, fault, arguments.n)
        print(fault, table[fault], flush=True)
    told = {key: look.told for key, look in policy.config.trained_on.looks.items()}
    result = {"episodes": len(known), "made_in": took, "held_out": healthy, "faults": table, "told": told}
    write_json(arguments.output, {**result, **provenance(seeds=[0])})


if __name__ == "__main__":
    main()
