"""Where the commanded pose may go next: within the workspace, near the arm, and at the speed limit by the clock."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_latentsafe.franka.actions import MAX_SPEED, MAX_TURN_SPEED, action_limits
from lerobot_latentsafe.robots.franka.config_franka import LatentSafeFrankaConfig
from lerobot_latentsafe.robots.franka.driver import ArmState

KEPT = 1.5
"""Control steps."""


class Pose(NamedTuple):
    """Tool centre (3,) in m, and rotation, in the robot's base frame."""

    position: np.ndarray
    rotation: Rotation


def shortest_time(start: Pose, end: Pose) -> float:
    """How long a motion takes at the speed limit of each axis, s."""
    turn = (end.rotation * start.rotation.inv()).as_rotvec()
    return float(max(np.abs(end.position - start.position).max() / MAX_SPEED, np.abs(turn).max() / MAX_TURN_SPEED))


class Limits:
    """Bounds each motion of the commanded pose.

    However often actions come, no more of the speed limit is spent than time has passed. What was not used is kept for
    KEPT control steps, so that a loop that is not quite regular loses nothing.
    """

    def __init__(self, config: LatentSafeFrankaConfig):
        self.config = config
        self._left, self._since = KEPT, -np.inf

    def allowed(self, commanded: Pose, delta: np.ndarray, state: ArmState, now: float) -> Pose:
        """Where a motion (6,) in m and rad leads from the commanded pose, at a time in s."""
        position = self._within(commanded.position + delta[:3], commanded.position, state.position)
        rotation = self._near(Rotation.from_rotvec(delta[3:6]) * commanded.rotation, state.rotation)
        step = np.r_[position - commanded.position, (rotation * commanded.rotation.inv()).as_rotvec()]
        step = self._in_pace(step, now)
        return Pose(commanded.position + step[:3], Rotation.from_rotvec(step[3:]) * commanded.rotation)

    def _within(self, position: np.ndarray, commanded: np.ndarray, measured: np.ndarray) -> np.ndarray:
        """In the workspace, or no further out of it than now; at most `max_lead` from the measured on each axis."""
        low = np.minimum(self.config.workspace_low, commanded)
        high = np.maximum(self.config.workspace_high, commanded)
        lead = self.config.max_lead
        return np.clip(np.clip(position, low, high), measured - lead, measured + lead)

    def _near(self, rotation: Rotation, measured: Rotation) -> Rotation:
        """At most `max_lead_turn` from the measured."""
        ahead = (rotation * measured.inv()).as_rotvec()
        angle = np.linalg.norm(ahead)
        if angle <= self.config.max_lead_turn:
            return rotation
        return Rotation.from_rotvec(ahead * self.config.max_lead_turn / angle) * measured

    def _in_pace(self, step: np.ndarray, now: float) -> np.ndarray:
        """As much of a motion (6,) as the time since the last ones allows on each axis."""
        passed = (now - self._since) * self.config.fps
        self._left = min(KEPT, self._left + passed) if passed > 0 else self._left  # no clock that goes back gives time
        self._since = now
        reach = action_limits(self.config.fps)[1][:6]
        share = min(1.0, self._left)
        taken = np.clip(step, -share * reach, share * reach)
        self._left = max(0.0, self._left - np.abs(taken / reach).max())
        return taken
