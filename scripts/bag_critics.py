#!/usr/bin/env python
"""What makes a good critic of the bag: each variant's V against a planner that tries far more, in the same imagination.

    scripts/bag_critics.py --policy=<margin> --dataset=data/bag_tokens --held data/held_branches_tokens ...

Trains a critic for each variant and seed on `--dataset` and asks it on states of held-out recordings, as they are and
after three steps of a full-speed rise. Writes results/bag/critics.json: error against the planner's V, safe states that
would be stopped and doomed ones that would pass at `--epsilon`, what following the fallback comes to, and CPU seconds.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.bag.critics import SATURATED, VARIANTS, compare_critics


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", required=True, help="world model and margin, as of latentsafe train-margin")
    parser.add_argument("--dataset", type=Path, required=True)
    parser.add_argument("--held", type=Path, nargs="+", required=True)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--variants", nargs="+", choices=[*VARIANTS, SATURATED], default=[*VARIANTS, SATURATED])
    parser.add_argument("--epsilon", type=float, default=0.2)
    parser.add_argument("--output", type=Path, default=Path("results/bag/critics.json"))
    given = parser.parse_args()
    compare_critics(
        given.policy, given.dataset, given.held, given.variants, given.seeds, given.steps, given.epsilon, given.output
    )


if __name__ == "__main__":
    main()
