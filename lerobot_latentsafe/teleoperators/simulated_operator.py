"""What scripted operators of the simulated robots share."""

from collections.abc import Iterator
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.errors import DeviceNotConnectedError

from lerobot_latentsafe.robots.simulated import SimulatedRobot, connected_simulation


class SimulatedOperator(Teleoperator):
    """Plays its behaviour from the start of each episode of the connected simulation.

    Attributes:
        robot_class: of the simulation.
    """

    robot_class: ClassVar[type[SimulatedRobot]]

    def __init__(self, config: TeleoperatorConfig):
        super().__init__(config)
        self.config = config
        self._connected = False
        self._episode: tuple | None = None
        self._actions: Iterator[np.ndarray] = iter(())

    def begin(self, robot: SimulatedRobot, rng: np.random.Generator) -> Iterator[np.ndarray]:
        """The actions of an episode that has just begun."""
        raise NotImplementedError

    @cached_property
    def feedback_features(self) -> dict:
        """None."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether `connect` was called."""
        return self._connected

    def connect(self, calibrate: bool = True) -> None:
        """Be ready; the robot is found at the first action."""
        # Not here: lerobot-record connects teleoperators before robots.
        self._connected = True

    def _robot(self) -> SimulatedRobot:
        """The simulation; at the start of its episodes the behaviour begins anew."""
        if not self._connected:
            raise DeviceNotConnectedError(f"{self} is not connected; call connect() first")
        robot = connected_simulation(self.robot_class)
        if self._episode != (robot, robot.episode):
            self._episode = (robot, robot.episode)
            self._actions = self.begin(robot, np.random.default_rng([self.config.seed, robot.scene.seed]))
        return robot

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """There is nothing to feel."""

    def disconnect(self) -> None:
        """Let go."""
        self._connected = False
