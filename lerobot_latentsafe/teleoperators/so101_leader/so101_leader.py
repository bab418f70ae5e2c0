"""The scripted leader arm as a LeRobot teleoperator, so that lerobot-record runs without a person."""

from functools import cached_property
from typing import Any

import numpy as np
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.utils.errors import DeviceNotConnectedError

from lerobot_latentsafe.robots.simulated import connected_simulation
from lerobot_latentsafe.robots.so101_mujoco.so101_mujoco import LatentSafeSO101Mujoco
from lerobot_latentsafe.robots.uncalibrated import Uncalibrated
from lerobot_latentsafe.so101.actions import HIGH, LOW, NAMES
from lerobot_latentsafe.so101.operators import begin
from lerobot_latentsafe.teleoperators.so101_leader.config_so101_leader import LatentSafeSO101LeaderConfig


class LatentSafeSO101Leader(Uncalibrated, Teleoperator):
    """Plays its behaviour from the start of each episode of the connected simulation, then holds still."""

    config_class = LatentSafeSO101LeaderConfig
    name = "latentsafe_so101_leader"

    def __init__(self, config: LatentSafeSO101LeaderConfig):
        super().__init__(config)
        self.config = config
        self._connected = False
        self._episode = None
        self._targets = iter(())

    @cached_property
    def action_features(self) -> dict:
        """Names of the joints' targets."""
        return dict.fromkeys(NAMES, float)

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

    def get_action(self) -> dict[str, float]:
        """Where the leader arm is, (6,) joints in degrees and the gripper, within the follower's limits."""
        if not self._connected:
            raise DeviceNotConnectedError(f"{self} is not connected; call connect() first")
        robot = connected_simulation(LatentSafeSO101Mujoco)
        if self._episode != (robot, robot.episode):
            self._episode = (robot, robot.episode)
            rng = np.random.default_rng([self.config.seed, robot.scene.seed])
            self._targets = begin(self.config.behavior, robot.scene, rng, self.config.interrupted)
        targets = np.clip(next(self._targets, robot.scene.targets), LOW, HIGH)
        return dict(zip(NAMES, targets.tolist()))

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """There is nothing to feel."""

    def disconnect(self) -> None:
        """Let go."""
        self._connected = False
