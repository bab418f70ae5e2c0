#!/usr/bin/env python
"""The ablation: a filter whose world model has seen only {straight, left} must fear states that need a right turn.

    scripts/dubins_ablation.py --filter outputs/dubins/filter_left_only --full outputs/dubins/filter_0

Both filters are compared with the exact solution *for the left-only action set*, and by the share of right-turn-only
states (safe with three actions, unsafe with two) that they call unsafe. The full filter is the control.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.dubins.ablation import write_ablation


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--filter", required=True, help="trained on {0, a_max} only")
    parser.add_argument("--full", required=True, help="trained on all three actions: the control")
    parser.add_argument("--output_dir", type=Path, default=Path("results/dubins"))
    arguments = parser.parse_args()
    write_ablation(arguments.filter, arguments.full, arguments.output_dir)


if __name__ == "__main__":
    main()
