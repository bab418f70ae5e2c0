"""Faults to inject between a robot and its shield, to see what it does: it should stay where it is, and never jump.

Faults of what comes in are functions of what a shield is given; faults of the shield itself last for a context.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import torch
from lerobot.utils.constants import OBS_IMAGE, OBS_STATE
from torch import Tensor

from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.shield import Shield

Given = dict[str, Any]
"""What a shield is given: observation, proposed and more; see `Shield.__call__`."""
Fault = Callable[[Given], Given]


# -- what comes in ---


def shown(change: Callable[[Any], Any], key: str | None = None) -> Fault:
    """A fault of one entry of the observation, by default of the first camera; None leaves the entry out."""

    def inject(given: Given) -> Given:
        seen = dict(given["observation"])
        name = key or next(name for name in sorted(seen) if name.startswith(OBS_IMAGE))
        value = seen.pop(name)
        changed = change(value.clone() if isinstance(value, Tensor) else value)
        return {**given, "observation": seen if changed is None else {**seen, name: changed}}

    return inject


def proposed(change: Callable[[Tensor], Any]) -> Fault:
    """A fault of the proposal."""
    return lambda given: {**given, "proposed": change(given["proposed"].clone())}


def first(change: Callable[[Tensor], Any]) -> Callable[[Tensor], Tensor]:
    """A fault of the first number of each robot's state or action (B, N)."""

    def changed(numbers: Tensor) -> Tensor:
        numbers[:, 0] = change(numbers[:, 0])
        return numbers

    return changed


def _hot_pixel(picture: Tensor) -> Tensor:
    picture[:, 0, 0, 0] = math.nan
    return picture


def _nothing(x: Tensor) -> Tensor:
    return torch.full_like(x, math.nan)


def _flat(red: float, green: float, blue: float) -> Callable[[Tensor], Tensor]:
    return lambda x: x.new_tensor([red, green, blue]).view(3, 1, 1).expand_as(x).clone()


def _noise(levels: float) -> Callable[[Tensor], Tensor]:
    """A sensor that sees nothing: grey levels of noise, of 255."""
    return lambda x: torch.rand_like(x) * levels / 255


def _speck(picture: Tensor) -> Tensor:
    picture[:] = 0.5
    picture[..., 3, 5] = 1.0
    return picture


STATES: dict[str, Callable[[Tensor], Any]] = {
    "a joint that is no number": first(_nothing),
    "a joint that is infinite": first(lambda x: torch.full_like(x, math.inf)),
    "a joint beyond all that was seen": first(lambda x: x + 1e6),
    "a joint of 1e30": first(lambda x: torch.full_like(x, 1e30)),
    "a joint that leaps by 90 degrees": first(lambda x: x + 90),
    "a hundred standard deviations": lambda x: x + 1e4,
    "no state": lambda x: None,
    "a state that is one number": lambda x: x[:1, :1],
    "a state that lacks a number": lambda x: x[:, :-1],
    "a state of one number more": lambda x: torch.cat([x, x[:, :1]], 1),
    "a state without a batch": lambda x: x[0],
    "a state of truth values": lambda x: x > 0,
    "a state of complex numbers": lambda x: x.to(torch.complex64),
    "a state that is sparse": lambda x: x.to_sparse(),
    "a state without data": lambda x: x.to("meta"),
    "a state that is a list": lambda x: x.tolist(),
    "a state in words": lambda x: "home",
}
"""Name -> what it makes of a state (B, S); None leaves it out."""

