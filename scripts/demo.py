#!/usr/bin/env python
"""The whole road in miniature: episodes -> world model -> reachability -> a shielded diffusion policy -> a report.

Runs the same commands a user would, small enough for two cores (about ten minutes), and writes
outputs/demo/report.html and outputs/demo/metrics.json. Numbers of full size are in results/.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.dubins.demo import run_demo


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/demo"))
    parser.add_argument("--epsilon", type=float, default=0.7, help="the filter acts where V <= epsilon")
    parser.add_argument("--n_episodes", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0, help="of what is recorded and trained")
    arguments = parser.parse_args()
    run_demo(arguments.out, arguments.epsilon, arguments.n_episodes, arguments.seed)


if __name__ == "__main__":
    main()
