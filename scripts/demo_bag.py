#!/usr/bin/env python
"""A filter of the bag at work: a policy, if one is given, and operators, bare and shielded from the same starts.

Nothing is trained. Runs scripts/bag_operators.py and scripts/bag_policies.py, small enough for two cores, and writes
outputs/demo_bag/report.html and outputs/demo_bag/metrics.json. Numbers of full size are in results/bag.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.bag.demo import run_demo


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/demo_bag"))
    parser.add_argument("--policy", default="bag", help="the filter: a folder, a Hub id or a committed name")
    parser.add_argument("--base", help="a policy to be shielded, likewise")
    parser.add_argument("--n", type=int, default=12, help="starts of the policy; operators get half as many")
    arguments = parser.parse_args()
    run_demo(arguments.out, arguments.policy, arguments.base, arguments.n)


if __name__ == "__main__":
    main()
