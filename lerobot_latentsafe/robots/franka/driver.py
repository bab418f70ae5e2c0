"""The Franka as the robot sees it: an interface, and franky-control behind it.

Poses are of the tool centre between the fingertips, in the robot's base frame; quaternions are (x, y, z, w).
"""

import logging
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_latentsafe.franka.actions import GRIPPER_SPEED, GRIPPER_WIDTH
from lerobot_latentsafe.robots.franka.config_franka import LatentSafeFrankaConfig

logger = logging.getLogger(__name__)


class FrankaError(RuntimeError):
    """The arm stopped: a reflex (collision, limits), the user stop, or a lost connection."""


class ArmFaultError(FrankaError):
    """No recovery mends it: answers that are late or no numbers, or an arm that stopped and was not connected anew."""


class GripperError(RuntimeError):
    """The gripper does not answer."""


@dataclass
class ArmState:
    """Measured joints (7,) in rad, tool centre (3,) in m, rotation, and opening of the fingers in m."""

    joints: np.ndarray
    position: np.ndarray
    rotation: Rotation
    width: float


class FrankaDriver(Protocol):
    """What a driver must do. Every call may raise FrankaError, or GripperError where the gripper is concerned."""

    def connect(self) -> None:
        """Reach robot and gripper; does not move."""

    def start(self) -> None:
        """Begin to hold the present pose, compliantly, until told otherwise."""

    def state(self) -> ArmState:
        """The newest state."""

    def track(self, position: np.ndarray, rotation: Rotation) -> None:
        """Pull towards a pose, from now on. Called at 100 Hz or more."""

    def move_joints(self, joints: np.ndarray) -> None:
        """Go slowly to joint angles and wait; `start` must be called again afterwards."""

    def move_gripper(self, width: float) -> None:
        """Begin to open or close to a width in m, without waiting."""

    def recover(self) -> None:
        """Clear a reflex; `start` must be called again afterwards."""

    def stop(self) -> None:
        """Come to rest."""

    def disconnect(self) -> None:
        """Stop and let go of the robot."""


class FrankyDriver:
    """franky-control 2: Cartesian impedance tracking in its own real-time thread, asynchronous gripper."""

    def __init__(self, config: LatentSafeFrankaConfig):
        self.config = config
        self.robot: Any = None  # these three are of franky, which need not be installed
        self.gripper: Any = None
        self.tracker: Any = None
        self._width, self._gripping, self._in_joints = GRIPPER_WIDTH, None, False

    def connect(self) -> None:
        """Reach robot and gripper; see `FrankaDriver`."""
        try:
            import franky
        except ImportError as e:
            raise ImportError(
                "the real Franka needs franky-control: pip install 'lerobot_policy_latentsafe[franka]'"
            ) from e
        self.franky = franky
        config = self.config
        realtime = franky.RealtimeConfig.Enforce if config.realtime else franky.RealtimeConfig.Ignore
        try:
            self.robot = franky.Robot(config.ip, realtime_config=realtime)
            self.robot.relative_dynamics_factor = 0.1
            self.robot.set_collision_behavior(config.torque_threshold, config.force_threshold)
            self.robot.recover_from_errors()
        except Exception as e:
            raise FrankaError(f"no Franka at {config.ip}: {e}. Are joints unlocked and FCI active in Desk?") from e
        try:
            self.gripper = franky.Gripper(config.ip)
            self._width = self.gripper.width
        except Exception as e:
            raise GripperError(f"no gripper at {config.ip}: {e}. Is the Franka Hand initialised in Desk?") from e

    def start(self) -> None:
        """Begin to hold the present pose."""
        with self._arm_errors():
            self.tracker = self.franky.CartesianImpedanceTracker(
                self.robot,
                translational_stiffness=self.config.stiffness,
                rotational_stiffness=self.config.turning_stiffness,
            )

    def state(self) -> ArmState:
        """The newest state."""
        with self._arm_errors():
            state = self.robot.state
            pose = self.robot.current_pose.end_effector_pose
        if self.tracker is not None and not self.tracker.is_running:
            raise FrankaError("the arm stopped (a reflex, the user stop, or a lost connection)")
        if not np.isclose(np.linalg.norm(pose.quaternion), 1, atol=1e-2):
            raise ArmFaultError(f"the arm tells the quaternion {pose.quaternion}; expected one of length 1")
        rotation = Rotation.from_quat(pose.quaternion)
        tool = np.asarray(pose.translation).ravel() + rotation.apply([0, 0, self.config.tool_offset])
        return ArmState(np.asarray(state.q, float).ravel(), tool, rotation, self._read_width())

    def track(self, position: np.ndarray, rotation: Rotation) -> None:
        """Pull towards a pose, from now on."""
        end_effector = position - rotation.apply([0, 0, self.config.tool_offset])
        with self._arm_errors():
            self.tracker.set_target(self.franky.Affine(end_effector, rotation.as_quat()))

    def move_joints(self, joints: np.ndarray) -> None:
        """Go slowly to joint angles (7,), and wait."""
        self.stop()
        self._in_joints = True
        with self._arm_errors():
            self.robot.move(self.franky.JointMotion(list(joints)))
        self._in_joints = False

    def move_gripper(self, width: float) -> None:
        """Begin to open or close to a width in m."""
        try:
            if width < 0.5 * self._width:  # closing on something: press, whatever is between the fingers
                force, any_width = self.config.gripper_force, GRIPPER_WIDTH
                self._gripping = self.gripper.grasp_async(width, GRIPPER_SPEED, force, any_width, any_width)
            else:
                self._gripping = self.gripper.move_async(width, GRIPPER_SPEED)
        except Exception as e:
            raise GripperError(f"the gripper does not move: {e}") from e

    def recover(self) -> None:
        """Clear a reflex."""
        self.tracker = None
        with self._arm_errors():
            if not self.robot.recover_from_errors():
                raise FrankaError("the robot does not recover; release the user stop and clear the error in Desk")

    def stop(self) -> None:
        """Come to rest."""
        tracker, self.tracker = self.tracker, None
        in_joints, self._in_joints = self._in_joints, False
        with self._arm_errors():
            if tracker is not None:
                tracker.stop()
            if in_joints:  # of a move that nobody waits for any more
                self.robot.move(self.franky.JointStopMotion(), asynchronous=True)

    def disconnect(self) -> None:
        """Stop, and let go of the robot."""
        try:
            self.stop()
        finally:
            self.robot = self.gripper = None

    def _read_width(self) -> float:
        try:
            self._width = float(self.gripper.width)
        except Exception as e:
            raise GripperError(f"the gripper does not answer: {e}") from e
        self._report_gripping()
        return self._width

    def _report_gripping(self) -> None:
        """Say what became of the hand's last motion, if it failed: it ran in a thread, where nobody hears an error."""
        if self._gripping is None or not self._gripping.wait(0):
            return
        gripping, self._gripping = self._gripping, None
        try:
            gripping.get()
        except Exception as e:
            logger.warning("the gripper did not do as it was told: %s", e)

    def _arm_errors(self):
        return _ArmErrors()


class _ArmErrors:
    """Turns whatever the driver raises into FrankaError."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind, error, traceback) -> None:
        if isinstance(error, Exception) and not isinstance(error, FrankaError):
            raise FrankaError(str(error)) from error
