#!/usr/bin/env python
"""A filter of the bag at work: a policy, if one is given, and operators, bare and shielded from the same starts.

Runs scripts/bag_operators.py and scripts/bag_policies.py, small enough for two cores, and writes
outputs/demo_bag/report.html and outputs/demo_bag/metrics.json. Numbers of full size are in results/bag.

Nothing is trained, unless an encoder is given: then episodes are recorded and encoded, and a filter is trained that
sees by it. That shows the way; so few episodes and steps make no good filter.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.bag.demo import run_demo
from lerobot_latentsafe.experiments.bag.demo_filter import FilterSizes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/demo_bag"))
    parser.add_argument("--policy", default="bag", help="the filter: a folder, a Hub id or a committed name")
    parser.add_argument("--base", help="a policy to be shielded, likewise")
    parser.add_argument("--n", type=int, default=8, help="starts of the policy; operators get half as many")
    parser.add_argument("--encoder", help="train a filter that sees by it: dinov2, a folder, a Hub id, ...")
    sizes = FilterSizes()
    parser.add_argument("--episodes", type=int, default=sizes.episodes, help="recorded of each source")
    parser.add_argument("--image_size", type=int, help="pixels that the encoder sees; by default what it wants")
    parser.add_argument("--steps", type=int, default=sizes.steps, help="of the world model")
    parser.add_argument("--critic_steps", type=int, default=sizes.critic_steps)
    arguments = parser.parse_args()
    sizes = FilterSizes(
        episodes=arguments.episodes,
        image_size=arguments.image_size,
        steps=arguments.steps,
        critic_steps=arguments.critic_steps,
    )
    run_demo(arguments.out, arguments.policy, arguments.base, arguments.n, arguments.encoder, sizes)


if __name__ == "__main__":
    main()
