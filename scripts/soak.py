#!/usr/bin/env python
"""Drives a shielded robot for 100,000 ticks, with a random fault every hundredth: none passes, memory stays flat.

    scripts/soak.py --ticks=100000 --seed=0

Writes results/reliability/soak.json. Exits with 1 where a fault passed, a command left the range, or memory, open files
or threads grew.
"""

import argparse
import sys
import time
from pathlib import Path

import torch

from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.soak import soak

WARM_UP, GROWTH_MB = 2, 20.0
"""Samples that are left out, and by how much memory may differ after them."""


def main() -> int:
    """The command line; 1 where something must not be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ticks", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("results/reliability/soak.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    began = time.monotonic()
    result = soak(arguments.ticks, arguments.seed)
    grown = {
        name: max(result[name][WARM_UP:]) - result[name][WARM_UP] for name in ("memory_mb", "open_files", "threads")
    }
    minutes = round((time.monotonic() - began) / 60, 2)
    write_json(arguments.output, {**result, "grown": grown, "minutes": minutes, **provenance(seeds=[arguments.seed])})
    wrong = result["passed_with_fault"] or result["out_of_range"]
    return int(bool(wrong) or grown["memory_mb"] > GROWTH_MB or grown["open_files"] > 0 or grown["threads"] > 0)


if __name__ == "__main__":
    sys.exit(main())
