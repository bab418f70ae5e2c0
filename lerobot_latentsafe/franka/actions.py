"""What the simulated and the real Franka share: feature names, units, limits, and the reading of actions.

An action is an end-effector motion over one control step, expressed in the robot's base frame, and a gripper opening:
(dx, dy, dz) in metres, (drx, dry, drz) an axis-angle in radians, and gripper in [0, 1], 0 closed, 1 open. Deltas move
the *commanded* pose, so that tracking lag does not accumulate. All names end in `.pos`, as LeRobot drops others.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

logger = logging.getLogger(__name__)

JOINT_NAMES = [f"joint_{i}.pos" for i in range(1, 8)]
"""Joint angles, radians."""
GRIPPER_NAME = "gripper.pos"
"""Opening of the fingers, 0 closed, 1 open by `GRIPPER_WIDTH`."""
POSE_NAMES = ["ee_x.pos", "ee_y.pos", "ee_z.pos", "ee_rx.pos", "ee_ry.pos", "ee_rz.pos"]
"""Tool centre in metres; its rotation away from pointing straight down as an axis-angle in radians."""
STATE_NAMES = [*JOINT_NAMES, GRIPPER_NAME, *POSE_NAMES]
DELTA_NAMES = ["delta_x.pos", "delta_y.pos", "delta_z.pos", "delta_rx.pos", "delta_ry.pos", "delta_rz.pos"]
ACTION_NAMES = [*DELTA_NAMES, GRIPPER_NAME]

HOME = np.array([0.0, -0.3, 0.0, -2.3, 0.0, 2.0, 0.785])
JOINT_LOW = np.array([-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159])
JOINT_HIGH = np.array([2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159])
JOINT_SPEED = np.array([2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26])
"""The robot's joint velocity limits, rad/s."""
GRIPPER_WIDTH = 0.08
"""Opening of the Franka Hand, m."""
GRIPPER_SPEED = 0.1
"""Speed of the opening, m/s."""
POINTING_DOWN = np.diag([1.0, -1.0, -1.0])
WORKSPACE_LOW, WORKSPACE_HIGH = np.array([0.28, -0.36, 0.024]), np.array([0.72, 0.36, 0.45])
"""Box the commanded tool centre stays in, metres."""
MAX_SPEED, MAX_TURN_SPEED = 0.30, 2.0
"""Limits of the commanded motion, m/s along each axis and rad/s about each."""


def action_limits(fps: int) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest action (7,) of one control step at `fps` steps a second."""
    reach = np.array([MAX_SPEED] * 3 + [MAX_TURN_SPEED] * 3) / fps
    return np.append(-reach, 0.0), np.append(reach, 1.0)


@dataclass
class Command:
    """An action as the robot understood it: `delta` (7,), or `joints` (7,) with a gripper opening."""

    gripper: float
    delta: np.ndarray | None = None
    joints: np.ndarray | None = None


def read_action(action: Mapping[str, float], fps: int) -> Command:
    """Check an action dict and clip it into the limits, saying so in the log.

    LeRobot moves a robot back to its first observation by sending every observed `.pos`: a dict that holds all joint
    positions and no delta is such a joint move.

    Raises:
        ValueError: other names, or a value that is no finite number.
    """
    try:
        values = {name: float(value) for name, value in action.items()}
    except (AttributeError, TypeError, ValueError) as e:
        raise ValueError(f"action {action!r:.200} does not name numbers ({e}); nothing was sent to the robot") from e
    broken = [name for name, value in values.items() if not np.isfinite(value)]
    if broken:
        raise ValueError(f"action has non-finite values for {', '.join(broken)}; nothing was sent to the robot")
    if set(values) == set(ACTION_NAMES):
        wanted = np.array([values[name] for name in ACTION_NAMES])
        low, high = action_limits(fps)
        clipped = np.clip(wanted, low, high)
        _report_clipping(ACTION_NAMES, wanted, clipped)
        return Command(gripper=float(clipped[6]), delta=clipped)
    if set(JOINT_NAMES) <= set(values) <= set(STATE_NAMES):
        wanted = np.array([values[name] for name in JOINT_NAMES])
        joints = np.clip(wanted, JOINT_LOW, JOINT_HIGH)
        _report_clipping(JOINT_NAMES, wanted, joints)
        return Command(gripper=float(np.clip(values.get(GRIPPER_NAME, 1.0), 0, 1)), joints=joints)
    raise ValueError(
        f"action has the names {', '.join(sorted(values)) or '(none)'}; expected {', '.join(ACTION_NAMES)}, "
        f"or {JOINT_NAMES[0]} to {JOINT_NAMES[-1]} for a joint move"
    )


def _report_clipping(names: list[str], wanted: np.ndarray, clipped: np.ndarray) -> None:
    off = np.flatnonzero(np.abs(wanted - clipped) > 1e-6)
    if len(off):
        shown = ", ".join(f"{names[i]} {wanted[i]:.4g} to {clipped[i]:.4g}" for i in off)
        logger.warning("action out of range, clipped: %s", shown)
