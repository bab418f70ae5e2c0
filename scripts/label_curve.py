#!/usr/bin/env python
"""How good the failure margin gets with few labels: episodes labelled at random, or in the order the page suggests.

    scripts/label_curve.py --policy=<world model> --repo_id=latentsafe/dubins_random_cache --root=data/car_cache \\
        --output=results/labels/curve_car.json
    scripts/label_curve.py --policy=<world model> --repo_id=latentsafe/bag_cache --root=data/bag_tokens \\
        --output=results/labels/curve_bag.json

Fits fresh margins to the frozen features of a world model, as `latentsafe train-margin` does. In suggested order a
person labels in rounds, each with suggestions of the margin fitted to the labels of the rounds before. For a clean
result train the world model with --policy.margin.weight=0, so that no label has shaped its features; the JSON says
whether it was. Labels come from the dataset's own column; a fifth of the episodes is held out and scored frame by
frame. All curves of the output's folder are drawn into curve.png beside them.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.label_curve import write_curves


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", required=True)
    parser.add_argument("--repo_id", required=True)
    parser.add_argument("--root", required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--output", type=Path, required=True)
    given = parser.parse_args()
    write_curves(given.policy, given.repo_id, given.root, given.seeds, given.output, given.workers)


if __name__ == "__main__":
    main()
