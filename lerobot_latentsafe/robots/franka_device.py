"""What LeRobot devices of the Franka share, robots and operators alike."""

from functools import cached_property

from lerobot_latentsafe.franka.actions import ACTION_NAMES


class FrankaDevice:
    """Speaks the Franka's actions and needs no calibration. Name it before LeRobot's base class."""

    @cached_property
    def action_features(self) -> dict:
        """Names of the Franka's actions."""
        return dict.fromkeys(ACTION_NAMES, float)

    @property
    def is_calibrated(self) -> bool:
        """Always: an arm is calibrated at the factory, a simulation and a script need none."""
        return True

    def calibrate(self) -> None:
        """Nothing to do. Home a real gripper in Desk after changing fingers."""

    def configure(self) -> None:
        """Nothing to do: what there is to configure is configured on connect."""
