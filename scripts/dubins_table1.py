#!/usr/bin/env python
"""Table 1: monitors and safe policies of the Dubins car against both exact truths, on the paper's grid.

    scripts/dubins_table1.py --filters outputs/dubins/filter_0 outputs/dubins/filter_1 --seeds 0 1 2

Rows: the latent filters as they are used, the same with 25 steps of imagination, their critics alone (lookahead 0), the
privileged baseline (trained here, one critic a seed), and three that keep them honest: a planner that only imagines
held actions with the same world models, the failure classifier alone, always safe.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.dubins.table1 import write_table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--filters", nargs="+", required=True, help="filter checkpoints, one a seed")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="seeds of the privileged critics")
    parser.add_argument("--output_dir", type=Path, default=Path("results/dubins"))
    arguments = parser.parse_args()
    write_table(arguments.filters, arguments.seeds, arguments.output_dir)


if __name__ == "__main__":
    main()
