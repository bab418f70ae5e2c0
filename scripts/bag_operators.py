#!/usr/bin/env python
"""A scripted operator lifts or swings the bag, bare and under filters and their baselines, from the same starts.

    scripts/bag_operators.py --filters <filter> ... --operators closed_end open_end --n=100
    scripts/bag_operators.py --filters <filter> --laws reachability nearest --operators side_to_side_0.15 --n=15

Writes results/bag/operators.json: for each operator bare, under each filter, and under the laws that the first one is
compared with, the episodes that spill, the share of candies lost, steps overridden, the step of the first override, the
CPU time of a decision, and of the first law and filter the values of a few episodes step by step; operators.png beside
it draws those. Each run is kept in a .jsonl beside the output: a killed experiment goes on.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.bag.command_line import add_filter_options, add_laws, filter_settings
from lerobot_latentsafe.experiments.bag.operators import OPERATORS, compare_operators
from lerobot_latentsafe.experiments.bag.runs import FIRST_SEED


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_filter_options(parser, 100)
    add_laws(parser)
    parser.add_argument("--operators", nargs="+", choices=OPERATORS, default=list(OPERATORS))
    parser.add_argument("--first_seed", type=int, default=FIRST_SEED, help="smaller ones are for choosing settings")
    parser.add_argument("--output", type=Path, default=Path("results/bag/operators.json"))
    arguments = parser.parse_args()
    settings = filter_settings(arguments, arguments.laws)
    compare_operators(
        settings, arguments.operators, arguments.n, arguments.output, arguments.workers, arguments.first_seed
    )


if __name__ == "__main__":
    main()
