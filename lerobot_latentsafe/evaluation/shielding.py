"""Bare against shielded: the same policy from the same starts, with and without the filter."""

from dataclasses import dataclass, field

import numpy as np
import torch
from lerobot.envs import make_env, preprocess_observation
from lerobot.envs.configs import EnvConfig

from lerobot_latentsafe.evaluation.rollouts import paired_p_value, wilson
from lerobot_latentsafe.filter import FilterDecision, Reason
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.shield import BasePolicy
from lerobot_latentsafe.world_models.base import Latent, select


@dataclass
class Episodes:
    """Outcomes of n episodes, in the order of their seeds.

    Attributes:
        success, violation: bool (n,); violation: the failure set was entered at any time.
        steps: int (n,) steps driven.
        overridden: int (n,) steps at which the fallback acted.
        action_change: (n,) summed distance between executed and proposed action, robot units.
        traces: one dict of lists an episode: action, proposed, value, margin, intervened, reason, state.
        frames: RGB frames of the episodes asked for.
        latents: the filter's latents (1, ...) at each step of those.
    """

    success: np.ndarray
    violation: np.ndarray
    steps: np.ndarray
    overridden: np.ndarray
    action_change: np.ndarray
    traces: list[dict[str, list]] = field(default_factory=list)
    frames: list[list[np.ndarray]] = field(default_factory=list)
    latents: list[list[Latent]] = field(default_factory=list)

    def rates(self) -> dict:
        """Shares with Wilson intervals; success means safe success."""
        n = len(self.success)
        incomplete = ~self.success & ~self.violation
        return {
            "success": wilson(self.success.sum(), n),
            "violation": wilson(self.violation.sum(), n),
            "incompletion": wilson(incomplete.sum(), n),
            "overridden_share": float(self.overridden.sum() / self.steps.sum()),
            "mean_action_change": float(self.action_change.sum() / self.steps.sum()),
        }

    @classmethod
    def joined(cls, parts: "list[Episodes]") -> "Episodes":
        arrays = ("success", "violation", "steps", "overridden", "action_change")
        joined = {name: np.concatenate([getattr(p, name) for p in parts]) for name in arrays}
        lists = {name: [x for p in parts for x in getattr(p, name)] for name in ("traces", "frames", "latents")}
        return cls(**joined, **lists)


def check_environment(policy: LatentSafePolicy, env: EnvConfig) -> None:
    """Refuse an environment of another rate, action space or camera than the filter's.

    Raises:
        ValueError: naming what differs.
    """
    from lerobot.envs.utils import env_to_policy_features

    config, features = policy.config, env_to_policy_features(env)
    if env.fps != config.fps:
        raise ValueError(f"--env.fps is {env.fps}, the filter was trained at {config.fps} fps")
    if tuple(features["action"].shape) != (len(config.action_low),):
        raise ValueError(
            f"environment {env.type} takes actions of shape {tuple(features['action'].shape)}, the filter "
            f"{len(config.action_low)}: {', '.join(config.action_names)}"
        )
    missing = [key for key in (*config.cameras, "observation.state") if key not in features]
    if missing:
        raise ValueError(f"environment {env.type} lacks {', '.join(missing)}; it offers {', '.join(features)}")


def run_episodes(
    actor: BasePolicy | LatentSafePolicy, env: EnvConfig, n_episodes: int, seed: int,
    batch_size: int = 50, n_videos: int = 0,
) -> Episodes:  # fmt: skip
    """Run episodes with seeds seed, seed + 1, ...; equal seeds give equal starts.

    Args:
        actor: a bare policy, or a filter with or without a base policy.
        batch_size: environments stepped together.
        n_videos: of the first so many episodes, keep frames.
    """
    parts = []
    for first in range(0, n_episodes, batch_size):
        n = min(batch_size, n_episodes - first)
        torch.manual_seed(seed + first)  # a diffusion policy samples
        parts.append(_run_batch(actor, env, [seed + first + i for i in range(n)], max(0, n_videos - first)))
    return Episodes.joined(parts)


