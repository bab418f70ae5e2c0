#!/usr/bin/env python
"""What the simulated Franka does, measured on fresh seeds: results/franka/<part>.json for each part named.

spills      any candy spilled, by grasp; side-to-side swings, slow and fast
variants    whether the grasp lifts each variant of the bag
explosions  random episodes in which MuJoCo warned, or anything moved faster than 30 m/s (rad/s)
doomed      steps between the last state from which some retreat spills nothing and the first candy seen outside
leak        the grasped end predicted from proprioception alone, AUC of a held-out logistic regression
plucks      careful and careless plucking
recording   CPU seconds an episode by latentsafe collect
balance     episodes, frames and failures of each dataset that scripts/collect_franka.sh recorded into data/
render      frames a second against MuJoCo's default visual settings

OMP_NUM_THREADS=1 python scripts/measure_franka.py spills variants ...
"""

import argparse

from lerobot_latentsafe.experiments.franka_measurements import PARTS, measure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="+", choices=PARTS)
    parser.add_argument("--n", type=int, help="episodes; each part has its own default")
    arguments = parser.parse_args()
    for part in arguments.parts:
        measure(part, arguments.n)


if __name__ == "__main__":
    main()
