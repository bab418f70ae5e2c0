"""The one gate to the arm: what a driver tells is in time, finite and in range, and so is what it is told; or an error.

Whatever a driver raises leaves here as FrankaError, which a recovery may mend, as ArmFaultError, which none does, or as
GripperError.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_latentsafe.franka.actions import GRIPPER_WIDTH, JOINT_HIGH, JOINT_LOW
from lerobot_latentsafe.robots.franka.driver import ArmFaultError, ArmState, FrankaDriver, FrankaError, GripperError
from lerobot_latentsafe.runtime.time_limit import in_time

MEASURED = {
    "joints": (JOINT_LOW - 0.2, JOINT_HIGH + 0.2),
    "position": (np.full(3, -1.5), np.full(3, 1.5)),
    "rotation": (np.full(4, -1.01), np.full(4, 1.01)),
    "width": (np.array(-0.01), np.array(GRIPPER_WIDTH + 0.02)),
}
"""What an arm can measure: rad, m in its base frame, a quaternion, m."""
LIMIT_S = {"start": 5.0, "stop": 2.0, "recover": 10.0, "move_joints": 60.0, "move_gripper": 1.0, "disconnect": 5.0}
"""How long a driver may take for what is no part of a tick, s."""


class CheckedDriver:
    """A driver whose every answer can be relied on.

    Args:
        driver: whom to ask.
        patience: how long a state may take, s.
    """

    def __init__(self, driver: FrankaDriver, patience: float):
        self.driver, self.patience = driver, patience

    def state(self) -> ArmState:
        """The newest state, with all numbers finite and such as an arm can measure."""
        return _checked(self._ask("state", self.patience))

    def track(self, position: np.ndarray, rotation: Rotation) -> None:
        """Pull towards a pose; nothing is sent of one that is not finite."""
        if not (np.isfinite(position).all() and np.isfinite(rotation.as_quat()).all()):
            raise ArmFaultError(f"the pose {position}, {rotation.as_quat()} is not finite; it was not sent")
        _typed(lambda: self.driver.track(position, rotation), "track")

    def move_gripper(self, width: float) -> None:
        """Begin to open or close to a width in m."""
        try:
            self._ask("move_gripper", LIMIT_S["move_gripper"], width)
        except ArmFaultError as e:
            raise GripperError(str(e)) from e

    def start(self) -> None:
        """Begin to hold the present pose."""
        self._ask("start", LIMIT_S["start"])

    def move_joints(self, joints: np.ndarray) -> None:
        """Go slowly to joint angles (7,) and wait."""
        self._ask("move_joints", LIMIT_S["move_joints"], joints)

    def recover(self) -> None:
        """Clear a reflex."""
        self._ask("recover", LIMIT_S["recover"])

    def stop(self) -> None:
        """Come to rest."""
        self._ask("stop", LIMIT_S["stop"])

    def disconnect(self) -> None:
        """Stop and let go of the robot."""
        self._ask("disconnect", LIMIT_S["disconnect"])

    def _ask(self, name: str, seconds: float, *given: Any) -> Any:
        return _typed(lambda: in_time(lambda: getattr(self.driver, name)(*given), seconds, name), name)


def _typed[Answer](call: Callable[[], Answer], name: str) -> Answer:
    try:
        return call()
    except (FrankaError, GripperError):
        raise
    except TimeoutError as e:
        raise ArmFaultError(f"the arm does not answer: {e}") from e
    except Exception as e:
        raise ArmFaultError(f"the driver's {name} failed ({type(e).__name__}: {e})") from e


def _checked(told: Any) -> ArmState:
    """A copy of a state, if all of it is what an arm can measure.

    Raises:
        ArmFaultError: naming the value.
    """
    try:
        quaternion = told.rotation.as_quat()
        values = {"joints": told.joints, "position": told.position, "rotation": quaternion, "width": told.width}
        values = {name: np.array(value, float) for name, value in values.items()}
    except (AttributeError, TypeError, ValueError) as e:
        raise ArmFaultError(f"the driver told {told!r}; expected an ArmState of numbers ({e})") from e
    for name, (low, high) in MEASURED.items():
        value = values[name]
        if value.shape != low.shape or not ((value >= low) & (value <= high)).all():
            raise ArmFaultError(
                f"the arm tells {name} {value.tolist()}; expected finite numbers from {low.tolist()} to "
                f"{high.tolist()}. Nothing is sent on such a reading"
            )
    return ArmState(values["joints"], values["position"], told.rotation, float(values["width"]))
