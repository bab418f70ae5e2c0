"""Names, units and limits of the SO-101, as LeRobot's own `so101_follower` has them, and its inverse kinematics.

State and action have the same six names. An action is where the joints are to go: absolute targets, not changes.
Joints are in degrees, the gripper goes from 0, closed, to 100, open. At zero the upper arm stands upright and the
forearm points forward, level; positive lift leans forward, positive elbow and wrist bend down, positive pan turns left.
"""

import logging
from collections.abc import Mapping

import numpy as np

logger = logging.getLogger(__name__)

FPS = 30
CAMERAS = ("front", "wrist")
IMAGE_SIZE = 64
"""Side of both cameras' pictures, pixels."""
EPISODE_SECONDS = 4.0
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
NAMES = [f"{joint}.pos" for joint in JOINTS]
LOW = np.array([-110.0, -100.0, -97.0, -95.0, -157.0, 0.0])
HIGH = np.array([110.0, 100.0, 97.0, 95.0, 163.0, 100.0])

SHOULDER = np.array([0.030, 0.117])
"""Axis of the shoulder's lift: ahead of the pan's axis and above the table, m."""
UPPER_ARM, FOREARM, HAND = 0.116, 0.135, 0.160
"""From axis to axis, and from the wrist's to the tip of the closed gripper, m."""


def check_image_size(pixels: int) -> None:
    """Refuse a size that cannot be drawn.

    Raises:
        ValueError: naming it and what can be.
    """
    if not 16 <= pixels <= 1024:
        raise ValueError(f"image_size is {pixels}; expected 16 to 1024 pixels")


class OutOfReachError(ValueError):
    """No joint angles bring the tip there."""


def read_targets(action: Mapping[str, float]) -> np.ndarray:
    """An action dict as targets (6,), clipped into the joints' limits, which the log then says.

    Raises:
        ValueError: other names, or a value that is not finite.
    """
    if set(action) != set(NAMES):
        raise ValueError(f"action has the names {', '.join(sorted(action)) or '(none)'}; expected {', '.join(NAMES)}")
    wanted = np.array([float(action[name]) for name in NAMES])
    broken = [name for name, value in zip(NAMES, wanted) if not np.isfinite(value)]
    if broken:
        raise ValueError(f"action has non-finite values for {', '.join(broken)}; nothing was sent to the robot")
    targets = np.clip(wanted, LOW, HIGH)
    if off := [i for i in range(6) if abs(wanted[i] - targets[i]) > 1e-6]:
        shown = ", ".join(f"{NAMES[i]} {wanted[i]:.4g} to {targets[i]:.4g}" for i in off)
        logger.warning("action out of range, clipped: %s", shown)
    return targets


def joints_for(tip: np.ndarray, pitch: float) -> np.ndarray:
    """Angles of pan, lift, elbow and wrist (4,), degrees.

    Args:
        tip: azimuth in degrees, distance from the pan's axis and height above the table in m.
        pitch: how far the hand points down, degrees.

    Raises:
        OutOfReachError: the tip cannot be there.
    """
    azimuth, distance, height = tip
    down = np.radians(pitch)
    x, z = np.array([distance, height]) + HAND * np.array([-np.cos(down), np.sin(down)]) - SHOULDER
    reach = np.hypot(x, z)
    bent = (UPPER_ARM**2 + FOREARM**2 - reach**2) / (2 * UPPER_ARM * FOREARM)
    if not abs(bent) < 1:
        raise OutOfReachError(
            f"the tip cannot be {distance:.3f} m ahead and {height:.3f} m high at {pitch:.0f} degrees"
        )
    elbow = np.pi / 2 - np.arccos(bent)
    # The forearm leaves the upper arm at a right angle where the elbow is at zero.
    along, across = UPPER_ARM - FOREARM * np.sin(elbow), FOREARM * np.cos(elbow)
    lift = np.arctan2(x, z) - np.arctan2(across, along)
    joints = np.array([azimuth, *np.degrees([lift, elbow, down - lift - elbow])])
    if (joints < LOW[:4]).any() or (joints > HIGH[:4]).any():
        raise OutOfReachError(f"joints would be at {np.round(joints)} degrees, beyond {LOW[:4]} to {HIGH[:4]}")
    return joints


PITCH = 55.0
"""How far the hand points down while it pushes, degrees."""
REST = np.append(joints_for(np.array([0.0, 0.14, 0.06]), PITCH), [0.0, 2.0])
"""Where an episode begins (6,)."""
