"""The real Franka as a LeRobot robot, with the simulation's features."""

import logging
import threading
import time
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.robots.robot import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from scipy.spatial.transform import Rotation, Slerp

from lerobot_latentsafe.franka.actions import (
    ACTION_NAMES,
    GRIPPER_NAME,
    GRIPPER_WIDTH,
    JOINT_NAMES,
    POINTING_DOWN,
    STATE_NAMES,
    read_action,
)
from lerobot_latentsafe.robots.franka.config_franka import LatentSafeFrankaConfig
from lerobot_latentsafe.robots.franka.driver import ArmState, FrankaDriver, FrankaError, FrankyDriver, GripperError
from lerobot_latentsafe.robots.franka_device import FrankaDevice

logger = logging.getLogger(__name__)

STREAM_HZ = 200
DOWN = Rotation.from_matrix(POINTING_DOWN)


class LatentSafeFranka(FrankaDevice, Robot):
    """Follows end-effector deltas by Cartesian impedance.

    An action moves the commanded pose; a thread interpolates towards it over one control step and sends it on at 200
    Hz. The commanded pose stays in the workspace and close to the measured one. Without a new action within the
    watchdog's time the arm holds where it is. After a reflex the arm recovers and goes on from where it stands, a few
    times; then, and for every other error, the episode ends with an exception, and LeRobot keeps what it recorded.
    """

    config_class = LatentSafeFrankaConfig
    name = "latentsafe_franka"

    def __init__(self, config: LatentSafeFrankaConfig, driver: FrankaDriver | None = None):
        super().__init__(config)
        from lerobot.cameras.utils import make_cameras_from_configs

        self.config = config
        self.driver = driver or FrankyDriver(config)
        self.cameras = make_cameras_from_configs(config.cameras)
        self._stream: _Stream | None = None
        self._connected = False
        self._opening = 1.0
        self._recoveries = 0

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
        """Connect cameras and arm, and begin to hold still."""
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is already connected")
        for camera in self.cameras.values():
            camera.connect()
        self.driver.connect()
        state = self.driver.state()
        self._connected, self._recoveries = True, 0
        self._opening = state.width / GRIPPER_WIDTH
        if self.config.monitor:
            logger.warning("monitor mode: actions are checked and logged, the arm does not move")
        else:
            self._start(state)

    def _start(self, state: ArmState) -> None:
        self.driver.start()
        self._stream = _Stream(self.driver, state, self.config.fps, self.config.watchdog)
        self._stream.start()

    def get_observation(self) -> dict:
        """State and images.

        Raises:
            FrankaError: the arm stopped and has recovered too often.
            GripperError: the gripper does not answer.
            ValueError: a camera gives images of another size than configured.
        """
        self._require_connection()
        state = self._recovered_state()
        turned = (state.rotation * DOWN.inv()).as_rotvec()
        values = [*state.joints, np.clip(state.width / GRIPPER_WIDTH, 0, 1), *state.position, *turned]
        observation: dict[str, Any] = dict(zip(STATE_NAMES, map(float, values)))
        for name, camera in self.cameras.items():
            observation[name] = camera.async_read()
            expected = self.observation_features[name]
            if observation[name].shape != expected:
                raise ValueError(
                    f"camera {name!r} gives images of shape {observation[name].shape}, configured is {expected}; "
                    "set its width and height to what it delivers"
                )
        return observation

    def send_action(self, action: dict) -> dict:
        """Move by an action, or to a joint configuration; see `robots/franka_interface.py`.

        Returns:
            What was commanded, after all limits.

        Raises:
            ValueError: wrong names or values that are not finite; nothing was sent.
        """
        self._require_connection()
        command = read_action(action, self.config.fps)
        if command.joints is not None:
            self._move_joints(command.joints, command.gripper)
            return {**dict(zip(JOINT_NAMES, command.joints.tolist())), GRIPPER_NAME: command.gripper}
        if self.config.monitor:
            logger.info("monitor mode, not executed: %s", np.round(command.delta, 4).tolist())
            return dict(zip(ACTION_NAMES, command.delta.tolist()))
        state = self._recovered_state()
        position, rotation = self._stream.target()
        wanted = self._within_limits(position + command.delta[:3], state)
        turned = self._near(Rotation.from_rotvec(command.delta[3:6]) * rotation, state)
        self._stream.set_target(wanted, turned)
        self._set_gripper(command.gripper)
        executed = [*(wanted - position), *(turned * rotation.inv()).as_rotvec(), command.gripper]
        return dict(zip(ACTION_NAMES, map(float, executed)))

    def disconnect(self) -> None:
        """Stop the arm, whatever state it is in, and free the cameras."""
        self._require_connection()
        self._connected = False
        try:
            self._stop_stream()
        finally:
            try:
                self.driver.disconnect()
            finally:
                for camera in self.cameras.values():
                    camera.disconnect()

    def _within_limits(self, position: np.ndarray, state: ArmState) -> np.ndarray:
        """A position in the workspace and at most `max_lead` ahead of the measured one on each axis."""
        inside = np.clip(position, self.config.workspace_low, self.config.workspace_high)
        lead = self.config.max_lead
        return np.clip(inside, state.position - lead, state.position + lead)

    def _near(self, rotation: Rotation, state: ArmState) -> Rotation:
        """A rotation at most `max_lead_turn` ahead of the measured one."""
        ahead = (rotation * state.rotation.inv()).as_rotvec()
        angle = np.linalg.norm(ahead)
        if angle <= self.config.max_lead_turn:
            return rotation
        return Rotation.from_rotvec(ahead * self.config.max_lead_turn / angle) * state.rotation

    def _set_gripper(self, opening: float) -> None:
        # The Franka Hand takes whole motions, not a stream: a new one only when the wish has changed.
        if abs(opening - self._opening) > 0.05:
            self.driver.move_gripper(opening * GRIPPER_WIDTH)
            self._opening = opening

    def _move_joints(self, joints: np.ndarray, gripper: float) -> None:
        state = self._recovered_state()
        if self.config.monitor or np.abs(joints - state.joints).max() < 0.01:
            return
        self._stop_stream()
        self._set_gripper(gripper)
        self.driver.move_joints(joints)
        self._start(self.driver.state())

    def _recovered_state(self) -> ArmState:
        """The arm's state, after recovering from a reflex if need be."""
        try:
            if self._stream is not None and self._stream.error is not None:
                raise self._stream.error
            return self.driver.state()
        except FrankaError as e:
            if self.config.monitor or self._recoveries >= self.config.max_recoveries:
                raise
            self._recoveries += 1
            logger.error("%s: recovering (%d of %d)", e, self._recoveries, self.config.max_recoveries)
            self._stop_stream(quietly=True)
            self.driver.recover()
            state = self.driver.state()
            self._start(state)
            return state

    def _stop_stream(self, quietly: bool = False) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.stop()
            try:
                self.driver.stop()
            except FrankaError:
                if not quietly:
                    raise

    def _require_connection(self) -> None:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected; call connect() first")


