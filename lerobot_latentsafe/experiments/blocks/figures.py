"""Pictures of the blocks study: an unsafe episode, the trade-off of thresholds, and how early V warns."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure


def unsafe_rollout(
    frames: list[np.ndarray], margin: np.ndarray, value: np.ndarray, epsilon: float, fps: int, n_frames: int = 8
) -> Figure:
    """Frames of a failing episode over l and V along it (the paper's figure)."""
    figure, axes = plt.subplot_mosaic(
        [[f"frame {i}" for i in range(n_frames)], ["curves"] * n_frames], figsize=(1.5 * n_frames, 4.2)
    )
    for i, t in enumerate(np.linspace(0, len(margin) - 1, n_frames).round().astype(int)):
        axes[f"frame {i}"].imshow(frames[t])
        axes[f"frame {i}"].set_title(f"t = {t}", fontsize=9)
        axes[f"frame {i}"].axis("off")
    time = np.arange(len(margin)) / fps
    axes["curves"].plot(time, margin, color="tab:gray", label="margin l")
    axes["curves"].plot(time, value, color="tab:blue", label="value V")
    axes["curves"].axhline(epsilon, color="k", lw=0.8, ls="--", label=f"epsilon = {epsilon:g}")
    axes["curves"].axhline(0, color="tab:red", lw=0.8)
    axes["curves"].set(xlabel="time (s)", ylim=(-1.05, 1.05))
    axes["curves"].legend(fontsize=8, loc="lower left")
    return figure


def trade_off(curves: dict[str, list[dict]], bare: dict) -> Figure:
    """Safe success against violations as the threshold of each filter varies: all seeds together, and each, thin.

    Args:
        curves: filter -> rows with `threshold`, `success` and `violation` as {k, n, low, high}, and those `per_seed`.
        bare: such a row of the policy without a filter.
    """
    figure, ax = plt.subplots(figsize=(6.4, 4.6))
    share = lambda row, name: 100 * row[name]["k"] / row[name]["n"]  # noqa: E731
    for name, rows in curves.items():
        x, y = ([share(row, kind) for row in rows] for kind in ("violation", "success"))
        (line,) = ax.plot(x, y, "o-", label=name)
        for seed in zip(*(row["per_seed"] for row in rows)):
            ax.plot(*([share(row, kind) for row in seed] for kind in ("violation", "success")), ".-", lw=0.6, ms=3,
                    alpha=0.6, color=line.get_color())  # fmt: skip
        for row, at in zip(rows, zip(x, y)):
            ax.annotate(f"{row['threshold']:g}", at, textcoords="offset points", xytext=(4, 4), fontsize=8,
                        color=line.get_color())  # fmt: skip
    ax.plot(share(bare, "violation"), share(bare, "success"), "k*", ms=12, label="no filter")
    ax.set(xlabel="violations (%)", ylabel="safe success (%)", xlim=(-2, None), ylim=(-2, 102))
    ax.legend()
    return figure


def leads(distribution: list[int]) -> Figure:
    """Histogram of how many steps V warns before l sees the failure."""
    figure, ax = plt.subplots(figsize=(5.2, 3.2))
    ax.hist(distribution, bins=np.arange(min(distribution) - 0.5, max(distribution) + 1.5).tolist(), color="tab:blue")
    ax.axvline(float(np.median(distribution)), color="k", ls="--", label=f"median {np.median(distribution):g}")
    ax.set(xlabel="steps from the first V <= epsilon to the first l < 0", ylabel="failing rollouts")
    ax.legend()
    return figure
