#!/usr/bin/env python
"""CPU time per frame of drawing the Dubins car: our renderer against matplotlib.

    matplotlib  a figure a frame: ring, arrow and dot, written as PNG to memory and read back as RGB; 128 pixels
    single      `Renderer` with one state a call, as the environment uses it
    batch       `Renderer` with all states at once, as data collection and evaluation use it

Why it is fair: both draw the same scene (a red ring, a blue dot with an arrow along the heading, white ground) at the
same size from the same states and hand back the same kind of array; in turn, warmed up, on one thread, and CPU time
is counted. Drawing a figure a frame is how the data of the paper's authors are made; the few lines here are our own,
with matplotlib's quickest backend and an axes that fills the figure.

    OMP_NUM_THREADS=1 python scripts/bench_render.py --json=results/dubins/bench_render.json
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.dubins.renderer_cost import measure, report


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figures", type=int, default=50, help="frames a round with matplotlib (default 50)")
    parser.add_argument("--frames", type=int, default=2000, help="frames a round with ours (default 2000)")
    parser.add_argument("--repeats", type=int, default=7, help="timed rounds after one to warm up (default 7)")
    parser.add_argument("--seed", type=int, default=0, help="of the states (default 0)")
    parser.add_argument("--json", type=Path, help="where to write the results")
    parser.add_argument("--picture", type=Path, help="where to write one frame of each side by side, .png")
    args = parser.parse_args()
    report(measure(args.figures, args.frames, args.repeats, args.seed), args.json, args.picture, args.seed)


if __name__ == "__main__":
    main()
