"""Action chunks made off the control thread: a base policy that thinks for longer than a period is not late."""

import copy
from collections import deque
from concurrent.futures import Future, wait
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from lerobot_latentsafe._compat import (
    observation_queues,
    plan_chunk,
    planned_actions,
    plans_apart,
    played_actions,
    queued_actions,
    set_observation_queues,
)
from lerobot_latentsafe.runtime.time_limit import Worker

if TYPE_CHECKING:
    from lerobot.policies.pretrained import PreTrainedPolicy


class ChunksAhead:
    """Plays the chunks of a LeRobot policy, and has the next one made in another thread before the present one ends.

    A chunk starts at the tick whose observation it was begun on: actions whose time is past when it is taken up are
    left out, and as many later ones played for them, where the policy plans further than it plays. If it is not ready
    by then, whoever asks for an action waits for it; see `LatentSafePolicy` for how long.

    Args:
        policy: one that plays its chunks from a queue of actions, such as LeRobot's diffusion policy or ACT.
        ahead: actions of a chunk that are still to come when the next one is begun.

    Raises:
        ValueError: the policy makes no chunks, or plans too short ones.
    """

    def __init__(self, policy: "PreTrainedPolicy", ahead: int):
        self.policy, self.ahead, self.played = policy, ahead, played_actions(policy.config)
        wrong = f"--policy.base_ahead is {ahead}, but the base policy ({policy.config.type})"
        if not plans_apart(policy):
            raise ValueError(f"{wrong} makes no chunks that can be begun ahead; give 0")
        planned = planned_actions(policy.config)
        if planned < ahead + 2:
            raise ValueError(
                f"{wrong} plans {planned} actions; expected at most {max(planned - 2, 0)} (0: chunks are made on the "
                "control thread)"
            )
        self._worker = _worker()
        self.reset()

    def __getstate__(self) -> dict[str, Any]:
        """A copy plans anew, in a thread of its own."""
        self.settle()
        return {**self.__dict__, "_worker": None, "_next": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _worker=_worker())

    def settle(self) -> None:
        """Wait until no plan is being made, which needs the policy's configuration changed."""
        if self._next is not None:
            wait([self._next])

    def reset(self) -> None:
        """Start an episode."""
        self._playing: deque[Tensor] = deque()
        self._next: Future[Tensor] | None = None
        self._ticks = 0

    @property
    def playing(self) -> deque[Tensor]:
        """What is still to come of the chunk that is played: (B, A) each, in the policy's own units."""
        return self._playing

    def act(self, batch: dict[str, Tensor]) -> Tensor:
        """The next action (B, A) of the policy's own units, given what it sees now."""
        self._batch, self._ticks = self._remember(batch), self._ticks + 1
        if not self._playing:
            if self._next is None:
                self._begin()
            begun, self._next = self._next, None  # what went wrong is raised once
            self._playing.extend(begun.result().unbind(1)[self._ticks : self._ticks + self.played])
        action = self._playing.popleft()
        if len(self._playing) <= self.ahead and self._next is None:
            self._begin()
        return action

    def replan(self) -> None:
        """Drop what is planned, as something else was done: the next chunk is of what is seen now."""
        self._playing.clear()
        if self._next is None or self._ticks > 0:
            self._begin()

    def _remember(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Have the policy take in an observation, without planning. Returns what its chunk is made of."""
        if observation_queues(self.policy):
            queue = queued_actions(self.policy)
            queue.clear()
            queue.append(None)  # a policy that still has an action to play plans none
            self.policy.select_action(dict(batch))
        seen = {key: past[-1] for key, past in observation_queues(self.policy).items() if past}
        return {key: value for key, value in {**batch, **seen}.items() if key != "action"}

    def _begin(self) -> None:
        self._ticks = 0
        planner = copy.copy(self.policy)  # the same weights; what it saw until now, whatever is seen meanwhile
        if queues := observation_queues(self.policy):
            set_observation_queues(planner, {key: deque(past, past.maxlen) for key, past in queues.items()})
        self._next = self._worker.submit(self._plan, planner, self._batch)

    @torch.no_grad()
    def _plan(self, planner: "PreTrainedPolicy", batch: dict[str, Tensor]) -> Tensor:
        """A chunk (B, N, A), as long as it is planned; meanwhile nobody plays from the policy's own queue."""
        chunk = plan_chunk(planner, dict(batch))
        rows = next(len(value) for key, value in batch.items() if key.startswith("observation."))
        if chunk.dim() != 3 or len(chunk) != rows:
            raise ValueError(
                f"the base policy ({planner.config.type}) planned a chunk of shape {tuple(chunk.shape)}; expected "
                f"({rows}, actions, numbers of an action). Give --policy.base_ahead=0"
            )
        return chunk


def _worker() -> Worker:
    return Worker("chunks")
