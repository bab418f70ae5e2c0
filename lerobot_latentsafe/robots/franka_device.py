"""What LeRobot devices of the Franka share, robots and operators alike."""

from functools import cached_property

from lerobot_latentsafe.franka.actions import ACTION_NAMES
from lerobot_latentsafe.robots.uncalibrated import Uncalibrated


class FrankaDevice(Uncalibrated):
    """Speaks the Franka's actions. Home a real gripper in Desk after changing fingers."""

    @cached_property
    def action_features(self) -> dict:
        """Names of the Franka's actions."""
        return dict.fromkeys(ACTION_NAMES, float)