PICTURES: dict[str, Callable[[Tensor], Any]] = {
    "a pixel that is no number": _hot_pixel,
    "a picture of infinity": lambda x: x * math.inf,
    "a picture of 1e30": lambda x: x * 1e30,
    "a picture in 0 to 255": lambda x: x * 255,
    "a picture below zero": lambda x: -x - 0.1,
    "a picture in bytes": lambda x: (x * 255).to(torch.uint8),
    "a dead camera": _flat(0.5, 0.5, 0.5),
    "a black picture": torch.zeros_like,
    "a white picture": torch.ones_like,
    "no picture": lambda x: None,
    "a grey picture": lambda x: x[:, :1],
    "a picture with an alpha channel": lambda x: torch.cat([x, x[:, :1]], 1),
    "a picture of channels last": lambda x: x.movedim(1, -1),
    "a picture without a batch": lambda x: x[0],
    "a picture of other proportions": lambda x: x[..., : x.shape[-1] // 2],
    "a picture without pixels": lambda x: x[..., :0, :0],
    "a picture that is sparse": lambda x: x.to_sparse(),
    "a picture without data": lambda x: x.to("meta"),
    "a picture that is an array": lambda x: x.numpy(),
    "a picture that is a path": lambda x: "picture.png",
}
"""Name -> what it makes of a camera's pictures (B, 3, H, W) in [0, 1]; None leaves them out."""

EMPTY: dict[str, Callable[[Tensor], Tensor]] = {
    "a lens cap": _noise(2),
    "a lens cap and a noisy sensor": _noise(10),
    "one hot pixel on a dead camera": _speck,
    "a flat green": _flat(0, 0.53, 0),
    "a flat red": _flat(1, 0, 0),
    "a flat blue": _flat(0, 0, 1),
    "a flat purple": _flat(0.5, 0, 0.5),
    "a flat grey, nearly": _flat(0.5, 0.5, 0.502),
}
"""Name -> pictures that show nothing, though their numbers differ."""

ALTERED: dict[str, Callable[[Tensor], Tensor]] = {
    "upside down": lambda x: x.flip(-2, -1),
    "mirrored": lambda x: x.flip(-1),
    "red and blue exchanged": lambda x: x.flip(1),
    "noise": torch.rand_like,
    "nothing but a stripe": lambda x: torch.ones_like(x).cumsum(-1) / x.shape[-1],
    "a thumbnail of 2 pixels": lambda x: torch.nn.functional.interpolate(x, size=(2, 2), mode="area"),
    "a thumbnail of 8 pixels": lambda x: torch.nn.functional.interpolate(x, size=(8, 8), mode="area"),
}
"""Name -> pictures that the data never show. Only a filter that knows the look of its cameras can tell."""

PROPOSALS: dict[str, Callable[[Tensor], Any]] = {
    "a base policy that failed": lambda x: None,
    "a proposal that is no number": first(_nothing),
    "a proposal that is infinite": first(lambda x: torch.full_like(x, -math.inf)),
    "a proposal that jumps": first(lambda x: x + 30),
    "a proposal of 1e9": lambda x: x + 1e9,
    "a proposal of one number more": lambda x: torch.cat([x, x[:, :1]], 1),
    "a proposal that lacks a number": lambda x: x[:, :-1],
    "a proposal without a batch": lambda x: x[0],
    "a proposal of one robot more": lambda x: torch.cat([x, x[:1]]),
    "a chunk": lambda x: x[:, None].expand(-1, 8, -1),
    "a proposal that is an array": lambda x: x.numpy(),
    "a proposal that is a list": lambda x: x.tolist(),
    "a proposal of complex numbers": lambda x: x.to(torch.complex64),
    "a proposal that is sparse": lambda x: x.to_sparse(),
    "a proposal that is quantized": lambda x: torch.quantize_per_tensor(x, 0.1, 0, torch.qint8),
}
"""Name -> what it makes of a proposal (B, A)."""

TIMES: dict[str, Given] = {
    "an old observation": {"age_s": 1.0},
    "an observation of the future": {"age_s": -0.1},
    "an observation of no known age": {"age_s": math.nan},
    "an observation of infinite age": {"age_s": math.inf},
    "a loop of another rate": {"fault": Reason.WRONG_RATE},
}
"""Name -> what the shield is told of the time."""

FAULTS: dict[str, Fault] = {
    **{name: shown(change, OBS_STATE) for name, change in STATES.items()},
    **{name: shown(change) for name, change in PICTURES.items()},
    **{name: proposed(change) for name, change in PROPOSALS.items()},
    **{name: lambda given, told=told: {**given, **told} for name, told in TIMES.items()},
}
"""Name -> what it makes of what the shield of any robot would be given."""

FAULTS_OF_DEGREES: dict[str, Fault] = {
    "a joint in radians": shown(first(torch.deg2rad), OBS_STATE),
    "a proposal of zeros": proposed(torch.zeros_like),
}
"""The same, of robots that take joint targets in degrees, whose joints are far from zero."""


# -- the shield itself ---


@contextmanager
def replaced(thing: Any, name: str, value: Any) -> Iterator[None]:
    """Meanwhile an attribute is another."""
    own, before = name in vars(thing), getattr(thing, name)
    object.__setattr__(thing, name, value)
    try:
        yield
    finally:
        object.__setattr__(thing, name, before) if own else object.__delattr__(thing, name)


def fails(*_: Any, **__: Any) -> Any:
    """What raises, whatever it is given."""
    raise RuntimeError("out of memory, or a bug")


@contextmanager
def late(shield: Shield, seconds: float = 0.5) -> Iterator[None]:
    """Meanwhile each decision seems to take so long."""
    now, calls = shield.clock(), iter(range(1, 10**9))
    with replaced(shield, "clock", lambda: now + seconds * (next(calls) // 2)):
        yield


def sick(number: float) -> Callable[[Shield], AbstractContextManager]:
    """Meanwhile the values and actions of the critic are this number."""

    @contextmanager
    def lasting(shield: Shield) -> Iterator[None]:
        critic = shield.model.critic
        weights = {name: tensor.clone() for name, tensor in critic.state_dict().items()}
        with torch.no_grad():
            for parameter in critic.parameters():
                parameter.fill_(number)
        try:
            yield
        finally:
            critic.load_state_dict(weights)

    return lasting


def _absurd(shield: Shield) -> AbstractContextManager:
    see = shield.model.world_model.perceive
    vectors = lambda images: {key: torch.full_like(x, 1e20) for key, x in see(images).items()}  # noqa: E731
    return replaced(shield.model.world_model, "perceive", vectors)


def _says(part: str, name: str, number: float) -> Callable[[Shield], AbstractContextManager]:
    """Meanwhile a method of a part of the model gives this number for everything."""

    def lasting(shield: Shield) -> AbstractContextManager:
        return replaced(getattr(shield.model, part), name, lambda x: torch.full_like(x[..., 0], number))

    return lasting


def wild(shield: Shield) -> AbstractContextManager:
    """Meanwhile the critic's fallback asks for five times the largest motions."""
    critic, act = shield.model.critic, shield.model.critic.act
    return replaced(critic, "act", lambda x: 5.0 * torch.ones_like(act(x)))


BROKEN: dict[str, Callable[[Shield], AbstractContextManager]] = {
    "a decision that is late": late,
    "a clock that tells nothing": lambda shield: replaced(shield, "clock", lambda: math.nan),
    "a critic of no numbers": sick(math.nan),
    "a critic of infinite numbers": sick(math.inf),
    "a value that is infinite": _says("critic", "best_q", math.inf),
    "a margin that is infinite": _says("margin", "forward", math.inf),
    "a margin of 1e30": _says("margin", "forward", 1e30),
    "a world model that raises": lambda shield: replaced(shield.model.world_model, "step", fails),
    "a world model that cannot correct": lambda shield: replaced(shield.model.world_model, "correct", fails),
    "an encoder that raises": lambda shield: replaced(shield.model.world_model, "perceive", fails),
    "an encoder of absurd numbers": _absurd,
    "a critic that raises": lambda shield: replaced(shield.model.critic, "project", fails),
    "a margin that raises": lambda shield: replaced(shield.model.margin, "forward", fails),
}
"""Name -> a fault of the shield itself, for the length of a context."""
