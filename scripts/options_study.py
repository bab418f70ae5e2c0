#!/usr/bin/env python
"""What the training options of margin and critic change, under the laws `reachability` and `nearest`.

    scripts/options_study.py --place=bag --base=outputs/bag/margin_dino_wm_0 --dataset=data/bag_tokens \\
      --operators closed_end side_to_side_0.15 --policies policy=outputs/bag/diffusion_mixed
    scripts/options_study.py --place=car --base=outputs/demo/critic --dataset=outputs/demo/random_cache \\
      --policies car_reckless=dubins_diffusion_reckless --options "as shipped" "gradient penalty" --seeds 0 1 2 --n=50

Writes results/assurance/training_options.json, where rows of other drivers stay. Each episode is kept in a .jsonl
beside it, and each filter in --filters: a killed study goes on.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.assurance.training_options import ENVS, OPTIONS, Drivers, study
from lerobot_latentsafe.experiments.bag.command_line import named_paths


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--place", choices=["bag", *ENVS], default="bag")
    parser.add_argument("--base", default="bag", help="the filter whose world model and law are used")
    parser.add_argument("--dataset", type=Path, required=True, help="cached recordings that it was trained on")
    parser.add_argument("--options", nargs="+", default=list(OPTIONS), choices=list(OPTIONS))
    parser.add_argument("--operators", nargs="*", default=[], help="of the bag")
    parser.add_argument("--policies", nargs="*", default=[], metavar="NAME=PATH", help="that are shielded")
    parser.add_argument("--n", type=int, default=15, help="starts of each")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="of margin and critic")
    parser.add_argument("--filters", type=Path, default=Path("outputs/options"), help="where filters are kept")
    parser.add_argument("--output", type=Path, default=Path("results/assurance/training_options.json"))
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    if given.operators and given.place != "bag":
        parser.error(f"--operators move the bag only; of --place={given.place} give --policies")
    drivers = Drivers(given.place, given.operators, named_paths(parser, "--policies", given.policies))
    study(
        given.base, given.dataset, given.options, drivers, given.n, given.seeds, given.filters, given.output,
        given.workers,
    )  # fmt: skip


if __name__ == "__main__":
    main()
