#!/usr/bin/env python
"""Time of a whole tick at the robot's rate: the filter, and a diffusion policy whose chunks are made in another thread.

    OMP_NUM_THREADS=1 scripts/bench_tick.py --policy=bag --base=outputs/bag/diffusion_weak

Runs the bag at 15 Hz for some episodes, with chunks made on the control thread and off it in turns, and writes
results/bag/bench_tick.json: wall milliseconds from having the cameras' pictures to having an action (median and 99th
percentile), of the filter alone and of filter and policy together, and the share of ticks later than a period.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.bag.tick_time import write_times


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="bag")
    parser.add_argument("--base", required=True, help="a diffusion policy of the bag")
    parser.add_argument("--ahead", type=int, default=3, help="actions still to come when the next chunk is begun")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=90)
    parser.add_argument("--output", type=Path, default=Path("results/bag/bench_tick.json"))
    given = parser.parse_args()
    write_times(given.policy, given.base, given.ahead, given.rounds, given.steps, given.output)


if __name__ == "__main__":
    main()
