"""Episodes of the blocks study, bare, filtered and under the privileged bound, and how long V warns before l does."""

from functools import cache, lru_cache

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from lerobot.envs import preprocess_observation
from matplotlib.figure import Figure

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.envs.configuration_envs import LatentSafeBlocksEnv
from lerobot_latentsafe.envs.franka_env import BlocksEnv
from lerobot_latentsafe.evaluation.statistics import check_environment
from lerobot_latentsafe.experiments.blocks.simulator_lookahead import SimulatorLookahead
from lerobot_latentsafe.franka.blocks import POINT_OF_NO_RETURN
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.policies.dreamer.modeling_dreamer import stored_world_model
from lerobot_latentsafe.runtime.checkpoint import read_config, resolve_checkpoint


@cache
def _env() -> BlocksEnv:
    return BlocksEnv()


@lru_cache(maxsize=1)
def load(dreamer: str, filter: str | None, mode: str, epsilon: float | None) -> BasePolicy | LatentSafePolicy:
    """The task policy, under a filter if there is one, by their paths; of a risk critic, epsilon is -eps_risk."""
    torch.set_num_threads(1)
    if filter is None:
        return BasePolicy(dreamer, "cpu")
    config = read_config(resolve_checkpoint(filter))
    config.device, config.mode, config.epsilon = "cpu", mode, epsilon
    policy = LatentSafePolicy.from_pretrained(filter, config=config)
    policy.attach(dreamer)
    check_environment(policy, LatentSafeBlocksEnv())
    return policy


def world_model_of(dreamer: str) -> str:
    """Path of a stored task policy's world model."""
    folder = resolve_checkpoint(dreamer)
    return stored_world_model(folder, read_config(folder))


def run(job: dict) -> dict:
    """One episode; the job holds seed, mode, and what `load` takes.

    Modes: bare; filter; lookahead, the filter that knows the simulator; monitor, in which a filter only looks on.

    Returns:
        success, the block was picked up and no red one fell (the paper's); violation; held, it is up at the end;
        leaning, the episode ended with a red block that has not fallen yet, but will; steps; overridden; of a violation
        that was looked on at, also margin and value, l and V of each step.
    """
    return run_filmed(job)[0]


@torch.no_grad()
def run_filmed(job: dict) -> tuple[dict, list[np.ndarray]]:
    """The row of `run`, and the front camera's pictures."""
    env, actor = _env(), load(job["dreamer"], job["filter"], job["mode"], job["epsilon"])
    torch.manual_seed(job["seed"])
    look_ahead = SimulatorLookahead(env.scene)
    observation, info = env.reset(seed=job["seed"])
    actor.reset()
    frames, latents, overridden, lifted, truncated = [], [], 0, False, False
    while not truncated:
        frames.append(observation["pixels"]["front"])
        batch = {**preprocess_observation(observation), "task": [env.task]}
        retreated = False
        if isinstance(actor, LatentSafePolicy):
            decision = actor.decide(batch)
            action, retreated = decision.action[0].numpy(), bool(decision.intervened)
            latents.append(actor.shield.latent)
        else:
            action = actor.propose(batch)[0].numpy()
        if job["mode"] == "lookahead":
            action, retreated = look_ahead(action)
            if retreated:
                actor.replan(torch.from_numpy(action).float()[None])
        overridden += retreated
        observation, _, _, truncated, info = env.step(action)
        lifted |= info["lifted"]
    failed = info["failure"]
    row = {
        "success": lifted and not failed, "violation": failed, "held": info["is_success"],
        "leaning": bool(info["tilt"] > POINT_OF_NO_RETURN) and not failed, "steps": env.steps, "overridden": overridden,
    }  # fmt: skip
    if job["mode"] == "monitor" and info["failure"]:
        row |= {name: column.tolist() for name, column in zip(("margin", "value"), values_along(actor, latents))}
    return row, frames


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
    ax.hist(distribution, bins=np.arange(min(distribution) - 0.5, max(distribution) + 1.5), color="tab:blue")
    ax.axvline(np.median(distribution), color="k", ls="--", label=f"median {np.median(distribution):g}")
    ax.set(xlabel="steps from the first V <= epsilon to the first l < 0", ylabel="failing rollouts")
    ax.legend()
    return figure
