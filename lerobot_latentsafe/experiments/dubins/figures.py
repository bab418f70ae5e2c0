"""Pictures of the car: its value over the plane, and where it went."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.dubins.ground_truth import exact_value
from lerobot_latentsafe.evaluation.rollouts import Episodes
from lerobot_latentsafe.experiments.dubins.monitor import Monitor


def value_slices(monitors: dict[str, Monitor], turn_rates=tuple(car.TURN_RATES), n: int = 51) -> Figure:
    """V over (x, y) at headings 0 and 90 degrees, its zero level against the exact one (the paper's figure)."""
    headings = (0.0, np.pi / 2)
    figure, axes = plt.subplots(len(monitors), 2, figsize=(8.4, 3.9 * len(monitors)), squeeze=False)
    axis = np.linspace(-car.VIEW, car.VIEW, n)
    for row, (name, monitor) in zip(axes, monitors.items()):
        for ax, heading in zip(row, headings):
            x, y = np.meshgrid(axis, axis)
            states = np.stack([x.ravel(), y.ravel(), np.full(n * n, heading)], -1)
            value = monitor.value(states).reshape(n, n)
            exact = exact_value(states, turn_rates).reshape(n, n)
            scale = max(1e-6, np.abs(value).max())
            shade = ax.pcolormesh(x, y, value, cmap="RdBu", vmin=-scale, vmax=scale, shading="auto")
            ax.contour(x, y, value, [0.0], colors="k", linewidths=2)
            ax.contour(x, y, exact, [0.0], colors="k", linewidths=2, linestyles="--")
            ax.add_patch(plt.Circle((0, 0), car.RADIUS, fill=False, color="tab:red", lw=2))
            ax.arrow(-0.95, -0.95, 0.2 * np.cos(heading), 0.2 * np.sin(heading), width=0.015, color="tab:blue")
            ax.set(
                title=f"{name}: heading {np.degrees(heading):.0f}°",
                aspect="equal",
                xlabel="x (m)",
                ylabel="y (m)",
            )
            figure.colorbar(shade, ax=ax, label="V", shrink=0.8)
    figure.suptitle("solid: learned boundary V = 0, dashed: exact, red: failure set")
    figure.tight_layout()
    return figure


def trajectories(episodes: dict[str, Episodes]) -> Figure:
    """Where the car went; red where the failure set was entered, orange where the filter acted."""
    figure, axes = plt.subplots(1, len(episodes), figsize=(4.6 * len(episodes), 4.6), squeeze=False)
    for ax, (name, runs) in zip(axes[0], episodes.items()):
        for trace, violated in zip(runs.traces, runs.violation):
            path = np.array(trace["state"])
            ax.plot(path[:, 0], path[:, 1], color="tab:red" if violated else "tab:blue", lw=0.7, alpha=0.5)
            acted = np.flatnonzero(trace.get("intervened", []))
            ax.plot(path[acted, 0], path[acted, 1], ".", color="tab:orange", ms=2.5)
        ax.add_patch(plt.Circle((0, 0), car.RADIUS, color="tab:red", alpha=0.15))
        rate = runs.violation.mean()
        ax.set(title=f"{name}: {rate:.0%} enter the disc", aspect="equal", xlim=(-1.15, 1.15), ylim=(-1.15, 1.15))
        ax.set(xlabel="x (m)", ylabel="y (m)")
    figure.tight_layout()
    return figure
