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
import io
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from PIL import Image

from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.evaluation.statistics import provenance, write_json

SIZE = 128


def draw_with_matplotlib(state: np.ndarray) -> np.ndarray:
    """One frame (SIZE, SIZE, 3) uint8 of a state (3,)."""
    x, y, heading = state
    fig = plt.figure(figsize=(1, 1), dpi=SIZE)
    ax = fig.add_axes((0, 0, 1, 1), xlim=(-car.VIEW, car.VIEW), ylim=(-car.VIEW, car.VIEW))
    ax.set_axis_off()
    ax.add_patch(plt.Circle((0, 0), car.RADIUS, fill=False, color="red"))
    length = car.Renderer.arrow_length
    ax.quiver(
        [x], [y], [length * np.cos(heading)], [length * np.sin(heading)],
        angles="xy", scale_units="xy", scale=1, width=0.04, color="blue",
    )  # fmt: skip
    ax.scatter([x], [y], s=13, color="blue")
    file = io.BytesIO()
    fig.savefig(file, format="png")
    plt.close(fig)
    file.seek(0)
    return np.asarray(Image.open(file).convert("RGB"))


def seconds_of(draw: Callable[[], object]) -> float:
    began = time.process_time()
    draw()
    return time.process_time() - began


def spread(values: list[float]) -> dict[str, float]:
    """Median and range."""
    return {"median": statistics.median(values), "low": min(values), "high": max(values)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figures", type=int, default=50, help="frames a round with matplotlib (default 50)")
    parser.add_argument("--frames", type=int, default=2000, help="frames a round with ours (default 2000)")
    parser.add_argument("--repeats", type=int, default=7, help="timed rounds after one to warm up (default 7)")
    parser.add_argument("--seed", type=int, default=0, help="of the states (default 0)")
    parser.add_argument("--json", type=Path, help="where to write the results")
    parser.add_argument("--picture", type=Path, help="where to write one frame of each side by side, .png")
    args = parser.parse_args()
    states = np.random.default_rng(args.seed).uniform([-1, -1, -np.pi], [1, 1, np.pi], (args.frames, 3))
    renderer = car.Renderer(SIZE)

    rounds = {
        "matplotlib": (args.figures, lambda: [draw_with_matplotlib(s) for s in states[: args.figures]]),
        "single": (args.frames, lambda: [renderer(s[None])[0] for s in states]),
        "batch": (args.frames, lambda: renderer(states)),
    }
    cost: dict[str, list[float]] = {name: [] for name in rounds}
    for i in range(1 + args.repeats):
        for name, (n, draw) in rounds.items():
            seconds = seconds_of(draw)
            if i:
                cost[name].append(seconds / n * 1000)

    row = {
        "what": "CPU milliseconds (user and system) per 128 x 128 frame of the car",
        "rounds": args.repeats,
        "ms_per_frame": {name: spread(values) for name, values in cost.items()},
        "matplotlib_over": {
            name: spread([m / o for m, o in zip(cost["matplotlib"], cost[name])]) for name in ("single", "batch")
        },
        "matplotlib_version": matplotlib.__version__,
        **provenance([args.seed]),
    }
    for name, values in row["ms_per_frame"].items():
        print(f"{name:10s} {values['median']:8.4f} ms a frame ({values['low']:.4f} to {values['high']:.4f})")
    for name, values in row["matplotlib_over"].items():
        print(f"{name:10s} {values['median']:8.1f} times ({values['low']:.1f} to {values['high']:.1f})")
    if args.json:
        write_json(args.json, row)
    if args.picture:
        Image.fromarray(np.hstack([draw_with_matplotlib(states[0]), renderer(states[:1])[0]])).save(args.picture)


if __name__ == "__main__":
    main()
