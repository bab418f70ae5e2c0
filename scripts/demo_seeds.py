#!/usr/bin/env python
"""What `make demo` shows, over several seeds: pools the numbers of demonstrations that have run.

for seed in 0 1 2; do .venv/bin/python scripts/demo.py --seed=$seed --out=outputs/demo_$seed; done
.venv/bin/python scripts/demo_seeds.py outputs/demo_{0,1,2}
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.dubins.demo import pool_runs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, help="of demonstrations, one a seed")
    parser.add_argument("--output", type=Path, default=Path("results/demo.json"))
    arguments = parser.parse_args()
    pool_runs(arguments.folders, arguments.output)


if __name__ == "__main__":
    main()
