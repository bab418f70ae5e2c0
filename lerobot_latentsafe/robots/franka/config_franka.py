"""Options of the real Franka."""

from dataclasses import dataclass, field

import numpy as np
from lerobot.cameras import CameraConfig
from lerobot.robots.config import RobotConfig

POSITIVE = (
    "fps", "max_lead", "max_lead_turn", "stiffness", "turning_stiffness", "force_threshold", "torque_threshold",
    "gripper_force", "watchdog",
)  # fmt: skip
"""Options that are numbers more than 0."""


@RobotConfig.register_subclass("latentsafe_franka")
@dataclass(kw_only=True)
class LatentSafeFrankaConfig(RobotConfig):
    """A Franka Research 3 with the Franka Hand, by franky-control. See docs/franka.md before using it.

    Attributes:
        ip: of the robot's control interface (FCI).
        cameras: LeRobot camera configurations; call them `front` and `wrist`, as the simulation does.
        fps: control steps a second, as given to the LeRobot command.
        monitor: never move; read the robot, check and log every action.
        tool_offset: from the end effector that Desk knows to the fingertips' centre, m along its z axis.
        workspace_low, workspace_high: box the commanded tool centre stays in, m in the robot's base frame.
        max_lead: how far the commanded pose may run ahead of the measured one, m; bounds the pressing force.
        max_lead_turn: the same for rotation, rad.
        stiffness, turning_stiffness: of the Cartesian impedance, N/m and N m/rad.
        force_threshold, torque_threshold: of the robot's collision reflex, N and N m.
        gripper_force: N.
        watchdog: without a new action for this long the arm holds where it is, s.
        max_recoveries: reflexes recovered from in one connection before giving up.
        realtime: require a real-time kernel. Without one the robot may stop for lack of timely commands.
    """

    ip: str
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    fps: int = 15
    monitor: bool = False
    tool_offset: float = 0.0616
    workspace_low: tuple[float, float, float] = (0.28, -0.36, 0.024)
    workspace_high: tuple[float, float, float] = (0.72, 0.36, 0.45)
    max_lead: float = 0.04
    max_lead_turn: float = 0.25
    stiffness: float = 600.0
    turning_stiffness: float = 40.0
    force_threshold: float = 20.0
    torque_threshold: float = 20.0
    gripper_force: float = 20.0
    watchdog: float = 0.25
    max_recoveries: int = 3
    realtime: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.workspace_low, self.workspace_high
        if not (np.isfinite([*low, *high]).all() and np.less(low, high).all()):
            raise ValueError(f"workspace_low {low} must be below workspace_high {high} on every axis, both finite")
        for name in POSITIVE:
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a number more than 0")
        if not np.isfinite(self.tool_offset):
            raise ValueError(f"tool_offset is {self.tool_offset}; expected a number of metres")
        if self.max_recoveries < 0:
            raise ValueError(f"max_recoveries is {self.max_recoveries}; expected 0 or more")
        if self.watchdog < 1.5 / self.fps:
            raise ValueError(
                f"watchdog is {self.watchdog} s; at {self.fps} Hz expected at least {1.5 / self.fps:.3f} s"
            )
