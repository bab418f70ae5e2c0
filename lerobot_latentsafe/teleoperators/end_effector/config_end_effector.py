"""Options of the adapter for LeRobot's own teleoperators."""

from dataclasses import dataclass

import draccus
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.teleoperators.gamepad.configuration_gamepad import GamepadTeleopConfig  # noqa: F401, registers it
from lerobot.teleoperators.keyboard.configuration_keyboard import KeyboardEndEffectorTeleopConfig  # noqa: F401
from lerobot.teleoperators.phone.config_phone import PhoneConfig  # noqa: F401

NAME = "latentsafe_end_effector"


@dataclass
class DeviceConfig(draccus.ChoiceRegistry):
    """Any registered teleoperator but the adapter itself: a registry must not nest itself, draccus would recurse."""

    @classmethod
    def get_known_choices(cls) -> dict[str, type]:
        """All registered teleoperators but this one."""
        return {name: kind for name, kind in TeleoperatorConfig.get_known_choices().items() if name != NAME}

    @classmethod
    def get_choice_class(cls, name: str) -> type:
        """The configuration class of a name."""
        return cls.get_known_choices()[name]

    @classmethod
    def get_choice_name(cls, subcls: type) -> str:
        """The name of a configuration class."""
        return TeleoperatorConfig.get_choice_name(subcls)


@TeleoperatorConfig.register_subclass(NAME)
@dataclass(kw_only=True)
class LatentSafeEndEffectorConfig(TeleoperatorConfig):
    """A gamepad, keyboard, phone or plugin that moves the Franka's end effector.

    Attributes:
        device: `--teleop.device.type=gamepad`, `keyboard_ee`, `phone`, or a plugin's.
        fps: of the recording: deltas are per control step.
        speed: at full deflection of gamepad or keyboard, m/s.
        scale: metres of the hand per metre of the phone.
    """

    device: DeviceConfig | None = None
    fps: int = 15
    speed: float = 0.2
    scale: float = 1.0

    def __post_init__(self) -> None:
        if self.device is None:
            raise ValueError("no device: give --teleop.device.type=gamepad, keyboard_ee, phone, or a plugin's")
        if self.fps <= 0 or self.speed <= 0 or self.scale <= 0:
            raise ValueError(f"fps {self.fps}, speed {self.speed} and scale {self.scale} must be positive")
