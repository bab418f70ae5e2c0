"""The simulated Franka as a LeRobot robot."""

from functools import cached_property

import numpy as np
from lerobot.robots.robot import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_latentsafe.franka.actions import ACTION_NAMES, GRIPPER_NAME, JOINT_NAMES, STATE_NAMES, read_action
from lerobot_latentsafe.franka.scene import FrankaScene
from lerobot_latentsafe.franka.scenes import SCENES, make_scene
from lerobot_latentsafe.robots.franka_device import FrankaDevice
from lerobot_latentsafe.robots.franka_mujoco.config_franka_mujoco import LatentSafeFrankaMujocoConfig
from lerobot_latentsafe.robots.lerobot_events import LeRobotEvents

CAMERAS = ("front", "wrist")


class LatentSafeFrankaMujoco(FrankaDevice, Robot):
    """One control step of physics for every action, however fast the caller runs.

    LeRobot's recording has no call that resets a scene: it *says* when an episode begins, to a person. The simulation
    listens to the same announcement, and then starts from the episode's own seed, so that any teleoperator can record
    and any recorded episode can be replayed (`--robot.seed=<seed + episode>`).

    Attributes:
        scene: the simulation, or None while not connected. Its `truth()` is for labels and evaluation only.
        episode: counts resets, for operators who want to know when to begin anew.
    """

    config_class = LatentSafeFrankaMujocoConfig
    name = "latentsafe_franka_mujoco"

    def __init__(self, config: LatentSafeFrankaMujocoConfig):
        super().__init__(config)
        self.config = config
        self.cameras = dict.fromkeys(CAMERAS)
        self.scene: FrankaScene | None = None
        self.episode = 0
        self._events = LeRobotEvents()

    @cached_property
    def observation_features(self) -> dict:
        """Numbers of the state and shapes of the pictures."""
        size = self.config.image_size or SCENES[self.config.scene].image_size
        return {**dict.fromkeys(STATE_NAMES, float), **dict.fromkeys(CAMERAS, (size, size, 3))}

    @property
    def is_connected(self) -> bool:
        """Whether there is a scene."""
        return self.scene is not None

    def connect(self, calibrate: bool = True) -> None:
        """Make the scene and its first episode."""
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is already connected")
        scene = make_scene(self.config.scene, self.config.variant, self.config.image_size)
        scene.reset(self.config.seed)
        scene.render(CAMERAS[0])  # fails here, not in the middle of an episode, where nothing can draw
        self.scene = scene
        self.episode += 1
        self._events.listen()
        _connected.append(self)

    def reset(self, seed: int) -> None:
        """Begin an episode from a seed."""
        self._require_connection()
        self.scene.reset(seed)
        self.episode += 1

    def get_observation(self) -> dict:
        """State and pictures; begins an episode that LeRobot has announced."""
        self._require_connection()
        announced = self._events.take()
        if isinstance(announced, int):
            self.reset(self.config.seed + announced)
        state = dict(zip(STATE_NAMES, self.scene.proprioception().tolist()))
        return {**state, **{camera: self.scene.render(camera) for camera in CAMERAS}}

    def send_action(self, action: dict) -> dict:
        """Advance by one control step; see `robots/franka_interface.py` for actions.

        Returns:
            What was executed: the action clipped into its limits, or the joint move's targets.

        Raises:
            ValueError: wrong names or values that are not finite; the simulation is left as it was.
            RuntimeError: the simulation broke down.
        """
        self._require_connection()
        command = read_action(action, self.scene.fps)
        if command.joints is None:
            self.scene.step(command.delta)
            sent = dict(zip(ACTION_NAMES, command.delta.tolist()))
        else:
            self.scene.move_joints(command.joints, command.gripper)
            sent = {**dict(zip(JOINT_NAMES, command.joints.tolist())), GRIPPER_NAME: command.gripper}
        if not np.isfinite(self.scene.data.qpos).all():
            raise RuntimeError("the simulation became unstable (NaN); the episode up to here can be kept")
        return sent

    def disconnect(self) -> None:
        """Close the scene."""
        self._require_connection()
        self._events.stop()
        _connected.remove(self)
        self.scene.close()
        self.scene = None

    def _require_connection(self) -> None:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected; call connect() first")


_connected: list[LatentSafeFrankaMujoco] = []


def connected_simulation() -> LatentSafeFrankaMujoco:
    """The simulated robot that this process connected last, for operators who look at the scene.

    Raises:
        DeviceNotConnectedError: there is none.
    """
    if not _connected:
        raise DeviceNotConnectedError(
            "scripted operators look at a simulated scene, and none is connected; "
            "use them with --robot.type=latentsafe_franka_mujoco"
        )
    return _connected[-1]
