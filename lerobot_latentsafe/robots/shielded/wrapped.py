"""A robot around another, which to LeRobot is the other."""

from typing import Any

from lerobot.robots.robot import Robot


class WrappedRobot(Robot):
    """It has the features, the state of connection and all else of the robot inside.

    Attributes:
        inner: the robot inside.
    """

    inner: Robot

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "inner" not in self.__dict__:
            raise AttributeError(name)
        return getattr(self.inner, name)

    @property
    def observation_features(self) -> dict:
        """Those of the inner robot."""
        return self.inner.observation_features

    @property
    def action_features(self) -> dict:
        """Those of the inner robot."""
        return self.inner.action_features

    @property
    def is_connected(self) -> bool:
        """Whether the inner robot is."""
        return "inner" in self.__dict__ and self.inner.is_connected

    @property
    def is_calibrated(self) -> bool:
        """Whether the inner robot is."""
        return self.inner.is_calibrated

    def calibrate(self) -> None:
        """Calibrate the inner robot."""
        self.inner.calibrate()

    def configure(self) -> None:
        """Configure the inner robot."""
        self.inner.configure()
