#!/usr/bin/env python
"""The moving picture of README: a reckless policy of the car, bare and shielded, from the same starts.

scripts/car_gif.py [--output=docs/images/car.gif]
"""

import argparse
import io
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from lerobot_latentsafe import evaluate_filter, load_filter
from lerobot_latentsafe.dubins.car import RADIUS
from lerobot_latentsafe.evaluation.rollouts import Episodes

TITLES = {"bare": "without a filter", "shielded": "with a filter"}
EVERY, LINGER, MS = 2, 12, 80
"""Steps a picture, pictures that stay at the end, milliseconds a picture."""


def paths(runs: Episodes) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of each run the positions (T, 2), and where the filter acted (T - 1,)."""
    return [
        (np.array(trace["state"])[:, :2], np.array(trace.get("intervened", [False] * (len(trace["state"]) - 1))))
        for trace in runs.traces
    ]


def picture(driven: dict[str, list], step: int) -> Image.Image:
    """Both panels after so many steps."""
    figure, axes = plt.subplots(1, 2, figsize=(7.2, 3.5), layout="constrained")
    for ax, (name, runs) in zip(axes, driven.items()):
        ax.add_patch(plt.Circle((0, 0), RADIUS, color="tab:red", alpha=0.25))
        for path, acted in runs:
            here = path[: step + 1]
            failed = (np.hypot(*here.T) < RADIUS).any()
            color = "tab:red" if failed else "tab:blue"
            ax.plot(*here.T, color=color, lw=1)
            ax.plot(*here[:-1][acted[: len(here) - 1]].T, ".", color="tab:orange", ms=4)
            ax.plot(*here[-1], "o", color=color, ms=5)
        ax.set(title=TITLES[name], aspect="equal", xlim=(-1.1, 1.1), ylim=(-1.1, 1.1), xticks=[], yticks=[])
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=100)
    plt.close(figure)
    return Image.open(drawn).convert("RGB").quantize(32, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("docs/images/car.gif"))
    parser.add_argument("--n", type=int, default=12)
    arguments = parser.parse_args()
    shielded = load_filter("dubins", base_policy="dubins_diffusion_reckless")
    episodes = evaluate_filter(shielded, "latentsafe_dubins", arguments.n)["episodes"]
    driven = {name: paths(runs) for name, runs in episodes.items()}
    last = max(len(path) for runs in driven.values() for path, _ in runs)
    pictures = [picture(driven, step) for step in range(0, last + EVERY, EVERY)]
    pictures += [pictures[-1]] * LINGER
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    pictures[0].save(arguments.output, save_all=True, append_images=pictures[1:], duration=MS, loop=0, optimize=True)
    print(f"{arguments.output}: {arguments.output.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
