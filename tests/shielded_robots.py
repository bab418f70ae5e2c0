"""What tests of shielded robots share: a simulation behind a tiny filter, and what it may be told."""

from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.franka.actions import ACTION_NAMES
from lerobot_latentsafe.robots.franka_mujoco.config_franka_mujoco import LatentSafeFrankaMujocoConfig
from lerobot_latentsafe.robots.shielded.config_shielded import LatentSafeShieldedConfig

STILL = dict.fromkeys(ACTION_NAMES, 0.0) | {"gripper.pos": 1.0}
PUSH = STILL | {"delta_x.pos": 0.015}
ALWAYS, NEVER = 2.0, -2.0
"""Thresholds at which a filter always, and never, intervenes."""
PERIOD = 0.05
"""Of the filter's data, seconds."""


def config(trained, law=None, **changes):
    """A shielded simulation; `law` are options of its law."""
    inner = LatentSafeFrankaMujocoConfig(scene="blocks", image_size=32, seed=3)
    options = {"inner": inner, "filter": str(trained), "law": LawOptions(**{"epsilon": NEVER, **(law or {})})}
    return LatentSafeShieldedConfig(**{**options, **changes})


def last(robot):
    return robot.filter.shield.decision
