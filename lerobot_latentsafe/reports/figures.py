"""Pictures where people would rather look."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.evaluation.rollouts import Episodes
from lerobot_latentsafe.evaluation.statistics import wilson
from lerobot_latentsafe.runtime.files import replacing, scratch_folder


def save(figure: Figure, path: str | Path) -> None:
    """Write a PNG, or what the name ends in, making folders as needed."""
    with replacing(path) as partial:
        figure.savefig(partial, format=Path(path).suffix.removeprefix(".") or "png", dpi=110, bbox_inches="tight")
    plt.close(figure)


def severities(episodes: dict[str, Episodes]) -> Figure:
    """Share of the runs that spilled at least so much, with Wilson intervals (the paper's figure)."""
    figure, ax = plt.subplots(figsize=(6, 3.2))
    shares = np.linspace(0.01, 1, 100)
    for (name, runs), colour in zip(episodes.items(), ("tab:red", "tab:blue")):
        rates = [wilson((runs.severity >= share - 1e-9).sum(), len(runs.severity)) for share in shares]
        ax.plot(100 * shares, [100 * rate["k"] / rate["n"] for rate in rates], color=colour, label=name)
        low, high = ([100 * rate[end] for rate in rates] for end in ("low", "high"))
        ax.fill_between(100 * shares, low, high, color=colour, alpha=0.15)
    ax.set(xlabel="at least so much spilled (%)", ylabel="runs (%)", xlim=(0, 100), ylim=(0, 102))
    ax.legend()
    return figure


def value_trace(trace: dict[str, list], epsilon: float) -> Figure:
    """V and l along one shielded episode, the filter's moments shaded."""
    t = np.arange(len(trace["value"])) * car.DT
    figure, ax = plt.subplots(figsize=(7, 2.8))
    ax.plot(t, trace["value"], label="V of the predicted next latent", color="tab:blue")
    ax.plot(t, trace["margin"], label="margin l of the current latent", color="tab:gray")
    ax.axhline(epsilon, color="k", lw=0.8, ls="--", label=f"epsilon = {epsilon:g}")
    acted = np.array(trace["intervened"], bool)
    ax.fill_between(t, -1, 1, where=acted, color="tab:orange", alpha=0.3, label="filter acts")
    ax.set(xlabel="time (s)", ylim=(-1, 1))
    ax.legend(fontsize=8, loc="lower right")
    return figure


def severity(lost: dict[str, list[int]], n_candies: int) -> Figure:
    """Share of runs that spill at least p% of the candies, over p.

    Args:
        lost: name -> candies lost in each run; `who, shielded` is drawn in the colour of `who`, solid, others dashed.
    """
    figure, ax = plt.subplots(figsize=(5.6, 3.4))
    level = np.array([1, *range(1, n_candies + 1)])  # any candy at all, then one more a step
    p = 100 * np.arange(n_candies + 1) / n_candies
    colours = {who: f"C{i}" for i, who in enumerate(dict.fromkeys(name.split(",")[0] for name in lost))}
    for name, candies in lost.items():
        share = (np.asarray(candies) >= level[:, None]).mean(1)
        style, colour = "-" if name.endswith("shielded") else "--", colours[name.split(",")[0]]
        ax.step(p, share, style, where="pre", color=colour, label=f"{name} (n = {len(candies)})")
    ax.set(
        xlabel="p, share of the candies (%)", ylabel="runs that spill at least p%", xlim=(0, 100), ylim=(-0.02, 1.02)
    )
    ax.legend(fontsize=8)
    return figure


def value_profiles(panels: dict[str, list[dict[str, list]]], epsilon: float, fps: int) -> Figure:
    """V over time, a panel a situation: orange where the filter acts, grey lines where a candy first falls out.

    Args:
        panels: title -> episodes, each with value, intervened and spilled (candies outside) step by step.
    """
    figure, axes = plt.subplots(1, len(panels), figsize=(2.7 * len(panels), 2.6), sharey=True, squeeze=False)
    for ax, (title, episodes) in zip(axes[0], panels.items()):
        for episode in episodes:
            value, acted = np.array(episode["value"]), np.array(episode["intervened"], bool)
            t, spilled = np.arange(len(value)) / fps, np.flatnonzero(episode["spilled"])
            ax.plot(t, value, color="tab:blue", lw=1, alpha=0.8)
            ax.plot(t[acted], value[acted], ".", color="tab:orange", ms=4)
            for first in spilled[:1]:
                ax.axvline(t[first], color="0.6", lw=1)
        ax.axhline(epsilon, color="k", lw=0.8, ls="--")
        ax.set(title=title, xlabel="time (s)", ylim=(-1.05, 1.05))
    axes[0, 0].set(ylabel=f"V (dashed: epsilon = {epsilon:g})")
    figure.tight_layout()
    return figure


def imagined_futures(
    seen: np.ndarray, rows: dict[str, dict[str, list[np.ndarray | None]]], moments: Sequence[str]
) -> Figure:
    """What follows one frame under different actions: a row for each who tells it, the actions side by side.

    Args:
        seen: (H, W, 3), the frame.
        rows: who -> what is done -> a picture (H, W, 3) a moment; None where nothing is told.
        moments: their names.
    """
    actions = list(next(iter(rows.values())))
    shape = len(rows), 1 + len(actions) * len(moments)
    figure, axes = plt.subplots(*shape, figsize=(1.1 * shape[1], 1.15 * shape[0] + 0.5), squeeze=False)
    for row, (who, told) in zip(axes, rows.items()):
        pictures = [seen, *(picture for done in actions for picture in told[done])]
        for ax, picture in zip(row, pictures):
            ax.set(xticks=[], yticks=[], frame_on=False)
            if picture is not None:
                ax.imshow(picture)
        row[0].set_ylabel(who, fontsize=9)
    axes[0, 0].set_title("seen", fontsize=9)
    for i, (done, moment) in enumerate(product(actions, moments), 1):
        axes[0, i].set_title(f"{done}\n{moment}" if moment == moments[0] else f"\n{moment}", fontsize=9, loc="left")
    figure.subplots_adjust(wspace=0.04, hspace=0.04)
    return figure


def misses_and_alarms(rows: list[dict[str, float]], alpha: float, chosen: float | None = None) -> Figure:
    """Shares of missed failing episodes and of overridden safe ones over epsilon, each below its 95% bound.

    Args:
        rows: see `calibration.curve`.
        alpha: share of misses that was asked for.
        chosen: epsilon.
    """
    figure, ax = plt.subplots(figsize=(6, 3.4))
    epsilon = [row["epsilon"] for row in rows]
    kinds = (("missed", "failing, missed", "tab:red"), ("false_alarms", "safe, overridden", "tab:blue"))
    for name, what, colour in kinds:
        share, bound = ([100 * row[key] for row in rows] for key in (name, f"{name}_at_most"))
        ax.step(epsilon, share, where="post", color=colour, label=what)
        ax.fill_between(epsilon, share, bound, step="post", color=colour, alpha=0.15)
    ax.axhline(100 * alpha, color="tab:red", lw=0.8, ls=":", label=f"alpha = {alpha:.3g}")
    if chosen is not None:
        ax.axvline(chosen, color="k", lw=0.8, ls="--", label=f"epsilon = {chosen:.3g}")
    ax.set(xlabel="epsilon", ylabel="episodes (%); shaded: up to the 95% bound", ylim=(-2, 102))
    ax.legend(fontsize=8)
    return figure


def causes_of_misses(studies: dict[str, dict[str, int]]) -> Figure:
    """A bar for each study: of its missed episodes, the share due to each cause.

    Args:
        studies: name -> cause -> missed episodes.
    """
    figure, ax = plt.subplots(figsize=(6.4, 1.1 + 0.5 * len(studies)))
    names = [f"{name} (n = {sum(causes.values())})" for name, causes in studies.items()]
    left = np.zeros(len(studies))
    for cause in next(iter(studies.values())):
        share = np.array([100 * causes[cause] / max(1, sum(causes.values())) for causes in studies.values()])
        ax.barh(names, share, left=left, label=cause.replace("_", " "))
        left += share
    ax.set(xlabel="missed failing episodes (%)", xlim=(0, 100))
    ax.invert_yaxis()
    ax.legend(fontsize=8, ncols=5, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


def write_videos(runs: dict[str, Episodes], folder: str | Path, fps: int = car.FPS) -> list[Path]:
    """One mp4 an episode, bare and shielded side by side, an orange frame while the filter acts."""
    paths = []
    for i in range(min(len(r.frames) for r in runs.values())):
        columns = {name: (r.frames[i], r.traces[i].get("intervened", [])) for name, r in runs.items()}
        paths.append(write_side_by_side(columns, Path(folder) / f"episode_{i:03d}.mp4", fps))
    return paths


def write_side_by_side(columns: dict[str, tuple[list[np.ndarray], list[bool]]], path: Path, fps: int) -> Path:
    """An mp4 of runs beside each other: name -> RGB frames, and at which of them the filter acts."""
    import cv2
    from lerobot.utils.io_utils import write_video

    length, drawn = max(len(frames) for frames, _ in columns.values()), []
    for name, (frames, acted) in columns.items():
        frames = [cv2.resize(f, (256, 256), interpolation=cv2.INTER_NEAREST) for f in frames]
        for t, frame in enumerate(frames):
            cv2.putText(frame, name, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (40, 40, 40), 1, cv2.LINE_AA)
            if t < len(acted) and acted[t]:
                cv2.rectangle(frame, (0, 0), (255, 255), (255, 140, 0), 6)
        drawn.append(frames + [frames[-1]] * (length - len(frames)))
    with replacing(path) as partial, scratch_folder(path) as scratch:
        write_video(scratch / path.name, [np.concatenate(pair, 1) for pair in zip(*drawn)], fps)
        (scratch / path.name).replace(partial)
    return path
