"""CPU time per frame of drawing the Dubins car: our renderer against matplotlib."""

import io
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.timing import cpu_seconds, ratio, spread

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


def measure(n_figures: int, n_frames: int, repeats: int, seed: int) -> dict:
    """Milliseconds a frame of each way, and ratios.

    Args:
        n_figures, n_frames: a round with matplotlib, and with ours.
        repeats: timed rounds after one to warm up.
        seed: of the states.
    """
    states, renderer = random_states(n_frames, seed), car.Renderer(SIZE)
    rounds = {
        "matplotlib": (n_figures, lambda: [draw_with_matplotlib(s) for s in states[:n_figures]]),
        "single": (n_frames, lambda: [renderer(s[None])[0] for s in states]),
        "batch": (n_frames, lambda: renderer(states)),
    }
    cost: dict[str, list[float]] = {name: [] for name in rounds}
    for i in range(1 + repeats):
        for name, (n, draw) in rounds.items():
            seconds = cpu_seconds(draw)
            if i:
                cost[name].append(seconds / n * 1000)
    return {
        "what": "CPU milliseconds (user and system) per 128 x 128 frame of the car",
        "rounds": repeats,
        "ms_per_frame": {name: spread(values) for name, values in cost.items()},
        "matplotlib_over": {name: ratio(cost["matplotlib"], cost[name]) for name in ("single", "batch")},
        "matplotlib_version": matplotlib.__version__,
        **provenance([seed]),
    }


def random_states(n: int, seed: int) -> np.ndarray:
    """Of the car, (n, 3)."""
    return np.random.default_rng(seed).uniform([-1, -1, -np.pi], [1, 1, np.pi], (n, 3))


def report(row: dict, output: Path | None, picture: Path | None, seed: int) -> None:
    """Print what was measured, and write it, and one frame of each side by side, if asked for."""
    for name, values in row["ms_per_frame"].items():
        print(f"{name:10s} {values['median']:8.4f} ms a frame ({values['low']:.4f} to {values['high']:.4f})")
    for name, values in row["matplotlib_over"].items():
        print(f"{name:10s} {values['median']:8.1f} times ({values['low']:.1f} to {values['high']:.1f})")
    if output:
        write_json(output, row)
    if picture:
        (state,) = random_states(1, seed)
        Image.fromarray(np.hstack([draw_with_matplotlib(state), car.Renderer(SIZE)(state[None])[0]])).save(picture)
