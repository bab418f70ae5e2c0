"""What a guard checks of actions, as a step of LeRobot's processors: for policies that no shield stands before.

At the end of a policy's postprocessor it sees each action, or each chunk of actions, in robot units, and lets nothing
out that leaves the range of the data, jumps, or jerks. It sees no observation: a shield knows more.
"""

import logging
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from lerobot.processor import PolicyActionProcessorStep, ProcessorStepRegistry
from torch import Tensor

from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.guard import check_plan
from lerobot_latentsafe.host import on_host
from lerobot_latentsafe.limits import Limits, differs
from lerobot_latentsafe.runtime.checkpoint import read_config
from lerobot_latentsafe.runtime.locations import resolve_checkpoint
from lerobot_latentsafe.units import TrainedOn, Units

logger = logging.getLogger(__name__)

ON_FAULT = ("hold", "raise")


class UnsafeActionError(RuntimeError):
    """A policy wants what the data never show, and nothing was sent that could go on instead."""


@ProcessorStepRegistry.register("latentsafe_chunk_guard")
class ChunkGuardStep(PolicyActionProcessorStep):
    """Lets actions and whole chunks pass as far as they keep to the data.

    What leaves the range a little is clipped. From the first action on that leaves it far, is no number, jumps or
    jerks, the robot holds: targets stay at the last good action, deltas and velocities are zero.

    Args:
        trained_on: what the data show, as a guard or filter has it; or that as a dict.
        on_fault: `hold`; or `raise`, so that the loop ends.

    Raises:
        ValueError: no such `on_fault`, or nothing is known of the data.
    """

    def __init__(self, trained_on: TrainedOn | dict[str, Any], on_fault: str = "hold"):
        if on_fault not in ON_FAULT:
            raise ValueError(f"on_fault is {on_fault!r}; expected one of {', '.join(ON_FAULT)}")
        self.trained_on = TrainedOn(**trained_on) if isinstance(trained_on, dict) else trained_on
        if self.trained_on.action_low is None:
            raise ValueError("trained_on has no action_low: make it by latentsafe guard --dataset.repo_id=...")
        self.on_fault, self.limits = on_fault, Limits(self.trained_on, Units(self.trained_on, []))
        self.reset()

    @classmethod
    def of(cls, path: str | Path, on_fault: str = "hold") -> Self:
        """The step that knows what a guard or filter knows: a folder, a Hub id or a committed name."""
        return cls(read_config(resolve_checkpoint(path)).trained_on, on_fault)

    def reset(self) -> None:
        """Start an episode."""
        self._single: list[np.ndarray] = []
        self._end: np.ndarray | None = None
        self._said = False

    def action(self, action: Tensor) -> Tensor:
        """Actions (A,) or (B, A) of a tick, or chunks (B, N, A), in robot units, as far as they keep to the data.

        An action is compared with those of the ticks before, a chunk with itself: how much of the chunk before it was
        played is not known.

        Raises:
            UnsafeActionError: something is wrong, and `on_fault` is `raise`, or nothing good was seen before it.
        """
        chunk = self._as_chunk(action)
        if action.dim() == 3:
            checked = self._check(chunk, [], self._end)
            self._end = on_host(checked[:, -1])
        else:
            before = [passed for passed in self._single if len(passed) == len(chunk)]
            checked = self._check(chunk, before, before[-1] if before else None)
            self._single = [*before[-1:], on_host(checked[:, -1])]
        return checked.view(action.shape)

    def _as_chunk(self, action: Tensor) -> Tensor:
        chunk = action.view(1, 1, -1) if action.dim() == 1 else action[:, None] if action.dim() == 2 else action
        names = self.limits.action_names
        if chunk.dim() != 3 or chunk.shape[-1] != len(names):
            raise UnsafeActionError(
                f"the policy's actions have shape {tuple(action.shape)}, expected (robots, {len(names)}) or (robots, "
                f"steps, {len(names)}): {', '.join(names)}"
            )
        return chunk

    def _check(self, chunk: Tensor, before: list[np.ndarray], last: np.ndarray | None) -> Tensor:
        """What of actions (B, N, A) is let through, and what holds from the first on that is not.

        Args:
            before, last: (B, A) that passed before them, to compare with, and to stay at.
        """
        numbers = on_host(chunk)
        fault = check_plan(self.limits, numbers, before)
        good = numbers.clip(self.limits.action_low, self.limits.action_high)
        let_through, changed = good, differs(good, numbers)
        broken = (fault != Reason.PASSED).cumsum(1) > 0
        if broken.any():
            self._tell(fault)
            if last is None or len(last) != len(chunk):
                last = self.limits.unknown(len(chunk))
            let_through = np.where(broken[..., None], self._held(good, broken, last)[:, None], good)
            changed |= broken[..., None]
        return torch.where(_like(changed, chunk), _like(let_through, chunk).to(chunk.dtype), chunk)

    def _held(self, good: np.ndarray, broken: np.ndarray, last: np.ndarray) -> np.ndarray:
        """What holds each robot (B, A): at its last action before something broke, of this chunk or before."""
        n_good = (~broken).sum(1)
        here = good[np.arange(len(good)), (n_good - 1).clip(min=0)]
        told = np.where((n_good > 0)[:, None], here, last)
        unknown = np.full((len(good), len(self.limits.state_names)), np.nan, np.float32)
        held = self.limits.hold(unknown, told)
        if not np.isfinite(held).all():
            raise UnsafeActionError(
                "the policy's first action is far from the data, and nobody knows where the robot is: nothing is sent. "
                "Start again, or shield the policy (latentsafe wrap), which sees the robot"
            )
        return held

    def _tell(self, fault: np.ndarray) -> None:
        """Say what is wrong, once an episode; or raise."""
        names = {Reason(number).name.lower().replace("_", " ") for number in np.unique(fault).tolist() if number}
        first = int((fault != Reason.PASSED).any(0).argmax())
        what = f"the policy's actions are not let through: {', '.join(sorted(names))}, in step {first}"
        if self.on_fault == "raise":
            raise UnsafeActionError(f"{what}. Nothing was sent")
        if not self._said:
            self._said = True
            logger.warning("%s; the robot holds from there on", what)

    def get_config(self) -> dict[str, Any]:
        """What is stored beside a policy: the numbers of the data that are checked, and `on_fault`."""
        known = {**asdict(self.trained_on), "looks": None}
        return {"trained_on": {k: v for k, v in known.items() if v is not None}, "on_fault": self.on_fault}

    def transform_features(self, features: dict) -> dict:
        """The same features."""
        return features


def _like(numbers: np.ndarray, chunk: Tensor) -> Tensor:
    """Numbers of the host where a chunk is."""
    return torch.from_numpy(numbers).to(chunk.device)
