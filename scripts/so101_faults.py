#!/usr/bin/env python
"""Breaks something between the SO-101 and its filter, one thing at a time, and measures how the arm moves.

    scripts/so101_faults.py --filter=<filter> --n=5

Writes results/so101/faults.json: for each fault the largest motion of an arm at rest that is to stay, in degrees, and
the largest step that is commanded in the middle of a push, in shares of the data's largest.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.so101 import FIRST_SEED
from lerobot_latentsafe.experiments.so101_faults import fault_motions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--filter", required=True)
    parser.add_argument("--n", type=int, default=5, help="starts")
    parser.add_argument("--output", type=Path, default=Path("results/so101/faults.json"))
    arguments = parser.parse_args()
    table = fault_motions(arguments.filter, range(FIRST_SEED, FIRST_SEED + arguments.n))
    write_json(arguments.output, {"faults": table, **provenance(seeds=[FIRST_SEED])})


if __name__ == "__main__":
    main()
