"""What a guard is worth: faults injected into episodes of the same robot that it does not know, and false alarms."""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.decision import FilterDecision, Reason
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.shield import Shield
from lerobot_latentsafe.units import TrainedOn

BEFORE, AFTER_S = 12, 2.0
"""Healthy frames before a fault, and seconds for which it lasts at most."""
MOVES, MOVES_FAR = 0.1, 0.3
"""A camera freezes where some joint that it sees moves by this share of its range meanwhile; and all that is seen where
any joint moves by that share."""


@dataclass(frozen=True)
class Recorded:
    """An episode as it was recorded.

    Attributes:
        pictures: camera key -> uint8 (T, 3, H, W).
        state, action: (T, S) and (T, A) in robot units.
        age_s: (T,), how old each observation is, seconds.
    """

    pictures: dict[str, Tensor]
    state: Tensor
    action: Tensor
    age_s: Tensor

    def part(self, begin: int, end: int) -> "Recorded":
        """Frames from one on, up to another."""
        pictures = {key: frames[begin:end] for key, frames in self.pictures.items()}
        return Recorded(pictures, self.state[begin:end], self.action[begin:end], self.age_s[begin:end])

    def __len__(self) -> int:
        return len(self.state)


def recorded(meta: LeRobotDatasetMetadata, episodes: list[int], cameras: list[str]) -> Iterator[Recorded]:
    """Episodes of a dataset, one after the other."""
    contract, frames = Contract.read(meta), DatasetFrames(meta, episodes)
    for episode in episodes:
        pieces = list(frames.pieces(cameras, episode))
        pictures = {key: torch.cat([piece[key] for piece in pieces]) for key in cameras}
        own = contract.only([episode])
        state, action = torch.from_numpy(own.state), torch.from_numpy(own.action)
        yield Recorded(pictures, state, action, torch.zeros(len(state)))


def observations(episode: Recorded) -> Iterator[dict[str, Tensor]]:
    """What a policy sees at each tick of an episode: LeRobot batches of one."""
    for t in range(len(episode)):
        seen = {key: pictures[t : t + 1].float() / 255.0 for key, pictures in episode.pictures.items()}
        yield {**seen, OBS_STATE: episode.state[t : t + 1]}


def replayed(shield: Shield, episode: Recorded) -> Iterator[FilterDecision]:
    """What a shield decides along an episode, as if each action were proposed when it was recorded."""
    shield.reset()
    for t, seen in enumerate(observations(episode)):
        yield shield(seen, episode.action[t : t + 1], float(episode.age_s[t]))
        shield.was_executed(episode.action[t : t + 1])  # the recording goes on as it did


def alarms(policy: LatentSafePolicy, episodes: Iterator[Recorded]) -> dict[str, object]:
    """How often something is found wrong with healthy episodes, and why; and what a tick costs, CPU milliseconds."""
    shield, reasons = Shield(policy.model, clock=standing_still), Counter[str]()
    took: list[float] = []
    n_episodes = 0
    for episode in episodes:
        n_episodes += 1
        for decision in _timed(replayed(shield, episode), took):
            reasons[Reason(int(decision.reason)).name.lower()] += 1
    false = {name: n for name, n in reasons.items() if name != "passed"}
    ticks = reasons.total()
    return {
        "episodes": n_episodes, "ticks": ticks, "false_alarms": sum(false.values()), "reasons": false,
        "share": sum(false.values()) / ticks, "tick_cpu_ms": round(1e3 * float(np.median(took)), 3),
    }  # fmt: skip


def _timed(decisions: Iterator[FilterDecision], took: list[float]) -> Iterator[FilterDecision]:
    while True:
        began = time.thread_time()
        decision = next(decisions, None)
        if decision is None:
            return
        took.append(time.thread_time() - began)
        yield decision


# -- faults ---

Injected = Callable[[Recorded, int, TrainedOn, np.random.Generator], Recorded | None]
"""(episode, frame, data, generator) -> the episode with a fault from that frame on; None if there can be none there."""


def _commanded(change: Callable[[Tensor, int, TrainedOn, np.random.Generator], Tensor]) -> Injected:
    """A fault of what is commanded, in one tick or from it on."""

    def inject(episode: Recorded, at: int, data: TrainedOn, rng: np.random.Generator) -> Recorded:
        return replace(episode, action=change(episode.action.clone(), at, data, rng))

    return inject


def _one_of(data: TrainedOn, rng: np.random.Generator) -> int:
    """A command that the data vary."""
    return int(rng.choice(np.flatnonzero(data.action_varies)))


def _jump(action: Tensor, at: int, data: TrainedOn, rng: np.random.Generator) -> Tensor:
    i = _one_of(data, rng)
    sign = 1.0 if action[at, i] >= action[at - 1, i] else -1.0
    action[at:, i] += sign * rng.uniform(2, 5) * data.action_step[i]
    return action


def _jerk(action: Tensor, at: int, data: TrainedOn, rng: np.random.Generator) -> Tensor:
    """To and fro: each change is undone by the next."""
    i = _one_of(data, rng)
    for t in range(at, len(action)):
        action[t, i] += (-1) ** t * rng.uniform(0.5, 1.0) * data.action_jerk[i]
    return action


def _out_of_range(action: Tensor, at: int, data: TrainedOn, rng: np.random.Generator) -> Tensor:
    i, width = _one_of(data, rng), np.subtract(data.action_high, data.action_low)
    beyond = rng.uniform(0.15, 1.0) * width[i]
    action[at:, i] = rng.choice([data.action_low[i] - beyond, data.action_high[i] + beyond])
    return action


