"""A stand-in for an arm, and a filter of it with random weights: as fast as can be, to try what stands around them."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.robots.config import RobotConfig
from lerobot.robots.robot import Robot

from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.critic import ReachabilityConfig
from lerobot_latentsafe.decision import LawConfig
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.units import TrainedOn
from lerobot_latentsafe.world_models import RSSMConfig

FPS, SIDE = 30, 32
"""Frames a second, and pixels of a picture's side."""
NAMES = ("shoulder.pos", "elbow.pos", "gripper.pos")
FURTHEST, STEP = 30.0, 4.0
"""Degrees from the middle of the range, and the largest displacement that is commanded."""


@RobotConfig.register_subclass("latentsafe_stand_in")
@dataclass(kw_only=True)
class StandInConfig(RobotConfig):
    """A stand-in for an arm."""


class StandIn(Robot):
    """Three joints that go where they are told, seen by a camera whose picture changes with them.

    Attributes:
        joints: where they are, degrees.
        told: the last command as it came.
    """

    config_class = StandInConfig
    name = "stand_in"

    def __init__(self, config: StandInConfig):
        super().__init__(config)
        self.joints, self.told = np.zeros(len(NAMES)), None
        self._noise = np.random.default_rng(0).integers(60, 196, (SIDE, 3 * SIDE, 3), np.uint8)
        self._connected = False

    @cached_property
    def observation_features(self) -> dict:
        """Joints and a camera."""
        return {**dict.fromkeys(NAMES, float), "front": (SIDE, SIDE, 3)}

    @cached_property
    def action_features(self) -> dict:
        """Targets of the joints."""
        return dict.fromkeys(NAMES, float)

    @property
    def is_connected(self) -> bool:
        """Whether it is connected."""
        return self._connected

    @property
    def is_calibrated(self) -> bool:
        """It is."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Nothing but a mark."""
        self._connected = True

    def disconnect(self) -> None:
        """Nothing but a mark."""
        self._connected = False

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def get_observation(self) -> dict[str, Any]:
        """Joints in degrees, and a picture of them."""
        offset = int((self.joints[0] + FURTHEST) % FURTHEST)
        picture = self._noise[:, offset : offset + SIDE] + (self.joints[1:].sum() % 40).astype(np.uint8)
        return {**dict(zip(NAMES, self.joints.tolist())), "front": picture}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        """Go there at once."""
        self.told = dict(action)
        self.joints = np.array([action[name] for name in NAMES])
        return action


def stand_in_filter() -> LatentSafePolicy:
    """A filter of that arm, with random weights, as if it were trained."""
    n, key = len(NAMES), "observation.images.front"
    far, step = [FURTHEST] * n, [STEP] * n
    trained_on = TrainedOn(
        stage="critic", cameras=[key], fps=FPS, state_names=list(NAMES), action_names=list(NAMES),
        meanings=dict.fromkeys(NAMES, "target"), action_low=[-x for x in far], action_high=far,
        action_varies=[True] * n, action_step=step, action_jerk=step, displacement_low=[-x for x in step],
        displacement_high=step, displacement_scale=step, state_low=[-x for x in far], state_high=far, state_step=step,
        state_mean=[0.0] * n, state_std=[10.0] * n,
    )  # fmt: skip
    config = LatentSafeConfig(
        world_model=RSSMConfig(deterministic=16, stochastic=4, hidden=16, units=16, state_units=8, clip_length=8),
        reachability=ReachabilityConfig(critic_hidden=(16,), actor_hidden=(16,)),
        law=LawConfig(lookahead=0, history_frames=8), trained_on=trained_on, device="cpu", push_to_hub=False,
        input_features={
            key: PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE)),
            "observation.state": PolicyFeature(FeatureType.STATE, (n,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (n,))},
    )  # fmt: skip
    return LatentSafePolicy(config)
