"""The scripted leader arm as a LeRobot teleoperator, so that lerobot-record runs without a person."""

from collections.abc import Iterator
from functools import cached_property

import numpy as np

from lerobot_latentsafe.robots.so101_mujoco.so101_mujoco import LatentSafeSO101Mujoco
from lerobot_latentsafe.robots.uncalibrated import Uncalibrated
from lerobot_latentsafe.so101.actions import HIGH, LOW, NAMES
from lerobot_latentsafe.so101.operators import begin
from lerobot_latentsafe.teleoperators.simulated_operator import SimulatedOperator
from lerobot_latentsafe.teleoperators.so101_leader.config_so101_leader import LatentSafeSO101LeaderConfig


class LatentSafeSO101Leader(Uncalibrated, SimulatedOperator):
    """Plays its behaviour from the start of each episode of the connected simulation, then holds still."""

    config_class = LatentSafeSO101LeaderConfig
    name = "latentsafe_so101_leader"
    robot_class = LatentSafeSO101Mujoco

    @cached_property
    def action_features(self) -> dict:
        """Names of the joints' targets."""
        return dict.fromkeys(NAMES, float)

    def begin(self, robot: LatentSafeSO101Mujoco, rng: np.random.Generator) -> Iterator[np.ndarray]:
        """The targets of an episode that has just begun."""
        return begin(self.config.behavior, robot.scene, rng, self.config.interrupted)

    def get_action(self) -> dict[str, float]:
        """Where the leader arm is, (6,) joints in degrees and the gripper, within the follower's limits."""
        robot = self._robot()
        targets = np.clip(next(self._actions, robot.scene.targets), LOW, HIGH)
        return dict(zip(NAMES, targets.tolist()))
