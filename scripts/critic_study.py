#!/usr/bin/env python
"""What the critic is for: the car in a bent channel, where what saves is several actions in a row.

    latentsafe collect --source=random_located --dataset.repo_id=latentsafe/car_located \\
      --dataset.root=outputs/located --dataset.num_episodes=400 --seed=3
    latentsafe cache --dataset.repo_id=latentsafe/car_located --dataset.root=outputs/located \\
      --output_dir=outputs/located_cache
    scripts/critic_study.py --dataset=outputs/located_cache

Writes results/assurance/critic.json and .png: verdicts against the exact value, runs of the fallback alone, and runs of
a reckless driver, under the critic and under a planner that holds actions. Each measurement is kept in a .jsonl beside
it, and each filter in --filters: a killed study goes on.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.assurance.channel import study


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, required=True, help="cached recordings of the car, with its position")
    parser.add_argument("--base", default="dubins", help="the filter whose world model is used")
    parser.add_argument("--filters", type=Path, default=Path("outputs/channel"), help="where filters are kept")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=6000, help="gradient steps of each critic")
    parser.add_argument("--output", type=Path, default=Path("results/assurance/critic.json"))
    given = parser.parse_args()
    study(given.base, given.dataset, given.filters, given.seeds, given.steps, given.output)


if __name__ == "__main__":
    main()
