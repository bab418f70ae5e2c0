#!/usr/bin/env python
"""Of the bags that spill under a filter, what was to blame: the simulator is branched at every moment before.

    scripts/bag_misses.py --filters dino_wm=bag gru=outputs/bag/gru_0 --n=8

An operator pulls up the red bag by its closed end; the same commands are replayed on bags that look alike and are
stiffer, heavier or smoother, under each filter. Writes results/assurance/misses.json, with a `summary` of causes (see
lerobot_latentsafe/experiments/bag/branching.py), and misses.png beside it. Runs are kept in a .jsonl beside the output:
a killed experiment goes on.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.experiments.bag.branching import explain_filters
from lerobot_latentsafe.experiments.bag.command_line import named_paths
from lerobot_latentsafe.experiments.filter_settings import FilterSetting


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--filters", nargs="+", required=True, metavar="NAME=PATH")
    parser.add_argument("--n", type=int, default=8, help="starts of each bag")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--output", type=Path, default=Path("results/assurance/misses.json"))
    given = parser.parse_args()
    paths = named_paths(parser, "--filters", given.filters)
    settings = {name: FilterSetting.of(path, LawOptions()) for name, path in paths.items()}
    explain_filters(settings, given.n, given.output, given.workers)


if __name__ == "__main__":
    main()
