"""What LeRobot robots that are MuJoCo scenes share."""

import abc
from typing import Any

import numpy as np
from lerobot.robots.config import RobotConfig
from lerobot.robots.robot import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_latentsafe.robots.lerobot_events import LeRobotEvents
from lerobot_latentsafe.robots.uncalibrated import Uncalibrated


class SimulatedRobot(Uncalibrated, Robot):
    """One control step of physics for every action, however fast the caller runs.

    LeRobot's recording has no call that resets a scene. The simulation notices which of LeRobot's loops calls, and
    starts each episode from the episode's own seed, so that any teleoperator can record and any recorded episode can
    be replayed (`--robot.seed=<seed + episode>`).

    Attributes:
        slack_s: seconds by which an observation may be older than a period under a filter: nothing real is late.
        camera_names: of the scene's cameras.
        state_names: of the numbers that the scene measures.
        scene: the simulation, or None while not connected. Its `truth()` is for labels and evaluation only.
        episode: counts resets, for operators who want to know when to begin anew.
    """

    slack_s = 0.4
    camera_names: tuple[str, ...]
    state_names: list[str]

    def __init__(self, config: RobotConfig):
        super().__init__(config)
        self.config: Any = config
        self.cameras = dict.fromkeys(self.camera_names)
        self.scene: Any = None
        self.episode = 0
        self._events = LeRobotEvents()

    @property
    @abc.abstractmethod
    def image_size(self) -> int:
        """Side of the cameras' pictures, pixels."""

    @abc.abstractmethod
    def make_scene(self) -> Any:
        """A scene that is not reset yet."""

    @abc.abstractmethod
    def execute(self, action: dict) -> dict:
        """Advance by one control step; returns what was executed.

        Raises:
            ValueError: wrong names or values that are not finite; the simulation is left as it was.
        """

    @property
    def observation_features(self) -> dict:
        """Numbers of the state and shapes of the pictures."""
        shape = (self.image_size, self.image_size, 3)
        return {**dict.fromkeys(self.state_names, float), **dict.fromkeys(self.camera_names, shape)}

    @property
    def is_connected(self) -> bool:
        """Whether there is a scene."""
        return self.scene is not None

    def connect(self, calibrate: bool = True) -> None:
        """Make the scene and its first episode."""
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is already connected")
        scene = self.make_scene()
        scene.reset(self.config.seed)
        scene.render(self.camera_names[0])  # fails here, not in the middle of an episode, where nothing can draw
        self.scene = scene
        self.episode += 1
        _connected.append(self)

    def change_scene(self, scene: Any) -> None:
        """Go on with another scene that has the same cameras and state; it is to be reset then."""
        self._require_connection()
        self.scene.close()
        self.scene = scene

    def reset(self, seed: int) -> None:
        """Begin an episode from a seed."""
        self._require_connection()
        self.scene.reset(seed)
        self.episode += 1

    def get_observation(self) -> dict:
        """State and pictures; begins an episode that LeRobot begins."""
        self._require_connection()
        loop = self._events.take()
        if loop is not None and loop.episode is not None:
            self.reset(self.config.seed + loop.episode)
        state = dict(zip(self.state_names, self.scene.proprioception().tolist()))
        return {**state, **{camera: self.scene.render(camera) for camera in self.camera_names}}

    def send_action(self, action: dict) -> dict:
        """Advance by one control step.

        Returns:
            What was executed, after clipping into the robot's limits.

        Raises:
            ValueError: wrong names or values that are not finite; the simulation is left as it was.
            RuntimeError: the simulation broke down.
        """
        self._require_connection()
        sent = self.execute(action)
        if not np.isfinite(self.scene.data.qpos).all():
            raise RuntimeError("the simulation became unstable (NaN); the episode up to here can be kept")
        return sent

    def disconnect(self) -> None:
        """Close the scene."""
        self._require_connection()
        _connected.remove(self)
        self.scene.close()
        self.scene = None

    def _require_connection(self) -> None:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected; call connect() first")


_connected: list[SimulatedRobot] = []


def connected_simulation[Kind: SimulatedRobot](kind: type[Kind]) -> Kind:
    """The simulated robot of a kind that this process connected last, for operators who look at the scene.

    Raises:
        DeviceNotConnectedError: there is none.
    """
    found = [robot for robot in _connected if isinstance(robot, kind)]
    if not found:
        name = RobotConfig.get_choice_name(kind.config_class)
        raise DeviceNotConnectedError(
            f"scripted operators look at a simulated scene, and none is connected; use them with --robot.type={name}"
        )
    return found[-1]
