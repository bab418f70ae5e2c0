#!/usr/bin/env python
"""What a thousand, a hundred thousand and a million episodes cost, from what was measured; for docs/scaling.md.

python scripts/scale_costs.py       writes results/scale/costs.json
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.scale_costs import Measured, table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--episodes", type=int, nargs="+", default=[1_000, 100_000, 1_000_000])
    parser.add_argument("--nodes", type=int, nargs="+", default=[1, 10, 100])
    given = parser.parse_args()
    row = table(Measured.read(given.results), given.episodes, given.nodes)
    write_json(given.results / "scale" / "costs.json", {**row, **provenance(seeds=[])})


if __name__ == "__main__":
    main()
