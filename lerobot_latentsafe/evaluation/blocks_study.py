"""What the blocks study measures beyond rates: the privileged bound, and how long V warns before l does."""

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from lerobot.envs import preprocess_observation
from matplotlib.figure import Figure

from lerobot_latentsafe.baselines.simulator import SimulatorLookahead
from lerobot_latentsafe.envs.franka_env import BlocksEnv
from lerobot_latentsafe.evaluation.shielding import Episodes
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.shield import BasePolicy
from lerobot_latentsafe.world_models.base import Latent


def lookahead_episodes(base: BasePolicy, n_episodes: int, seed: int) -> Episodes:
    """A policy under `SimulatorLookahead`, from the starts of `run_episodes` with the same seed."""
    env = BlocksEnv()
    look_ahead, outcomes = SimulatorLookahead(env.scene), []
    for episode in range(n_episodes):
        observation, info = env.reset(seed=seed + episode)
        base.reset()
        overridden, change, truncated = 0, 0.0, False
        while not truncated:
            batch = {**preprocess_observation(observation), "task": [env.task]}
            proposed = base.propose(batch)[0].cpu().numpy()
            action, retreated = look_ahead(proposed)
            if retreated:
                base.replan(torch.from_numpy(action).float()[None])
            overridden, change = overridden + retreated, change + float(np.linalg.norm(action - proposed))
            observation, _, _, truncated, info = env.step(action)
        outcomes.append((info["is_success"], info["failure"], env.steps, overridden, change))
    env.close()
    success, violation, steps, overridden, change = map(np.array, zip(*outcomes))
    success, violation = success.astype(bool), violation.astype(bool)
    return Episodes(success & ~violation, violation, steps, overridden, change, np.full(n_episodes, np.nan))


@torch.no_grad()
def values_along(policy: LatentSafePolicy, latents: list[Latent]) -> tuple[np.ndarray, np.ndarray]:
    """l and V at each latent of an episode itself, not one step on: (T,) each."""
    together = {key: torch.cat([latent[key] for latent in latents]) for key in latents[0]}
    return policy.imagination.margin(together).cpu().numpy(), policy.value(together).cpu().numpy()


def lead(margin: np.ndarray, value: np.ndarray, epsilon: float) -> int | None:
    """Steps from the first V <= epsilon to the first l < 0 of an episode (T,); negative: V comes later, or never.

    A V that never warns counts as warning at the end. None: l never sees a failure.
    """
    failing, warned = np.flatnonzero(margin < 0), np.flatnonzero(value <= epsilon)
    if not len(failing):
        return None
    return int(failing[0] - (warned[0] if len(warned) else len(value)))


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
    """Safe success against violations as the threshold of each filter varies.

    Args:
        curves: filter -> rows with `threshold`, `success` and `violation` as {k, n, low, high}.
        bare: such a row of the policy without a filter.
    """
    figure, ax = plt.subplots(figsize=(6.4, 4.6))
    share = lambda row, name: 100 * row[name]["k"] / row[name]["n"]  # noqa: E731
    for name, rows in curves.items():
        x, y = ([share(row, kind) for row in rows] for kind in ("violation", "success"))
        (line,) = ax.plot(x, y, "o-", label=name)
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
    ax.hist(distribution, bins=np.arange(min(distribution) - 0.5, max(distribution) + 1.5), color="tab:blue")
    ax.axvline(np.median(distribution), color="k", ls="--", label=f"median {np.median(distribution):g}")
    ax.set(xlabel="steps from the first V <= epsilon to the first l < 0", ylabel="failing rollouts")
    ax.legend()
    return figure
