"""The one loop over episodes, and what it is there for: a policy bare and shielded, from the same starts.

A world holds episodes side by side, an actor chooses their actions, and `steps` drives them on. Whoever measures
something accumulates it from the steps: rates here, tables of a study in `experiments`, datasets in `collection`.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from lerobot.envs import make_env, preprocess_observation
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.utils.constants import OBS_IMAGE, OBS_STATE

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.decision import FilterDecision, Reason
from lerobot_latentsafe.evaluation.nearest_frames import NearestFrames
from lerobot_latentsafe.evaluation.statistics import paired_p_value, wilson
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.latent import Latent, select
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

TOGETHER = 50
"""Episodes that run side by side, if nothing else is said. Where a policy samples, it draws for all of them at once."""

# -- the loop ---


class Choice(NamedTuple):
    """What an actor wants done next."""

    action: Any
    """In robot units, as the world takes it: (B, A) of most."""
    decision: FilterDecision | None = None
    """The filter's, if there is one."""


class World(Protocol):
    """Episodes that have begun, side by side.

    Attributes:
        info: what is known of where they are now, beyond what an actor sees; of what kind, each world says.
    """

    info: Any

    @property
    def over(self) -> np.ndarray:
        """Which of them have ended: bool (B,)."""

    def observe(self) -> Any:
        """What an actor sees now: of most worlds a LeRobot batch."""

    def step(self, action: Any) -> None:
        """Go on to the next state; episodes that have ended may go anywhere."""


Actor = Callable[[Any], Choice]
"""Chooses what to do about what it sees, for the length of the episodes of one world."""


@dataclass(frozen=True)
class Step:
    """One step of the episodes of a world.

    Attributes:
        seen: what the actor saw.
        action: what was executed.
        decision: the filter's, if there is one.
        before, info: what was known of the state that was left, and of the one that was reached.
        alive: bool (B,), episodes that had not ended before.
    """

    seen: Any
    action: Any
    decision: FilterDecision | None
    before: Any
    info: Any
    alive: np.ndarray


def steps(world: World, actor: Actor) -> Iterator[Step]:
    """Drive the episodes of a world on until all have ended."""
    while not world.over.all():
        seen, before, alive = world.observe(), world.info, ~world.over
        choice = actor(seen)
        world.step(choice.action)
        yield Step(seen, choice.action, choice.decision, before, world.info, alive)


class PolicyActor:
    """A bare policy, or a filter with or without a base policy, from the beginning of episodes on."""

    def __init__(self, policy: BasePolicy | LatentSafePolicy):
        if isinstance(policy, LatentSafePolicy):
            policy.shield.clock = standing_still  # worlds wait for what is done in them
        policy.reset()
        self.policy = policy

    @property
    def latent(self) -> Latent | None:
        """What a filter's last decision was made on."""
        return self.policy.shield.latent if isinstance(self.policy, LatentSafePolicy) else None

    @torch.no_grad()
    def __call__(self, batch: dict[str, Any]) -> Choice:
        if not isinstance(self.policy, LatentSafePolicy):
            return Choice(self.policy.propose(batch).cpu().numpy())
        device = self.policy.model.device
        decision = self.policy.decide({k: v.to(device) if isinstance(v, torch.Tensor) else v for k, v in batch.items()})
        return Choice(decision.action.cpu().numpy(), decision)