def _swapped_joints(episode: Recorded, at: int, data: TrainedOn, rng: np.random.Generator) -> Recorded:
    order = _another_order(episode.state.shape[1], rng)
    return replace(episode, state=torch.cat([episode.state[:at], episode.state[at:, order]]))


def _swapped_commands(action: Tensor, at: int, data: TrainedOn, rng: np.random.Generator) -> Tensor:
    return torch.cat([action[:at], action[at:, _another_order(action.shape[1], rng)]])


def _another_order(n: int, rng: np.random.Generator) -> np.ndarray:
    while (order := rng.permutation(n)).tolist() == list(range(n)):
        pass
    return order


def _seen(change: Callable[[Tensor, int, np.random.Generator], Tensor]) -> Injected:
    """A fault of one camera."""

    def inject(episode: Recorded, at: int, data: TrainedOn, rng: np.random.Generator) -> Recorded:
        key = str(rng.choice([*episode.pictures]))
        return replace(episode, pictures={**episode.pictures, key: change(episode.pictures[key].clone(), at, rng)})

    return inject


def _black(pictures: Tensor, at: int, rng: np.random.Generator) -> Tensor:
    pictures[at:] = torch.from_numpy(rng.integers(0, rng.integers(1, 11), pictures[at:].shape, np.uint8))
    return pictures


def _frozen(episode: Recorded, at: int, data: TrainedOn, rng: np.random.Generator) -> Recorded | None:
    key = str(rng.choice([*episode.pictures]))
    sees = np.array(data.looks[key].unseen) < 1.0
    went = (episode.state[at:] - episode.state[at]).abs().amax(0).numpy()
    if not (went > MOVES * np.subtract(data.state_high, data.state_low))[sees].any():
        return None
    pictures = episode.pictures[key].clone()
    pictures[at:] = pictures[at]
    return replace(episode, pictures={**episode.pictures, key: pictures})


def _frozen_whole(episode: Recorded, at: int, data: TrainedOn, rng: np.random.Generator) -> Recorded | None:
    """All that is seen, state and pictures, while commands go on."""
    went = (episode.state[at:] - episode.state[at]).abs().amax(0).numpy()
    if not (went > MOVES_FAR * np.subtract(data.state_high, data.state_low)).any():
        return None
    state = torch.cat([episode.state[:at], episode.state[at].expand_as(episode.state[at:])])
    pictures = {
        key: torch.cat([frames[:at], frames[at].expand_as(frames[at:])]) for key, frames in episode.pictures.items()
    }
    return replace(episode, state=state, pictures=pictures)


def _late(episode: Recorded, at: int, data: TrainedOn, rng: np.random.Generator) -> Recorded:
    age = episode.age_s.clone()
    age[at:] = rng.uniform(1.1, 10) / data.fps
    return replace(episode, age_s=age)


def _swapped_cameras(episode: Recorded, at: int, data: TrainedOn, rng: np.random.Generator) -> Recorded | None:
    keys = [*episode.pictures]
    if len(keys) < 2:
        return None
    first, second = rng.choice(keys, 2, replace=False).tolist()
    exchanged = {**episode.pictures}
    for key, other in ((first, second), (second, first)):
        exchanged[key] = torch.cat([episode.pictures[key][:at], episode.pictures[other][at:]])
    return replace(episode, pictures=exchanged)


FAULTS: dict[str, Injected] = {
    "jump": _commanded(_jump), "jerk": _commanded(_jerk), "range": _commanded(_out_of_range), "frozen": _frozen,
    "frozen whole": _frozen_whole, "black": _seen(_black), "late": _late, "joints swapped": _swapped_joints,
    "commands swapped": _commanded(_swapped_commands), "cameras swapped": _swapped_cameras,
}  # fmt: skip


def caught(
    policy: LatentSafePolicy, episodes: list[Recorded], fault: str, n: int, seed: int = 0
) -> dict[str, int | float | None]:
    """How many of n faults at random places do not get to the robot, and after how many ticks that begins."""
    rng, data = np.random.default_rng(seed), policy.config.trained_on
    shield, after, tried = Shield(policy.model, clock=standing_still), [], 0
    for _ in range(100 * n):
        if tried == n:
            break
        episode = episodes[rng.integers(len(episodes))]
        at = int(rng.integers(BEFORE, len(episode) - 4))
        part = episode.part(at - BEFORE, at + round(AFTER_S * data.fps))
        broken = FAULTS[fault](part, BEFORE, data, rng)
        if broken is None:
            continue
        tried += 1
        decisions = enumerate(replayed(shield, broken))
        first = next((t for t, decision in decisions if t >= BEFORE and _noticed(decision)), None)
        if first is not None:
            after.append(first - BEFORE)
    return {
        "injected": tried, "caught": len(after), "ticks_median": float(np.median(after)) if after else None,
        "ticks_most": max(after, default=None),
    }  # fmt: skip


def _noticed(decision: FilterDecision) -> bool:
    """Whether the proposal is not what is executed: it was stopped, or clipped into the range of the data."""
    return bool(decision.intervened) or not torch.equal(decision.action, decision.proposed)


def load_recorded(root: Path, episodes: list[int], cameras: list[str]) -> list[Recorded]:
    """Episodes of the dataset in a folder."""
    return list(recorded(LeRobotDatasetMetadata("local/held_out", root=root), episodes, cameras))
