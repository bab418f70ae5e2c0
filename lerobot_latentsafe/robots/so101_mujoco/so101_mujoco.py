"""The simulated SO-101 as a LeRobot robot."""

from functools import cached_property

from lerobot_latentsafe.robots.simulated import SimulatedRobot
from lerobot_latentsafe.robots.so101_mujoco.config_so101_mujoco import LatentSafeSO101MujocoConfig
from lerobot_latentsafe.so101.actions import CAMERAS, NAMES, read_targets
from lerobot_latentsafe.so101.scene import PushScene


class LatentSafeSO101Mujoco(SimulatedRobot):
    """The scene of `so101/` with the features of LeRobot's own robot; see `robots/simulated.py`.

    Its name is that robot's, so that datasets and calibrations say for which arm they are.
    """

    config_class = LatentSafeSO101MujocoConfig
    name = "so101_follower"
    camera_names = CAMERAS
    state_names = NAMES

    @property
    def image_size(self) -> int:
        """Side of both cameras' pictures, pixels."""
        return self.config.image_size

    @cached_property
    def action_features(self) -> dict:
        """Names of the joints' targets."""
        return dict.fromkeys(NAMES, float)

    def make_scene(self) -> PushScene:
        """The arm, its table and the cube."""
        return PushScene(self.config.image_size)

    def execute(self, action: dict) -> dict:
        """One step towards targets, clipped into the joints' limits."""
        targets = read_targets(action)
        self.scene.step(targets)
        return dict(zip(NAMES, targets.tolist()))
