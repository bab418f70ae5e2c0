"""The real Franka as a LeRobot robot, with the simulation's features."""

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.cameras import Camera
from lerobot.robots.robot import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from scipy.spatial.transform import Rotation

from lerobot_latentsafe.franka.actions import (
    ACTION_NAMES,
    GRIPPER_NAME,
    GRIPPER_WIDTH,
    JOINT_NAMES,
    POINTING_DOWN,
    STATE_NAMES,
    Command,
    read_action,
)
from lerobot_latentsafe.robots.franka.checked import CheckedDriver
from lerobot_latentsafe.robots.franka.config_franka import LatentSafeFrankaConfig
from lerobot_latentsafe.robots.franka.driver import (
    ArmFaultError,
    ArmState,
    FrankaDriver,
    FrankaError,
    FrankyDriver,
    GripperError,
)
from lerobot_latentsafe.robots.franka.gripper import Gripper
from lerobot_latentsafe.robots.franka.limits import Limits, Pose
from lerobot_latentsafe.robots.franka.stream import Stream
from lerobot_latentsafe.robots.franka_device import FrankaDevice

logger = logging.getLogger(__name__)

DOWN = Rotation.from_matrix(POINTING_DOWN)


class LatentSafeFranka(FrankaDevice, Robot):
    """Follows end-effector deltas by Cartesian impedance.

    An action moves the commanded pose; a thread interpolates towards it over one control step and sends it on at 200
    Hz. The commanded pose stays in the workspace and close to the measured one, and moves no faster than the speed
    limit, however often actions come. Without a new action within the watchdog's time the arm holds where it is.

    After a reflex the arm recovers and goes on from where it stands, a few times. Then, and for every other error of
    arm or gripper, it stops, the error is raised, and so is each later call, until it is connected anew. LeRobot keeps
    what it recorded.
    """

    config_class = LatentSafeFrankaConfig
    name = "latentsafe_franka"

    def __init__(self, config: LatentSafeFrankaConfig, driver: FrankaDriver | None = None):
        super().__init__(config)
        from lerobot.cameras.utils import make_cameras_from_configs

        self.config = config
        self.driver = driver or FrankyDriver(config)
        self.cameras = make_cameras_from_configs(config.cameras)
        self._arm = CheckedDriver(self.driver, config.watchdog)
        self._turn = threading.Lock()
        self._held: ExitStack | None = None  # what is to be let go of, also if connect() ended half-way
        self._connected = False

    @cached_property
    def observation_features(self) -> dict:
        """Numbers of the state and shapes of the pictures."""
        shapes = {name: (camera.height, camera.width, 3) for name, camera in self.config.cameras.items()}
        return {**dict.fromkeys(STATE_NAMES, float), **shapes}

    @property
    def is_connected(self) -> bool:
        """Whether cameras and arm answered."""
        return self._connected

    def connect(self, calibrate: bool = True) -> None:
        """Connect cameras and arm, and begin to hold still. If one fails, the others are let go of again.

        Raises:
            FrankaError: no arm, or one that tells no usable state.
            GripperError: no gripper.
        """
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is already connected")
        self._held = ExitStack()
        try:
            for camera in self.cameras.values():
                self._held.callback(_release, camera)
                camera.connect()
            self._held.callback(self._arm.disconnect)
            self.driver.connect()
            self._begin(self._arm.state())
        except BaseException:
            self._connected = False
            try:
                self._held.close()
            except Exception as e:  # the first error is the one to tell
                logger.warning("not all was let go of: %s", e)
            raise

    def _begin(self, state: ArmState) -> None:
        self._connected, self._recoveries = True, 0
        self._failure: Exception | None = None
        self._stream: Stream | None = None
        self._gripper, self._limits = Gripper(self._arm, state.width), Limits(self.config)
        self._held.callback(self._halt)
        if self.config.monitor:
            logger.warning("monitor mode: actions are checked and logged, the arm does not move")
        else:
            self._start(state)

    def _start(self, state: ArmState) -> None:
        self._require_connection()
        self._arm.start()
        here = Pose(state.position, state.rotation)
        self._stream = Stream(self._arm, here, 1 / self.config.fps, self.config.watchdog)
        self._stream.start()

    def get_observation(self) -> dict:
        """State and images.

        Raises:
            FrankaError: the arm stopped and has recovered too often, or its state is late or not finite.
            GripperError: the gripper does not answer.
            ValueError: a camera gives images of another size than configured.
        """
        with self._using_arm():
            state = self._recovered_state()
        turned = (state.rotation * DOWN.inv()).as_rotvec()
        values = [*state.joints, np.clip(state.width / GRIPPER_WIDTH, 0, 1), *state.position, *turned]
        observation: dict[str, Any] = dict(zip(STATE_NAMES, map(float, values)))
        for name, camera in self.cameras.items():
            observation[name] = camera.async_read()
            expected = self.observation_features[name]
            if np.shape(observation[name]) != expected:
                raise ValueError(
                    f"camera {name!r} gives images of shape {np.shape(observation[name])}, configured is {expected}; "
                    "set its width and height to what it delivers"
                )
        return observation

    def send_action(self, action: dict) -> dict:
        """Move by an action, or to a joint configuration; see `franka/actions.py`.

        Returns:
            What was commanded, after all limits.

        Raises:
            ValueError: wrong names or values that are not finite; nothing was sent.
            FrankaError: the arm stopped, now or before; nothing was sent.
            GripperError: the gripper does not answer.
        """
        with self._using_arm():
            command = read_action(action, self.config.fps)
            if command.joints is not None:
                self._move_joints(command)
                return {**dict(zip(JOINT_NAMES, command.joints.tolist())), GRIPPER_NAME: command.gripper}
            if self.config.monitor:
                logger.info("monitor mode, not executed: %s", np.round(command.delta, 4).tolist())
                return dict(zip(ACTION_NAMES, command.delta.tolist()))
            state, now = self._recovered_state(), time.monotonic()
            commanded = self._stream.target()
            wanted = self._limits.allowed(commanded, command.delta[:6], state, now)
            self._gripper.follow(command.gripper, state.width, now)
            self._stream.set_target(wanted)
        turned = (wanted.rotation * commanded.rotation.inv()).as_rotvec()
        executed = [*(wanted.position - commanded.position), *turned, command.gripper]
        return dict(zip(ACTION_NAMES, map(float, executed)))

    def disconnect(self) -> None:
        """Stop the arm, whatever state it is in, and free the cameras; after a connect() that failed, too."""
        if self._held is None:
            raise DeviceNotConnectedError(f"{self} is not connected; call connect() first")
        self._connected = False
        finished = self._turn.acquire(timeout=self.config.watchdog)  # a call that hangs is not waited for
        try:
            held, self._held = self._held, None
            held.close()
        finally:
            if finished:
                self._turn.release()

    @contextmanager
    def _using_arm(self) -> Iterator[None]:
        """One caller at a time. An error of arm or gripper stops the arm, and each later call, until it is reset."""
        self._require_connection()
        if not self._turn.acquire(timeout=self.config.watchdog):
            raise ArmFaultError("another thread uses the arm; nothing was sent. Call the robot from one thread")
        try:
            self._require_connection()
            if self._failure is not None:
                raise ArmFaultError(
                    f"the arm stopped before ({self._failure}) and moves no more. Clear the cause, then disconnect() "
                    "and connect()"
                ) from self._failure
            yield
        except (FrankaError, GripperError) as e:
            self._fail(e)
            raise
        finally:
            self._turn.release()

    def _fail(self, error: Exception) -> None:
        if self._failure is None and not self.config.monitor:
            self._failure = error
            logger.error("the arm stops: %s", error)
            self._halt(quietly=True)

    def _recovered_state(self) -> ArmState:
        """The arm's state, after recovering from a reflex if need be."""
        try:
            if not self.config.monitor:
                self._check_stream()
            return self._arm.state()
        except ArmFaultError:
            raise
        except FrankaError as e:
            if self.config.monitor or self._recoveries >= self.config.max_recoveries:
                raise
            self._recoveries += 1
            logger.error("%s: recovering (%d of %d)", e, self._recoveries, self.config.max_recoveries)
            self._halt(quietly=True)
            self._arm.recover()
            state = self._arm.state()
            self._start(state)
            return state

    def _check_stream(self) -> None:
        if self._stream is None:
            raise ArmFaultError("a move was broken off and the arm does not hold")
        self._stream.check()

    def _move_joints(self, command: Command) -> None:
        state = self._recovered_state()
        if self.config.monitor or np.abs(command.joints - state.joints).max() < 0.01:
            return
        self._halt()
        self._gripper.follow(command.gripper, state.width, time.monotonic())
        self._arm.move_joints(command.joints)
        self._start(self._arm.state())

    def _halt(self, quietly: bool = False) -> None:
        """End the stream, and have the arm come to rest; `quietly` where it stands for another reason already."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.stop()
            try:
                self._arm.stop()
            except FrankaError as e:
                if not quietly:
                    raise
                logger.error("the arm does not confirm that it stops (%s); press the user stop if it moves", e)

    def _require_connection(self) -> None:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected; call connect() first")


def _release(camera: Camera) -> None:
    with suppress(DeviceNotConnectedError):
        camera.disconnect()