class _Stream(threading.Thread):
    """Sends interpolated poses to the driver, and holds when no new target comes.

    Attributes:
        error: what stopped it.
    """

    def __init__(self, driver: FrankaDriver, state: ArmState, fps: int, watchdog: float):
        super().__init__(daemon=True, name="franka-stream")
        self.driver, self.period, self.watchdog = driver, 1 / fps, watchdog
        self.error: FrankaError | GripperError | None = None
        self._lock, self._stopping = threading.Lock(), threading.Event()
        self._from = self._to = (state.position, state.rotation)
        self._since = time.monotonic()
        self._stale = True

    def target(self) -> tuple[np.ndarray, Rotation]:
        """The pose commanded last."""
        with self._lock:
            return self._to

    def set_target(self, position: np.ndarray, rotation: Rotation) -> None:
        """Reach a pose within one control step from now."""
        with self._lock:
            self._from, self._to = self._now(), (position, rotation)
            self._since, self._stale = time.monotonic(), False

    def _now(self) -> tuple[np.ndarray, Rotation]:
        share = min(1.0, (time.monotonic() - self._since) / self.period)
        (p0, r0), (p1, r1) = self._from, self._to
        turned = Slerp([0, 1], Rotation.concatenate([r0, r1]))(share)
        return p0 + share * (p1 - p0), turned

    def run(self) -> None:
        while not self._stopping.wait(1 / STREAM_HZ):
            try:
                with self._lock:
                    pose = self._now()
                    self._watch()
                self.driver.track(*pose)
            except (FrankaError, GripperError) as e:  # raised again by whoever acts next
                self.error = e
                return

    def _watch(self) -> None:
        """Hold where the arm is once no action has come for too long."""
        if not self._stale and time.monotonic() - self._since > self.watchdog:
            logger.warning("no action for %.2f s: holding", self.watchdog)
            state = self.driver.state()
            self._from = self._to = (state.position, state.rotation)
            self._stale = True

    def stop(self) -> None:
        """End the thread."""
        self._stopping.set()
        self.join(timeout=1.0)
