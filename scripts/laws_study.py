#!/usr/bin/env python
"""The laws `reachability` and `nearest` with the committed filters, from the same starts, beside no filter.

    scripts/laws_study.py --car=60 --bag=20 --blocks=20

Writes results/assurance/laws.json: of each policy or operator violations, successes and stalls; how far what is
executed is from what was proposed, and the share of steps changed; and the CPU time of a tick under both laws in turn.
Rows of other studies stay in it. Each episode is kept in a .jsonl beside it: a killed study goes on.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.assurance.laws import STUDIES, study


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in STUDIES:
        parser.add_argument(f"--{name}", type=int, default=0, metavar="N", help="starts; 0: leave it out")
    parser.add_argument("--timed", type=int, default=5, help="episodes of each whose ticks are timed")
    parser.add_argument("--output", type=Path, default=Path("results/assurance/laws.json"))
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    counts = {name: n for name in STUDIES if (n := getattr(arguments, name)) > 0}
    if not counts:
        parser.error(f"nothing to run: give starts, such as --{next(iter(STUDIES))}=60")
    study(counts, arguments.timed, arguments.output, arguments.workers)


if __name__ == "__main__":
    main()
