#!/usr/bin/env python
"""Unsafe recordings are replayed on bags that the filter never saw: other colours, table, stiffness, weight.

    scripts/bag_out_of_distribution.py --filters <filter> ... --n=50

From each start a careless operator lifts the red bag by its closed end, unfiltered. What they commanded is then
replayed, as it is, on every variant, bare and under each filter. Writes results/bag/out_of_distribution.json: spills,
candies lost, steps overridden, step of the first override; and out_of_distribution.png beside it, V along the first
starts under the first filter. With --mechanics the other bags look like the red one, and only stiffness, weight or
friction differ: results/bag/mechanics.json. Runs are kept in a .jsonl beside the output: a killed experiment goes on.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.decision import LAWS
from lerobot_latentsafe.experiments.bag.command_line import add_filter_options, filter_settings
from lerobot_latentsafe.experiments.bag.out_of_distribution import MECHANICS, UNSEEN, compare_variants


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_filter_options(parser, 50)
    parser.add_argument("--law", choices=LAWS, default=LAWS[0])
    parser.add_argument("--mechanics", action="store_true", help="bags that only feel otherwise")
    parser.add_argument("--output", type=Path, help="of the table, .json")
    arguments = parser.parse_args()
    settings = filter_settings(arguments, [arguments.law])
    name, bags = ("mechanics", list(MECHANICS)) if arguments.mechanics else ("out_of_distribution", UNSEEN)
    output = arguments.output or Path(f"results/bag/{name}.json")
    compare_variants(settings, arguments.n, output, arguments.workers, bags)


if __name__ == "__main__":
    main()
