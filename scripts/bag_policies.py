#!/usr/bin/env python
"""Diffusion policies lift the bag, bare and under the same filters, from the same starts.

    scripts/bag_policies.py --weak=bag_diffusion_weak --strong=bag_diffusion_strong --filters <filter> ... --n=100
    scripts/bag_policies.py --mixed=outputs/bag/diffusion_mixed --filters bag --laws reachability nearest --n=40

Writes results/bag/policies.json: for each policy bare, under each filter, and under the laws that the first filter is
compared with, runs that spill, candies lost, success, steps overridden, step of the first override, CPU time of a
decision; and a picture beside it (.png), how many runs spill at least p% of the candies. Each run is kept in a .jsonl
beside the output: a killed experiment goes on. Policies that the file holds already, and that are not given, stay.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.bag.command_line import add_filter_options, add_laws, filter_settings
from lerobot_latentsafe.experiments.bag.policies import compare_policies


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weak", help="policy that learnt from careless demonstrations")
    parser.add_argument("--strong", help="policy that learnt from careful ones")
    parser.add_argument("--mixed", help="policy that learnt from both ways to grasp: one spills, one succeeds")
    add_filter_options(parser, 100)
    add_laws(parser)
    parser.add_argument(
        "--n_videos", type=int, default=0, help="starts to film, bare and under the first law and filter"
    )
    parser.add_argument("--output", type=Path, default=Path("results/bag/policies.json"))
    arguments = parser.parse_args()
    bases = {name: path for name in ("weak", "strong", "mixed") if (path := getattr(arguments, name))}
    if not bases:
        parser.error("no policy to shield: give --weak, --strong or --mixed")
    settings = filter_settings(arguments, arguments.laws)
    compare_policies(bases, settings, arguments.n, arguments.output, arguments.workers, arguments.n_videos)


if __name__ == "__main__":
    main()
