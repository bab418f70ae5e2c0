#!/usr/bin/env python
"""Does a calibrated filter miss as rarely as is stated? Held-out episodes, drawn into calibration and test many times.

    scripts/calibration_study.py
    scripts/calibration_study.py --bag=bag --data data/bag/held_branches_tokens data/bag/held_lifts_tokens

Writes results/assurance/calibration.json and .png. The car is driven at random with new seeds, and its exact safe set
counts misses by state and by episode, too. Of the bag, give a filter and caches of recordings that it has not seen.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.assurance.calibration import LEAD_STEPS, write_calibration_study


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bag", help="a filter of the bag")
    parser.add_argument("--data", nargs="+", default=[], help="held-out recordings of it, cached")
    parser.add_argument("--lead_steps", type=int, default=LEAD_STEPS, help="frames of warning asked for on the bag")
    parser.add_argument("--output", type=Path, default=Path("results/assurance/calibration.json"))
    given = parser.parse_args()
    if bool(given.bag) != bool(given.data):
        parser.error("--bag and --data belong together")
    write_calibration_study(given.output, given.bag, given.data, given.lead_steps)


if __name__ == "__main__":
    main()