class VectorWorld:
    """LeRobot's environments, one for each seed; `info` is a dict for each of them.

    Attributes:
        timed_out: bool (B,), episodes that ended because their time was up, and for nothing else.

    Raises:
        ValueError: an environment that does not tell what failed.
    """

    def __init__(self, env: EnvConfig, seeds: Sequence[int]):
        self.envs = next(iter(make_env(env, n_envs=len(seeds)).values()))[0]
        self.over, self.timed_out = np.zeros((2, len(seeds)), bool)
        self._observation, info = self.envs.reset(seed=list(seeds))
        self.info = [_row(info, i) for i in range(len(seeds))]
        if not all("failure" in row for row in self.info):
            raise ValueError(
                f"environment {env.type} tells no `failure` in its info, so nothing says what a filter prevents; it "
                f"tells {', '.join(self.info[0]) or 'nothing'}. Run a wrapped policy in it with lerobot-eval"
            )
        self.task = self._tasks()

    def _tasks(self) -> list[str]:
        """Each environment's task in words, under the names that LeRobot looks for."""
        for name in ("task_description", "task"):
            with suppress(AttributeError, NotImplementedError):
                return list(self.envs.call(name))
        return [""] * self.envs.num_envs

    def observe(self) -> dict[str, Any]:
        """A LeRobot batch."""
        return {**preprocess_observation(self._observation), "task": self.task}

    def step(self, action: np.ndarray) -> None:
        """Act (B, A) in robot units."""
        self._observation, _, terminated, truncated, info = self.envs.step(action)
        ended = terminated | truncated
        final = info.get("final_info", info)  # an environment whose episode has ended begins another at once
        self.info = [_row(final if ended[i] else info, i) for i in range(len(ended))]
        self.timed_out = self.timed_out | (truncated & ~terminated & ~self.over)
        self.over = self.over | ended

    def render(self, n: int) -> list[np.ndarray]:
        """RGB pictures of the first n."""
        return self.envs.call("render")[:n] if n else []

    def close(self) -> None:
        """Free what the environments hold."""
        self.envs.close()


def _row(info: dict[str, Any], i: int) -> dict[str, Any]:
    """What a vector environment's info says of one environment."""
    return {name: values[i] for name, values in info.items() if name[0] != "_" and isinstance(values, np.ndarray)}


# -- bare against shielded ---


@dataclass
class Episodes:
    """Outcomes of n episodes, in the order of their seeds.

    Attributes:
        success, violation, stall: bool (n,); violation: the failure set was entered at any time; stall: neither, until
            the time was up.
        steps: int (n,) steps driven.
        overridden: int (n,) steps at which the filter acted.
        action_change: (n,) summed distance between executed and proposed action, robot units.
        severity: (n,) of the failure at its worst, 0 to 1; not a number where the environment tells none.
        traces: one dict of lists an episode: action, proposed, value, margin, intervened, reason, state.
        frames: RGB frames of the episodes asked for.
        latents: the filter's latents (1, ...) at each step of those.
    """

    success: np.ndarray
    violation: np.ndarray
    stall: np.ndarray
    steps: np.ndarray
    overridden: np.ndarray
    action_change: np.ndarray
    severity: np.ndarray
    traces: list[dict[str, list]] = field(default_factory=list)
    frames: list[list[np.ndarray]] = field(default_factory=list)
    latents: list[list[Latent]] = field(default_factory=list)

    def rates(self) -> dict:
        """Shares with Wilson intervals. Success means safe success; incompletion, a stall or another end without it."""
        n = len(self.success)
        incomplete = ~self.success & ~self.violation
        return {
            "success": wilson(self.success.sum(), n),
            "violation": wilson(self.violation.sum(), n),
            "stall": wilson(self.stall.sum(), n),
            "incompletion": wilson(incomplete.sum(), n),
            "overridden_share": float(self.overridden.sum() / self.steps.sum()),
            "mean_action_change": float(self.action_change.sum() / self.steps.sum()),
        }

    def only(self, i: int) -> "Episodes":
        """One of them."""
        return Episodes(*(getattr(self, f.name)[i : i + 1] for f in fields(self)))

    @classmethod
    def joined(cls, parts: "list[Episodes]") -> "Episodes":
        """All of these, one after the other."""
        arrays = ("success", "violation", "stall", "steps", "overridden", "action_change", "severity")
        joined: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts]) for name in arrays}
        for name in ("traces", "frames", "latents"):
            joined[name] = [x for p in parts for x in getattr(p, name)]
        return cls(**joined)


