"""LeRobot's teleoperators of end effectors, translated to the Franka's actions."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.teleoperators.phone.phone_processor import MapPhoneActionToRobotAction
from lerobot.teleoperators.teleoperator import Teleoperator
from lerobot.teleoperators.utils import make_teleoperator_from_config

from lerobot_latentsafe.franka.actions import ACTION_NAMES, action_limits
from lerobot_latentsafe.teleoperators.end_effector.config_end_effector import LatentSafeEndEffectorConfig

AXES = ("x", "y", "z")


class LatentSafeEndEffector(Teleoperator):
    """Understands three kinds of devices.

    * `delta_x`, `delta_y`, `delta_z` in [-1, 1] and `gripper` as 0 close, 1 stay, 2 open: gamepad, keyboard_ee.
    * A phone's pose with an `enabled` button: the hand follows the phone's motion while the button is held.
    * Our own action names: passed on. WebXR plugins for a Quest can produce either of the latter.
    """

    config_class = LatentSafeEndEffectorConfig
    name = "latentsafe_end_effector"

    def __init__(self, config: LatentSafeEndEffectorConfig, device: Teleoperator | None = None):
        super().__init__(config)
        self.config = config
        self.device = device or make_teleoperator_from_config(config.device)
        self._opening = 1.0
        self._held_at: np.ndarray | None = None

    @cached_property
    def action_features(self) -> dict:
        """Names of the Franka's actions."""
        return dict.fromkeys(ACTION_NAMES, float)

    @property
    def feedback_features(self) -> dict:
        """The device's."""
        return self.device.feedback_features or {}

    @property
    def is_connected(self) -> bool:
        """Whether the device is."""
        return self.device.is_connected

    @property
    def is_calibrated(self) -> bool:
        """Always: the device calibrates itself."""
        return True

    def calibrate(self) -> None:
        """Calibrate the device."""
        self.device.calibrate()

    def configure(self) -> None:
        """Configure the device."""
        self.device.configure()

    def connect(self, calibrate: bool = True) -> None:
        """Connect the device."""
        self.device.connect()

    def disconnect(self) -> None:
        """Disconnect the device."""
        self.device.disconnect()

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Pass feedback on to the device."""
        self.device.send_feedback(feedback)

    def get_action(self) -> dict[str, float]:
        """The device's motion as an action within its limits; standing still while the device says nothing.

        Raises:
            ValueError: the device speaks of something else.
        """
        said = self.device.get_action()
        if set(ACTION_NAMES) <= set(said):
            action = np.array([said[name] for name in ACTION_NAMES], float)
        elif {"delta_x", "delta_y", "delta_z"} <= set(said):
            action = self._from_deltas(said)
        elif not said or "phone.pos" in said:
            action = self._from_phone(said)
        else:
            raise ValueError(
                f"{self.device.name} gives {', '.join(sorted(said))}; expected delta_x, delta_y, delta_z, "
                f"a phone's pose, or {', '.join(ACTION_NAMES)}"
            )
        return dict(zip(ACTION_NAMES, np.clip(action, *action_limits(self.config.fps)).tolist()))

    def _from_deltas(self, said: Mapping[str, float]) -> np.ndarray:
        step = self.config.speed / self.config.fps
        wish = said.get("gripper", 1)
        self._opening = {0: 0.0, 2: 1.0}.get(int(wish), self._opening)
        return np.array([*(step * float(said[f"delta_{axis}"]) for axis in AXES), 0, 0, 0, self._opening])

    def _from_phone(self, said: Mapping[str, Any]) -> np.ndarray:
        """The motion since the last pose, while the button is held; LeRobot's own mapping of axes and buttons."""
        still = np.append(np.zeros(6), self._opening)
        if not said:
            self._held_at = None
            return still
        phone: Any = self.config.device
        mapped = MapPhoneActionToRobotAction(platform=phone.phone_os).action(dict(said))
        self._opening = float(np.clip(self._opening + 0.1 * mapped["gripper_vel"], 0, 1))
        still[6] = self._opening
        if not mapped["enabled"]:
            self._held_at = None
            return still
        position = self.config.scale * np.array([mapped[f"target_{axis}"] for axis in AXES])
        pose = np.append(position, [mapped[f"target_w{axis}"] for axis in AXES])
        moved = np.zeros(6) if self._held_at is None else pose - self._held_at
        self._held_at = pose
        return np.append(moved, self._opening)
