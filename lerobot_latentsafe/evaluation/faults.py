"""Faults to inject between a robot and its shield, to see what it does: it should stay where it is, and never jump."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from lerobot.utils.constants import OBS_IMAGE, OBS_STATE
from torch import Tensor

from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.shield import Shield

Given = dict[str, Any]
"""What a shield is given: observation, proposed and more; see `Shield.__call__`."""


def _state(change: Callable[[Tensor], Tensor]) -> Callable[[Given], Given]:
    """A fault of the first joint of each robot."""

    def inject(given: Given) -> Given:
        state = given["observation"][OBS_STATE].clone()
        state[:, 0] = change(state[:, 0])
        return {**given, "observation": {**given["observation"], OBS_STATE: state}}

    return inject


def _pictures(change: Callable[[Tensor], Tensor]) -> Callable[[Given], Given]:
    """A fault of each robot's first camera."""

    def inject(given: Given) -> Given:
        key = next(key for key in sorted(given["observation"]) if key.startswith(OBS_IMAGE))
        return {**given, "observation": {**given["observation"], key: change(given["observation"][key].clone())}}

    return inject


def _proposal(change: Callable[[Tensor], Tensor]) -> Callable[[Given], Given]:
    """A fault of the first command that is proposed to each robot."""

    def inject(given: Given) -> Given:
        proposed = given["proposed"].clone()
        proposed[:, 0] = change(proposed[:, 0])
        return {**given, "proposed": proposed}

    return inject


def _hot_pixel(picture: Tensor) -> Tensor:
    picture[:, 0, 0, 0] = math.nan
    return picture


def _nothing(x: Tensor) -> Tensor:
    return torch.full_like(x, math.nan)


FAULTS: dict[str, Callable[[Given], Given]] = {
    "a joint that is no number": _state(_nothing),
    "a joint that is infinite": _state(lambda x: torch.full_like(x, math.inf)),
    "a joint beyond all that was seen": _state(lambda x: x + 1e6),
    "a joint that leaps by 90 degrees": _state(lambda x: x + 90),
    "a joint in radians": _state(torch.deg2rad),
    "a pixel that is no number": _pictures(_hot_pixel),
    "a picture in bytes": _pictures(lambda x: x * 255),
    "a dead camera": _pictures(lambda x: torch.full_like(x, 0.5)),
    "an old observation": lambda given: {**given, "age_s": 1.0},
    "a base policy that failed": lambda given: {**given, "proposed": None},
    "a proposal that is no number": _proposal(_nothing),
    "a proposal that jumps": _proposal(lambda x: x + 30),
    "a proposal of zeros": lambda given: {**given, "proposed": torch.zeros_like(given["proposed"])},
    "a loop of another rate": lambda given: {**given, "fault": Reason.WRONG_RATE},
}
"""Name -> what it makes of what the shield of a robot that takes joint targets in degrees would be given."""


@contextmanager
def late(shield: Shield) -> Iterator[None]:
    """Meanwhile each decision seems to take ten seconds, and 20 ms are allowed."""
    law, clock, ticks = shield.model.config.law, shield.clock, iter(range(0, 10**9, 10))
    deadline, law.deadline_ms, shield.clock = law.deadline_ms, 20.0, lambda: float(next(ticks))
    try:
        yield
    finally:
        law.deadline_ms, shield.clock = deadline, clock


@contextmanager
def sick(shield: Shield) -> Iterator[None]:
    """Meanwhile the critic's values are no numbers."""
    critic = shield.model.critic
    weights = {name: tensor.clone() for name, tensor in critic.state_dict().items()}
    with torch.no_grad():
        for parameter in critic.parameters():
            parameter.fill_(math.nan)
    try:
        yield
    finally:
        critic.load_state_dict(weights)


BROKEN: dict[str, Callable[[Shield], Any]] = {"a decision that is late": late, "a critic of no numbers": sick}
"""Name -> a fault of the shield itself, for the length of a context."""
