"""Scripted operators as a LeRobot teleoperator, so that lerobot-record runs without a person."""

from collections.abc import Iterator

import numpy as np

from lerobot_latentsafe.franka.actions import ACTION_NAMES, action_limits
from lerobot_latentsafe.franka.behaviors import begin
from lerobot_latentsafe.robots.franka_device import FrankaDevice
from lerobot_latentsafe.robots.franka_mujoco.franka_mujoco import LatentSafeFrankaMujoco
from lerobot_latentsafe.teleoperators.scripted.config_scripted import LatentSafeScriptedConfig
from lerobot_latentsafe.teleoperators.simulated_operator import SimulatedOperator


class LatentSafeScripted(FrankaDevice, SimulatedOperator):
    """Plays its behaviour from the start of each episode of the connected simulation, then holds still."""

    config_class = LatentSafeScriptedConfig
    name = "latentsafe_scripted"
    robot_class = LatentSafeFrankaMujoco

    def __init__(self, config: LatentSafeScriptedConfig):
        super().__init__(config)
        self._last = np.zeros(len(ACTION_NAMES))

    def begin(self, robot: LatentSafeFrankaMujoco, rng: np.random.Generator) -> Iterator[np.ndarray]:
        """The actions of an episode that has just begun."""
        return begin(self.config.behavior, robot.scene, self.config.speed, rng)

    def get_action(self) -> dict[str, float]:
        """The next action; clipped into its limits, so that what is recorded is what is executed."""
        robot, still = self._robot(), np.append(np.zeros(6), self._last[6])
        self._last = np.clip(next(self._actions, still), *action_limits(robot.scene.fps))
        return dict(zip(ACTION_NAMES, self._last.tolist()))