@torch.no_grad()
def _run_batch(actor: BasePolicy | LatentSafePolicy, env: EnvConfig, seeds: list[int], n_videos: int) -> Episodes:
    n, n_videos = len(seeds), min(n_videos, len(seeds))
    vector_env = next(iter(make_env(env, n_envs=n).values()))[0]
    task = vector_env.call("task_description")
    actor.reset()
    observation, info = vector_env.reset(seed=seeds)
    done, success = np.zeros(n, bool), np.zeros(n, bool)
    violation = np.asarray(info["failure"], bool).copy()
    steps, overridden, change = np.zeros(n, int), np.zeros(n, int), np.zeros(n)
    traces: list[dict[str, list]] = [{} for _ in range(n)]
    _record(traces, ~done, state=np.asarray(info["state"]) if "state" in info else None)
    render = lambda: vector_env.call("render")[:n_videos] if n_videos else ()  # noqa: E731
    frames = [[frame] for frame in render()]
    latents: list[list[Latent]] = [[] for _ in frames]
    while not done.all():
        batch = {**preprocess_observation(observation), "task": list(task)}
        action, decision = _act(actor, batch)
        alive = ~done
        steps += alive
        if decision is not None:
            _record(
                traces, alive, proposed=decision.proposed, value=decision.value, margin=decision.margin,
                intervened=decision.intervened, reason=decision.reason,
            )  # fmt: skip
            for i in np.flatnonzero(alive[:n_videos]):
                latents[i].append(select(actor.shield.latent, slice(i, i + 1)))
            overridden += alive & decision.intervened.cpu().numpy()
            moved = (decision.action - decision.proposed).norm(dim=-1).nan_to_num(0.0).cpu().numpy()
            change += np.where(alive, moved, 0.0)
        observation, _, terminated, truncated, info = vector_env.step(action)
        over = terminated | truncated
        final = info.get("final_info", info)
        for i in np.flatnonzero(alive):
            source = final if over[i] else info
            violation[i] |= bool(source["failure"][i])
            success[i] = bool(source["is_success"][i])
            if "state" in source:
                traces[i].setdefault("state", []).append(np.asarray(source["state"][i]).tolist())
        _record(traces, alive, action=torch.from_numpy(action))
        for kept, frame, running in zip(frames, render(), alive[:n_videos] & ~over[:n_videos]):
            if running:
                kept.append(frame)
        done |= over
    vector_env.close()
    return Episodes(success & ~violation, violation, steps, overridden, change, traces, frames, latents)


def _act(actor: BasePolicy | LatentSafePolicy, batch: dict) -> tuple[np.ndarray, FilterDecision | None]:
    if isinstance(actor, BasePolicy):
        return actor.propose(batch).cpu().numpy(), None
    batch = {k: v.to(actor.device) if isinstance(v, torch.Tensor) else v for k, v in batch.items()}
    decision = actor.decide(batch)
    return decision.action.cpu().numpy(), decision


def _record(traces: list[dict[str, list]], alive: np.ndarray, **columns) -> None:
    for name, values in columns.items():
        if values is None:
            continue
        values = values.tolist()
        for i in np.flatnonzero(alive):
            traces[i].setdefault(name, []).append(values[i])


def compare(policy: LatentSafePolicy, env: EnvConfig, n_episodes: int, seed: int, n_videos: int = 0) -> dict:
    """Bare and shielded from the same starts.

    Returns:
        bare, shielded: rates; violation_p_value: exact McNemar test on the pairs; episodes: both `Episodes`.
    """
    check_environment(policy, env)
    if policy.base is None:
        raise ValueError("nothing to shield: give --base_policy_path, or a checkpoint written by latentsafe wrap")
    bare = run_episodes(policy.base, env, n_episodes, seed, n_videos=n_videos)
    shielded = run_episodes(policy, env, n_episodes, seed, n_videos=n_videos)
    reasons = np.bincount([r for t in shielded.traces for r in t["reason"]], minlength=len(Reason))
    return {
        "bare": bare.rates(),
        "shielded": shielded.rates(),
        "violation_p_value": paired_p_value(bare.violation, shielded.violation),
        "reasons": {reason.name.lower(): int(reasons[reason]) for reason in Reason if reasons[reason]},
        "episodes": {"bare": bare, "shielded": shielded},
    }
