"""Small filters on a bench, and rows of tables of faults: what is injected, and what a user gets."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import pytest
import tiny
import torch
from torch import Tensor

from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.shield import Shield

IMAGE, FRONT, WRIST, STATE = (
    "observation.image",
    "observation.images.front",
    "observation.images.wrist",
    "observation.state",
)
BENCHES = ("car", "car that forgets", "car of continuous actions", "two cameras", "joint targets")
PASSES_ALL, PASSES_NOTHING = -2.0, 2.0
"""Thresholds."""


@dataclass(repr=False)
class Bench:
    """A filter whose threshold passes whatever is not faulty, and robots that show and want nothing wrong.

    Attributes:
        policy: the filter.
        see: tick -> a healthy observation.
        wanted: (B, A), what is proposed at every tick.
        stay: (B, A), what it is to stay, in robot units; NaN where that is as it was told.
        targets: whether commands are positions.
    """

    policy: LatentSafePolicy
    see: Callable[[int], dict[str, Tensor]]
    wanted: Tensor
    stay: Tensor
    targets: bool = False

    @property
    def shield(self) -> Shield:
        return self.policy.shield

    def begin(self, ticks: int = 0, clock: Callable[[], float] = standing_still) -> "Bench":
        """A shield that has seen nothing yet, and then some healthy ticks."""
        self.policy.config.law.epsilon = PASSES_ALL
        self.policy.shield = Shield(self.policy.model, clock)
        for t in range(ticks):
            assert self.decide(t).reason.eq(Reason.PASSED).all()
        return self

    def given(self, t: int) -> dict:
        """What the shield is given at a tick, with nothing wrong."""
        return {"observation": self.see(t), "proposed": self.wanted.clone()}

    def decide(self, t: int, fault: Callable[[dict], dict] = dict):
        """The decision at a tick, with a fault."""
        return self.shield(**fault(self.given(t)))

    def assert_stays(self, decision) -> None:
        """What is executed is to stay, whatever is wrong."""
        told = torch.where(self.stay.isnan(), self.wanted, self.stay)
        torch.testing.assert_close(decision.action, told)
        assert decision.intervened.all()


@cache
def _drawn(t: int) -> dict[str, Tensor]:
    states = torch.tensor([[-0.9, 0.1, 0.0], [-0.7, -0.3, 0.5], [0.6, 0.6, 2.0]])
    return tiny.observation((states + t * torch.tensor([0.02, 0.01, 0.05])).numpy())


def _cars(t: int) -> dict[str, Tensor]:
    return {key: _drawn(t)[key].clone() for key in (IMAGE, STATE)}


def _noise(t: int, *keys: str) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(t)
    return {key: torch.rand(1, 3, 32, 32, generator=generator) for key in keys}


def car_bench(folder, **law) -> Bench:
    """Three cars: one camera, delta commands."""
    policy = LatentSafePolicy.from_pretrained(folder).eval()
    for name, value in law.items():
        setattr(policy.config.law, name, value)
    return Bench(policy, _cars, torch.tensor([[0.5, 1.0]] * 3), torch.tensor([[0.0, 1.0]] * 3))


def franka_bench(folder, **limits) -> Bench:
    """An arm of two cameras, of delta commands and a gripper."""
    n = 14
    ranges = dict(state_low=[-1.0] * n, state_high=[1.0] * n, state_step=[0.1] * n, **limits)
    tiny.save_franka_filter(folder, **{f"trained_on_{name}": value for name, value in ranges.items()})
    policy = LatentSafePolicy.from_pretrained(folder).eval()
    wanted = torch.tensor([[0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]])
    stay = torch.tensor([[0.0] * 6 + [1.0]])
    gripper = torch.eye(n)[7]
    see = lambda t: {**_noise(t, FRONT, WRIST), STATE: torch.full((1, n), 0.01 * t).maximum(gripper)}  # noqa: E731
    return Bench(policy, see, wanted, stay)


def arm_bench(folder) -> Bench:
    """An arm of one camera that takes joint targets in degrees, and is to stay."""
    policy = LatentSafePolicy.from_pretrained(tiny.save_arm_filter(folder)).eval()
    pose = torch.tensor([tiny.ARM_POSE])
    return Bench(policy, lambda t: {**_noise(t, FRONT), STATE: pose.clone()}, pose, pose, targets=True)


# -- tables ---


def fault(number: str, what: str, outcome: str):
    """The mark of a test that shows what comes of a fault; docs/reliability.md is made of them."""
    return pytest.mark.fault(number, what, outcome)


def row(number: str, what: str, *given, outcome: str):
    """A row of a table of faults."""
    return pytest.param(*given, id=f"{number} {what}", marks=fault(number, what, outcome))


def stays(number: str, what: str, inject, reason: Reason):
    """A row of a fault for which robots stay where they are."""
    return row(number, what, inject, reason, outcome=f"The robot stays: `{reason.name}`")
