#!/usr/bin/env python
"""Throughput of two ranks against one, each on a single thread and with a batch of the same size a rank.

    world_model     gradient steps on clips from a token cache, with DistributedDataParallel as LeRobot sets it up;
                    and with weights that are averaged after every 8 steps
    reachability    `refresh` updates of the critic and the imagination of a part of its pool, as in
                    `latentsafe train-reachability`; two ranks have a batch and a pool of twice the size. With the
                    batch of the configuration, with one of 2048 states a rank, and with weights that are averaged
                    after every 8 updates: an update is over in a few milliseconds, and gradients must travel after each

Three teams wait in processes of their own and work in turn: one process alone; two ranks of gloo; and, as the ceiling
that this machine sets (shared caches, memory and clock), two processes that know nothing of each other. What counts is
wall time, so run it on a machine that does nothing else; the load before the run is noted. `fastest` compares the
fastest rounds, which others on the machine have disturbed least.

    OMP_NUM_THREADS=1 python scripts/bench_ranks.py --policy=data/margin_gru_0 --cache=data/held_branches_tokens \\
        --json=results/bag/bench_ranks.json
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.evaluation.statistics import write_json
from lerobot_latentsafe.experiments.bag.ranks_throughput import Work, measure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", type=Path, required=True, help="a filter with a trained gru world model")
    parser.add_argument("--cache", type=Path, required=True, help="a token cache that fits it")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--steps", type=int, default=24, help="steps of the world model a round, a multiple of 8")
    parser.add_argument("--batch", type=int, default=96, help="clips a rank and step")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    row = measure(Work(args.policy, args.cache, args.steps, args.batch), args.rounds)
    if args.json:
        write_json(args.json, row)


if __name__ == "__main__":
    main()
