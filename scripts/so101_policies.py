#!/usr/bin/env python
"""Two ACT policies push the cube with the SO-101, bare and under the same filters, from the same starts.

    scripts/so101_policies.py --reckless=<policy> --careful=<policy> --filters <filter> ... --n=100

Writes results/so101/policies.json: `bare` and `shielded` of the reckless one, as `latentsafe eval-shield` does, with
the runs of all filters together; and the same under `reckless` and `careful`, with each filter's own.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.so101 import FIRST_SEED, compare_policies


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reckless", required=True, help="policy that learnt to push past the mark")
    parser.add_argument("--careful", required=True, help="policy that learnt to push to the mark")
    parser.add_argument("--filters", nargs="+", required=True)
    parser.add_argument("--n", type=int, default=100, help="starts")
    parser.add_argument("--law.name", dest="law", help="by default the filter's own; `margin` stops where l is low")
    parser.add_argument("--law.epsilon", dest="epsilon", type=float, help="by default the filter's own")
    parser.add_argument("--output", type=Path, default=Path("results/so101/policies.json"))
    arguments = parser.parse_args()
    bases = {"reckless": arguments.reckless, "careful": arguments.careful}
    table = compare_policies(
        bases, arguments.filters, arguments.n, LawOptions(name=arguments.law, epsilon=arguments.epsilon)
    )
    first = {name: table["reckless"][name] for name in ("bare", "shielded")}
    write_json(arguments.output, {**first, **table, **provenance(seeds=[FIRST_SEED])})


if __name__ == "__main__":
    main()
