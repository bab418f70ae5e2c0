"""The simulated Franka as a LeRobot robot."""

from lerobot_latentsafe.franka.actions import ACTION_NAMES, GRIPPER_NAME, JOINT_NAMES, STATE_NAMES, read_action
from lerobot_latentsafe.franka.scene import FrankaScene
from lerobot_latentsafe.franka.scenes import SCENES, make_scene
from lerobot_latentsafe.robots.franka_device import FrankaDevice
from lerobot_latentsafe.robots.franka_mujoco.config_franka_mujoco import LatentSafeFrankaMujocoConfig
from lerobot_latentsafe.robots.simulated import SimulatedRobot


class LatentSafeFrankaMujoco(FrankaDevice, SimulatedRobot):
    """A scene of `franka/` with the features of the real robot; see `robots/simulated.py`."""

    config_class = LatentSafeFrankaMujocoConfig
    name = "latentsafe_franka_mujoco"
    camera_names = ("front", "wrist")
    state_names = STATE_NAMES

    @property
    def image_size(self) -> int:
        """Side of both cameras' pictures, pixels."""
        return self.config.image_size or SCENES[self.config.scene].image_size

    def make_scene(self) -> FrankaScene:
        """The configured scene."""
        return make_scene(self.config.scene, self.config.variant, self.config.image_size)

    def execute(self, action: dict) -> dict:
        """One step of a motion of the hand, or of a joint move; see `franka/actions.py`."""
        command = read_action(action, self.scene.fps)
        if command.joints is None:
            self.scene.step(command.delta)
            return dict(zip(ACTION_NAMES, command.delta.tolist()))
        self.scene.move_joints(command.joints, command.gripper)
        return {**dict(zip(JOINT_NAMES, command.joints.tolist())), GRIPPER_NAME: command.gripper}
