"""What a filter would decide by along recorded episodes, in monitor mode: V of each proposal, and l of each frame.

The proposal is the action that was recorded. It is held for the law's `proposal_steps`, and judged with the law's
lookahead, samples and memory, as at deployment. A `Shield` does it, many episodes side by side. It is shown what a
frame cache keeps in place of pictures, so the checks of pictures are left out.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.decision import FilterDecision, Reason, first_of
from lerobot_latentsafe.guard import Guard, Seen, standing_still
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.nearest import Found
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.shield import Shield

TOGETHER = 64
"""Episodes that are judged side by side."""


@dataclass(frozen=True)
class EpisodeDecisions:
    """What a filter would have decided by along one episode of T frames.

    Attributes:
        episode: its number.
        value: (T,), V of the recorded action at each tick.
        margin: (T,), l of what is seen at each tick.
        failure: int8 (T,), the labels: 1 failing, 0 safe, -1 unlabelled.
    """

    episode: int
    value: np.ndarray
    margin: np.ndarray
    failure: np.ndarray


class RecordedGuard(Guard):
    """A guard that sees percepts of a cache: it checks states and actions, and warns nobody of what is past."""

    def observe(self, observation: dict[str, Tensor]) -> Seen:
        """What is seen of B robots: `observation.state` (B, S) in robot units, and percepts (B, ...)."""
        percepts = {key: value for key, value in observation.items() if key in self.model.world_model.percept_names}
        n = len(next(iter(percepts.values())))
        state, finite, believed = self._see_state(observation, n)
        fault = first_of({Reason.OBSERVATION_NOT_FINITE: ~finite, Reason.OBSERVATION_OUT_OF_RANGE: ~believed})
        self.response.see(state, self.limits.unknown(n) if self.told is None else self.told)
        self.begun, self._rows = True, n
        return Seen(percepts, state, fault)

    def say_once(self, what: str, which: str = "") -> None:
        """Nothing."""


class RecordedShield(Shield):
    """A shield over recordings: it judges what was done, and remembers that this was done, whatever it would do."""

    def __init__(self, model: SafetyModel):
        super().__init__(model, clock=standing_still)
        self.guard, self.monitor = RecordedGuard(model), None

    def _perceive(self, seen: Seen) -> dict[str, Tensor]:
        return seen.images  # percepts already

    def _find_nearest(self, latent: Latent, value: np.ndarray, *given: np.ndarray) -> Found:
        """Nothing: what was done is done."""
        return Found.nothing(len(value), len(self.model.limits.action_low))

    def _tell(self, decision: FilterDecision) -> None:
        """Nothing: it acts on nobody."""

    def replay(self, percepts: dict[str, Tensor], state: Tensor, action: Tensor) -> FilterDecision:
        """Judge actions (B, A) that were recorded at states (B, S), both in robot units, with percepts (B, ...)."""
        decision = self({**percepts, "observation.state": state}, action)
        self.was_executed(action)
        return decision


@torch.no_grad()
def decision_values(model: SafetyModel, reader: ClipReader, episodes: np.ndarray) -> list[EpisodeDecisions]:
    """What the filter would decide by along these episodes of a cached dataset, in the order that they are given.

    Raises:
        ValueError: the filter's law is a guard's, which has no V.
        UntrainedFilterError: training has not come far enough for the law.
    """
    if model.config.law.name == "guard":
        raise ValueError("--policy.law.name is 'guard', whose law has no V to choose a threshold for; name another law")
    model.require_trained_for_law()
    frames = {int(episode): np.flatnonzero(reader.labels.episode == episode) for episode in episodes}
    by_length = sorted(frames, key=lambda episode: len(frames[episode]))
    found: dict[int, EpisodeDecisions] = {}
    for first in range(0, len(by_length), TOGETHER):
        batch = by_length[first : first + TOGETHER]
        rows = [frames[episode] for episode in batch]
        value, margin = (np.stack(numbers, 1) for numbers in zip(*_along(model, reader, rows)))
        for i, (episode, index) in enumerate(zip(batch, rows)):
            own = slice(len(index))
            failure = reader.labels.failure[index]
            found[episode] = EpisodeDecisions(episode, value[i, own], margin[i, own], failure)
    return [found[int(episode)] for episode in episodes]


def _along(model: SafetyModel, reader: ClipReader, rows: list[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """V and l (B,) at each tick of episodes of these frames, side by side; one that is over stays at its last frame."""
    shield, device, names = RecordedShield(model), model.device, model.world_model.percept_names
    for t in range(max(map(len, rows))):
        index = np.array([frames[min(t, len(frames) - 1)] for frames in rows])
        percepts, state = reader.cache.frames(index, names)
        percepts = model.world_model.from_cache({key: value.to(device) for key, value in percepts.items()})
        action = torch.from_numpy(reader.action[index])
        decision = shield.replay(percepts, state.to(device), action.to(device))
        yield decision.value.cpu().numpy(), decision.margin.cpu().numpy()
