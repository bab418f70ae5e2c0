"""Bare against shielded: the same policy from the same starts, with and without the filter."""

from dataclasses import dataclass, field, fields

import numpy as np
import torch
from lerobot.envs import make_env, preprocess_observation
from lerobot.envs.configs import EnvConfig

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.decision import FilterDecision, Reason
from lerobot_latentsafe.evaluation.nearest_frames import Album
from lerobot_latentsafe.evaluation.statistics import paired_p_value, wilson
from lerobot_latentsafe.latent import Latent, select
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy


@dataclass
class Episodes:
    """Outcomes of n episodes, in the order of their seeds.

    Attributes:
        success, violation: bool (n,); violation: the failure set was entered at any time.
        steps: int (n,) steps driven.
        overridden: int (n,) steps at which the fallback acted.
        action_change: (n,) summed distance between executed and proposed action, robot units.
        severity: (n,) the largest share spilled at any step; not a number where there is nothing to spill.
        traces: one dict of lists an episode: action, proposed, value, margin, intervened, reason, state.
        frames: RGB frames of the episodes asked for.
        latents: the filter's latents (1, ...) at each step of those.
    """

    success: np.ndarray
    violation: np.ndarray
    steps: np.ndarray
    overridden: np.ndarray
    action_change: np.ndarray
    severity: np.ndarray
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

    def only(self, i: int) -> "Episodes":
        """One of them."""
        return Episodes(*(getattr(self, f.name)[i : i + 1] for f in fields(self)))

    @classmethod
    def joined(cls, parts: "list[Episodes]") -> "Episodes":
        arrays = ("success", "violation", "steps", "overridden", "action_change", "severity")
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
    batch_size: int = 50, n_videos: int = 0, album: Album | None = None,
) -> Episodes:  # fmt: skip
    """Run episodes with seeds seed, seed + 1, ...; equal seeds give equal starts.

    Args:
        actor: a bare policy, or a filter with or without a base policy.
        batch_size: environments stepped together.
        n_videos: of the first so many episodes, keep frames.
        album: put these frames in, too.
    """
    parts = []
    for first in range(0, n_episodes, batch_size):
        n = min(batch_size, n_episodes - first)
        torch.manual_seed(seed + first)  # a diffusion policy samples
        parts.append(_run_batch(actor, env, [seed + first + i for i in range(n)], max(0, n_videos - first), album))
    return Episodes.joined(parts)


@torch.no_grad()
def _run_batch(
    actor: BasePolicy | LatentSafePolicy, env: EnvConfig, seeds: list[int], n_videos: int, album: Album | None
) -> Episodes:
    vector_env = next(iter(make_env(env, n_envs=len(seeds)).values()))[0]
    task = vector_env.call("task_description")
    actor.reset()
    observation, info = vector_env.reset(seed=seeds)
    render = lambda: vector_env.call("render")[:n_videos] if n_videos else []  # noqa: E731
    runs, done = _begun(info, render()), np.zeros(len(seeds), bool)
    while not done.all():
        batch = {**preprocess_observation(observation), "task": list(task)}
        alive, filmed = ~done, np.flatnonzero(~done[:n_videos])
        if album is not None and len(filmed):
            seen = {key: batch[key][filmed] for key in album.policy.world_model.image_keys}
            album.add([runs.frames[i][-1] for i in filmed], seen, batch["observation.state"][filmed])
        action, decision = _act(actor, batch)
        runs.steps[alive] += 1
        if decision is not None:
            _note_decision(runs, decision, alive)
            for i in filmed:
                runs.latents[i].append(select(actor.shield.latent, slice(i, i + 1)))
        observation, _, terminated, truncated, info = vector_env.step(action)
        over = terminated | truncated
        final = info.get("final_info", info)
        for i in np.flatnonzero(alive):
            _note_outcome(runs, i, final if over[i] else info)
        _record(runs.traces, alive, action=torch.from_numpy(action))
        pictures = render()
        for i in filmed[~over[filmed]]:
            runs.frames[i].append(pictures[i])
        done |= over
    vector_env.close()
    runs.success &= ~runs.violation
    return runs


def _begun(info: dict, pictures: list[np.ndarray]) -> Episodes:
    """Episodes of which the first frame has been seen."""
    violation = np.array(info["failure"], bool)
    n = len(violation)
    runs = Episodes(
        success=np.zeros(n, bool), violation=violation, steps=np.zeros(n, int), overridden=np.zeros(n, int),
        action_change=np.zeros(n), severity=np.full(n, np.nan),
        traces=[{} for _ in range(n)], frames=[[p] for p in pictures], latents=[[] for _ in pictures],
    )  # fmt: skip
    _record(runs.traces, np.ones(n, bool), state=np.asarray(info["state"]) if "state" in info else None)
    return runs


def _note_decision(runs: Episodes, decision: FilterDecision, alive: np.ndarray) -> None:
    _record(
        runs.traces, alive, proposed=decision.proposed, value=decision.value, margin=decision.margin,
        intervened=decision.intervened, reason=decision.reason,
    )  # fmt: skip
    runs.overridden[alive & decision.intervened.cpu().numpy()] += 1
    moved = (decision.action - decision.proposed).norm(dim=-1).nan_to_num(0.0).cpu().numpy()
    runs.action_change[alive] += moved[alive]


def _note_outcome(runs: Episodes, i: int, info: dict) -> None:
    """What the environment said of episode i after a step."""
    runs.violation[i] |= bool(info["failure"][i])
    runs.success[i] = bool(info["is_success"][i])
    if "spill_fraction" in info:
        runs.severity[i] = np.fmax(runs.severity[i], info["spill_fraction"][i])
    if "state" in info:
        runs.traces[i].setdefault("state", []).append(np.asarray(info["state"][i]).tolist())


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


def compare(
    policy: LatentSafePolicy, env: EnvConfig, n_episodes: int, seed: int, n_videos: int = 0, album: Album | None = None
) -> dict:
    """Bare and shielded from the same starts; the frames of the first n_videos episodes are kept, and go to the album.

    Returns:
        bare, shielded: rates; violation_p_value: exact McNemar test on the pairs; episodes: both `Episodes`.
    """
    check_environment(policy, env)
    if policy.base is None:
        raise ValueError("nothing to shield: give --base_policy_path, or a checkpoint written by latentsafe wrap")
    bare = run_episodes(policy.base, env, n_episodes, seed, n_videos=n_videos, album=album)
    shielded = run_episodes(policy, env, n_episodes, seed, n_videos=n_videos, album=album)
    return {
        "bare": bare.rates(),
        "shielded": shielded.rates(),
        "violation_p_value": paired_p_value(bare.violation, shielded.violation),
        "reasons": count_reasons([reason for trace in shielded.traces for reason in trace["reason"]]),
        "episodes": {"bare": bare, "shielded": shielded},
    }


def count_reasons(reasons: "np.ndarray | list[int]") -> dict[str, int]:
    """How many decisions were made for each reason that occurs."""
    counts = np.bincount(reasons, minlength=len(Reason))
    return {reason.name.lower(): int(counts[reason]) for reason in Reason if counts[reason]}
