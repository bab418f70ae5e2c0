#!/usr/bin/env python
"""Table 2: the blocks' task policy bare, under SQRL, under the latent safety filter, and under the simulator itself.

    scripts/blocks_table2.py --dreamer outputs/blocks/dreamer/policy --workers=2 \
        --filters outputs/blocks/filter/seed_{0,1,2} --risks outputs/blocks/risk/seed_{0,1,2}

All methods start from the same states. Writes table2.json, trade_off.png, unsafe_rollout.png and lead.png to
--output_dir. Each episode is kept in --cells as it ends, so that a killed run goes on where it stopped.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.blocks.table2 import write_table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dreamer", required=True, help="the task policy")
    parser.add_argument("--filters", nargs="+", required=True, help="latent safety filters, one a seed")
    parser.add_argument("--risks", nargs="+", required=True, help="filters with a risk critic, one a seed")
    parser.add_argument("--n", type=int, default=200, help="starts")
    parser.add_argument("--n_curve", type=int, default=50, help="starts of each point of the curves, each seed")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--cells", type=Path, default=Path("outputs/blocks/cells.jsonl"))
    parser.add_argument("--output_dir", type=Path, default=Path("results/blocks"))
    given = parser.parse_args()
    write_table(
        given.dreamer, given.filters, given.risks, given.n, given.n_curve, given.cells, given.output_dir, given.workers
    )


if __name__ == "__main__":
    main()
