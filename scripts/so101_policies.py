#!/usr/bin/env python
"""Policies push the cube with the SO-101, bare and under the same filters, from the same starts.

    scripts/so101_policies.py --reckless=<policy> --careful=<policy> --filters <filter> ... --n=100
    scripts/so101_policies.py --mixed=<policy> --laws guard reachability nearest --filters <filter> ... --n=50

The first writes `bare` and `shielded` of the reckless one into results/so101/policies.json, as `latentsafe eval-shield`
does, with the runs of all filters together; and the same under `reckless` and `careful`, with each filter's own. The
second writes `mixed`, by law and filter. What the file held of other policies stays in it.
"""

import argparse
import json
from pathlib import Path

from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.so101 import FIRST_SEED, compare_laws, compare_policies


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reckless", help="policy that learnt to push past the mark")
    parser.add_argument("--careful", help="policy that learnt to push to the mark")
    parser.add_argument("--mixed", help="policy that learnt from both")
    parser.add_argument("--filters", nargs="+", required=True)
    laws = ["guard", "reachability", "nearest"]
    parser.add_argument("--laws", nargs="+", default=laws, help="of the mixed policy's rows")
    parser.add_argument("--n", type=int, default=100, help="starts")
    parser.add_argument("--law.name", dest="law", help="by default the filter's own; `margin` stops where l is low")
    parser.add_argument("--law.epsilon", dest="epsilon", type=float, help="by default the filter's own")
    parser.add_argument("--output", type=Path, default=Path("results/so101/policies.json"))
    given = parser.parse_args()
    if not given.mixed and not (given.reckless and given.careful):
        parser.error("no policy to shield: give --reckless and --careful, or --mixed")
    kept = json.loads(given.output.read_text()) if given.output.exists() else {}
    if given.mixed:
        rows = compare_laws(given.mixed, given.filters, given.laws, given.n)
        write_json(given.output, {**kept, "mixed": {**rows, **provenance(seeds=[FIRST_SEED])}})
        return
    bases = {"reckless": given.reckless, "careful": given.careful}
    table = compare_policies(bases, given.filters, given.n, LawOptions(name=given.law, epsilon=given.epsilon))
    first = {name: table["reckless"][name] for name in ("bare", "shielded")}
    write_json(given.output, {**kept, **first, **table, **provenance(seeds=[FIRST_SEED])})


if __name__ == "__main__":
    main()
