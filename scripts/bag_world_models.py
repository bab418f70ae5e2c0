#!/usr/bin/env python
"""World models of the bag on one yardstick, beside controls that cannot be good.

    scripts/bag_world_models.py --models gru=<filter> dino_wm=<filter> blind=<filter> --data=data --cost=<cost.csv>

Reads the recordings held_branches and held_lifts of `--data` and their token caches (held_branches_tokens, ...), and
for models that read pictures held_branches_pictures, ..., too. Writes results/bag/world_models.json. `summary` has a
row a model: whether it hears the action, foretells the difference between two futures, tells branches and lifts apart,
fails holding still and misses small spills, and what its training took. Below are all numbers of each recording.
world_models.png beside it shows one state's futures under three actions.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.bag.command_line import named_paths
from lerobot_latentsafe.experiments.bag.world_models import compare_models


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", required=True, metavar="NAME=PATH", help="a name, and a checkpoint")
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the recordings and their caches")
    parser.add_argument("--cost", type=Path, help="CSV file with a row world_model_NAME: step, user_s, system_s")
    parser.add_argument("--output", type=Path, default=Path("results/bag/world_models.json"))
    given = parser.parse_args()
    compare_models(named_paths(parser, "--models", given.models), given.data, given.output, given.cost)


if __name__ == "__main__":
    main()
