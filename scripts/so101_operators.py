#!/usr/bin/env python
"""Two operators push the cube with the SO-101's leader arm, bare and under filters, from the same starts.

    scripts/so101_operators.py --filters outputs/so101_dino_wm/filter_0 --n=50

Writes results/so101/operators.json: of the reckless one, who pushes past the mark, and of the careful one, how often
the cube falls, how often it ends on the mark, and the share of steps overridden. It needs no trained policy.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.so101 import FIRST_SEED, compare_operators


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--filters", nargs="+", required=True)
    parser.add_argument("--n", type=int, default=50, help="starts")
    parser.add_argument("--law.epsilon", dest="epsilon", type=float, help="by default the filter's own")
    parser.add_argument("--output", type=Path, default=Path("results/so101/operators.json"))
    arguments = parser.parse_args()
    table = compare_operators(arguments.filters, arguments.n, LawOptions(epsilon=arguments.epsilon))
    settings = {"epsilon": arguments.epsilon}
    write_json(arguments.output, {**table, **settings, **provenance(seeds=[FIRST_SEED])})


if __name__ == "__main__":
    main()
