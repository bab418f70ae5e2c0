#!/usr/bin/env python
"""How early a filter of the blocks warns of a fall, and how often of nothing, by its threshold.

    scripts/blocks_warning.py [--filter=blocks] [--dreamer=blocks_dreamer] [--n=200] [--workers=2]

The task policy runs bare while the filter looks on. Writes results/blocks/warning.json: how many steps V falls to a
threshold before the margin sees the failure, V of what is seen and V of the proposal, which the law reads; and in how
many runs without a failure it falls nevertheless. Each episode is kept in a .jsonl beside it as it ends, so that a
killed run goes on where it stopped.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.blocks.warning import watch


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--filter", default="blocks", help="the filter")
    parser.add_argument("--dreamer", default="blocks_dreamer", help="the task policy")
    parser.add_argument("--n", type=int, default=200, help="starts")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--output", type=Path, default=Path("results/blocks/warning.json"))
    given = parser.parse_args()
    watch(given.dreamer, given.filter, given.n, given.output, given.workers)


if __name__ == "__main__":
    main()
