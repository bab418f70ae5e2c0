#!/usr/bin/env python
"""What the training options of margin and critic change on the bag, under the laws `reachability` and `nearest`.

    scripts/options_study.py --base=outputs/bag/margin_dino_wm_0 --dataset=data/bag_tokens \\
      --mixed=outputs/bag/diffusion_mixed

Writes results/assurance/training_options.json. Each episode is kept in a .jsonl beside it, and each filter in
--filters: a killed study goes on.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.assurance.training_options import OPTIONS, study


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--base", default="bag", help="the filter whose world model and law are used")
    parser.add_argument("--dataset", type=Path, required=True, help="cached recordings that it was trained on")
    parser.add_argument("--options", nargs="+", default=list(OPTIONS), choices=list(OPTIONS))
    parser.add_argument("--operators", nargs="+", default=["closed_end", "side_to_side_0.15"])
    parser.add_argument("--mixed", help="a policy that is shielded, too")
    parser.add_argument("--n", type=int, default=15, help="starts of each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--filters", type=Path, default=Path("outputs/options"), help="where filters are kept")
    parser.add_argument("--output", type=Path, default=Path("results/assurance/training_options.json"))
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    study(
        given.base, given.dataset, given.options, given.operators, given.mixed, given.n, given.seed, given.filters,
        given.output, given.workers,
    )  # fmt: skip


if __name__ == "__main__":
    main()