def check_environment(policy: LatentSafePolicy, env: EnvConfig) -> None:
    """Refuse an environment of another rate, action space or camera than the filter's.

    Raises:
        ValueError: naming what differs.
    """
    trained_on, features = policy.config.trained_on, env_to_policy_features(env)
    if env.fps != trained_on.fps:
        raise ValueError(f"--env.fps is {env.fps}, the filter was trained at {trained_on.fps} fps")
    if tuple(features["action"].shape) != (len(trained_on.action_low),):
        raise ValueError(
            f"environment {env.type} takes actions of shape {tuple(features['action'].shape)}, the filter "
            f"{len(trained_on.action_low)}: {', '.join(trained_on.action_names)}"
        )
    missing = [key for key in policy.model.inputs if key not in features]
    if missing:
        raise ValueError(f"environment {env.type} lacks {', '.join(missing)}; it offers {', '.join(features)}")


def check_shielding(policy: LatentSafePolicy, env: EnvConfig) -> None:
    """Refuse a filter without a base policy, and an environment that is not the filter's.

    Raises:
        ValueError: with the remedy, or naming what differs.
    """
    check_environment(policy, env)
    if policy.base is None:
        raise ValueError("nothing to shield: give --base_policy_path, or a checkpoint written by latentsafe wrap")


def run_episodes(
    policy: BasePolicy | LatentSafePolicy, env: EnvConfig, n_episodes: int, seed: int,
    batch_size: int = TOGETHER, n_videos: int = 0, seen: NearestFrames | None = None,
) -> Episodes:  # fmt: skip
    """Run episodes with seeds seed, seed + 1, ...; equal seeds give equal starts.

    Args:
        policy: a bare policy, or a filter with or without a base policy.
        batch_size: environments stepped together.
        n_videos: of the first so many episodes, keep frames.
        seen: add these frames to it, too.
    """
    parts = []
    for first in range(0, n_episodes, batch_size):
        n = min(batch_size, n_episodes - first)
        torch.manual_seed(seed + first)  # a diffusion policy samples
        with closing(VectorWorld(env, range(seed + first, seed + first + n))) as world:
            parts.append(_run_together(policy, world, max(0, n_videos - first), seen))
    return Episodes.joined(parts)


def _run_together(
    policy: BasePolicy | LatentSafePolicy, world: VectorWorld, n_videos: int, seen: NearestFrames | None
) -> Episodes:
    runs, actor = _begun(world.info, world.render(n_videos)), PolicyActor(policy)
    for step in steps(world, actor):
        alive, filmed = step.alive, np.flatnonzero(step.alive[:n_videos])
        if seen is not None and len(filmed):
            images = {key: values[filmed] for key, values in step.seen.items() if key.startswith(OBS_IMAGE)}
            state = step.seen.get(OBS_STATE, torch.zeros(len(alive), 0))[filmed]
            seen.add([runs.frames[i][-1] for i in filmed], images, state)
        runs.steps[alive] += 1
        if step.decision is not None:
            _note_decision(runs, step.decision, alive)
            for i in filmed:
                runs.latents[i].append(select(actor.latent, slice(i, i + 1)))
        for i in np.flatnonzero(alive):
            _note_outcome(runs, i, step.info[i])
        _record(runs.traces, alive, action=step.action)
        pictures = world.render(n_videos)
        for i in filmed[~world.over[filmed]]:
            runs.frames[i].append(pictures[i])
    runs.success &= ~runs.violation
    runs.stall = world.timed_out & ~runs.success & ~runs.violation
    return runs


def _begun(infos: list[dict[str, Any]], pictures: list[np.ndarray]) -> Episodes:
    """Episodes of which the first frame has been seen."""
    n = len(infos)
    runs = Episodes(
        success=np.zeros(n, bool), violation=np.zeros(n, bool), stall=np.zeros(n, bool), steps=np.zeros(n, int),
        overridden=np.zeros(n, int), action_change=np.zeros(n), severity=np.full(n, np.nan),
        traces=[{} for _ in range(n)], frames=[[p] for p in pictures], latents=[[] for _ in pictures],
    )  # fmt: skip
    for i, info in enumerate(infos):
        _note_state(runs, i, info)
    return runs


