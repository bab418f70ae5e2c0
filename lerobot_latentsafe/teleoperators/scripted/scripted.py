"""Scripted operators as a LeRobot teleoperator, so that lerobot-record runs without a person."""

from functools import cached_property
from typing import Any

import numpy as np
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.errors import DeviceNotConnectedError

from lerobot_latentsafe.franka.actions import ACTION_NAMES, action_limits
from lerobot_latentsafe.franka.behaviors import begin
from lerobot_latentsafe.robots.franka_device import FrankaDevice
from lerobot_latentsafe.robots.franka_mujoco.franka_mujoco import LatentSafeFrankaMujoco
from lerobot_latentsafe.robots.simulated import connected_simulation
from lerobot_latentsafe.teleoperators.scripted.config_scripted import LatentSafeScriptedConfig


class LatentSafeScripted(FrankaDevice, Teleoperator):
    """Plays its behaviour from the start of each episode of the connected simulation, then holds still."""

    config_class = LatentSafeScriptedConfig
    name = "latentsafe_scripted"

    def __init__(self, config: LatentSafeScriptedConfig):
        super().__init__(config)
        self.config = config
        self._connected = False
        self._episode = None
        self._actions = iter(())
        self._last = np.zeros(len(ACTION_NAMES))

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
        # The robot is found at the first action: lerobot-record connects teleoperators before robots.
        self._connected = True

    def get_action(self) -> dict[str, float]:
        """The next action; clipped into its limits, so that what is recorded is what is executed."""
        if not self._connected:
            raise DeviceNotConnectedError(f"{self} is not connected; call connect() first")
        robot = connected_simulation(LatentSafeFrankaMujoco)
        if self._episode != (robot, robot.episode):
            self._episode = (robot, robot.episode)
            rng = np.random.default_rng([self.config.seed, robot.scene.seed])
            self._actions = begin(self.config.behavior, robot.scene, self.config.speed, rng)
        still = np.append(np.zeros(6), self._last[6])
        self._last = np.clip(next(self._actions, still), *action_limits(robot.scene.fps))
        return dict(zip(ACTION_NAMES, self._last.tolist()))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """There is nothing to feel."""

    def disconnect(self) -> None:
        """Let go."""
        self._connected = False
