#!/usr/bin/env python
"""What the hand must not do, added to the bag's filter without training: enter a zone, lift the bag too high.

    latentsafe train-reachability --policy.path=outputs/bag/margin_dino_wm_0 --dataset.repo_id=latentsafe/bag_cache \\
      --dataset.root=data/bag_tokens \\
      --output_dir=outputs/bag_alike --alike='{ee_x.pos: 0.05, ee_y.pos: 0.05, ee_z.pos: 0.05, gripper.pos: 0.4}'
    scripts/bag_constraint.py --filter=outputs/bag_alike --recordings=data/bag_pulls

Writes results/assurance/constraints_bag.json: of an operator who swings the bag to the side, and of one who lifts it,
runs in which the hand goes where it must not, spills and successes: bare, under the filter as it was, and with the new
constraint. Each episode is kept in a .jsonl beside it: a killed study goes on.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.assurance.bag_constraint import study


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--filter", required=True, help="a filter of the bag that takes constraints")
    parser.add_argument("--recordings", type=Path, required=True, help="a dataset with videos, to mark the places in")
    parser.add_argument("--n", type=int, default=20, help="starts")
    parser.add_argument("--output", type=Path, default=Path("results/assurance/constraints_bag.json"))
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    study(given.filter, given.recordings, given.n, given.output, given.workers)


if __name__ == "__main__":
    main()