def _note_decision(runs: Episodes, decision: FilterDecision, alive: np.ndarray) -> None:
    columns = ("proposed", "value", "margin", "intervened", "adjusted", "reason", "heard")
    known = {name: numbers for name in columns if (numbers := getattr(decision, name)) is not None}
    _record(runs.traces, alive, **known)
    runs.overridden[alive & decision.intervened.cpu().numpy()] += 1
    moved = (decision.action - decision.proposed).norm(dim=-1).nan_to_num(0.0).cpu().numpy()
    runs.action_change[alive] += moved[alive]


def _note_state(runs: Episodes, i: int, info: dict[str, Any]) -> None:
    """What the environment said of a state of episode i."""
    runs.violation[i] |= bool(info["failure"])
    if "state" in info:
        runs.traces[i].setdefault("state", []).append(np.asarray(info["state"]).tolist())


def _note_outcome(runs: Episodes, i: int, info: dict[str, Any]) -> None:
    """What the environment said of episode i after a step."""
    _note_state(runs, i, info)
    runs.success[i] = bool(info["is_success"])
    if "severity" in info:
        runs.severity[i] = np.fmax(runs.severity[i], info["severity"])


def _record(traces: list[dict[str, list]], alive: np.ndarray, **columns: np.ndarray | torch.Tensor) -> None:
    for name, values in columns.items():
        values = values.tolist()
        for i in np.flatnonzero(alive):
            traces[i].setdefault(name, []).append(values[i])


def compare(
    policy: LatentSafePolicy, env: EnvConfig, n_episodes: int, seed: int, n_videos: int = 0,
    seen: NearestFrames | None = None, batch_size: int = TOGETHER,
) -> dict:  # fmt: skip
    """Bare and shielded from the same starts; the frames of the first n_videos episodes are kept, and added to `seen`.

    Returns:
        See `compared`.

    Raises:
        ValueError: nothing to shield, or an environment that is not the filter's.
    """
    check_shielding(policy, env)
    bare = run_episodes(policy.base, env, n_episodes, seed, batch_size, n_videos, seen)
    return compared(bare, run_episodes(policy, env, n_episodes, seed, batch_size, n_videos, seen))


def compared(bare: Episodes, shielded: Episodes) -> dict:
    """What a filter changed, of episodes from the same starts.

    Returns:
        bare, shielded: rates; violation_p_value: exact McNemar test on the pairs; reasons: how many decisions each
        made; episodes: both `Episodes`.
    """
    return {
        "bare": bare.rates(),
        "shielded": shielded.rates(),
        "violation_p_value": paired_p_value(bare.violation, shielded.violation),
        "reasons": count_reasons([reason for trace in shielded.traces for reason in trace["reason"]]),
        "episodes": {"bare": bare, "shielded": shielded},
    }


def failures_by_epsilon(
    policy: LatentSafePolicy, env: EnvConfig, epsilons: Sequence[float], n_episodes: int, seed: int
) -> Iterator[tuple[float, int, int]]:
    """Epsilon, failures and episodes of the shielded policy, one epsilon after the other, from the same starts.

    The filter's law stays with the last of them.

    Raises:
        ValueError: nothing to shield, or an environment that is not the filter's.
    """
    check_shielding(policy, env)
    for epsilon in epsilons:
        policy.config.change(law=replace(policy.config.law, epsilon=epsilon))
        runs = run_episodes(policy, env, n_episodes, seed)
        yield epsilon, int(runs.violation.sum()), n_episodes


def count_reasons(reasons: np.ndarray | list[int]) -> dict[str, int]:
    """How many decisions were made for each reason that occurs."""
    counts = np.bincount(reasons, minlength=len(Reason))
    return {reason.name.lower(): int(counts[reason]) for reason in Reason if counts[reason]}
