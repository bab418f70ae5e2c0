"""The paper's benchmark: a Dubins car that must avoid a disc, seen by one camera from above.

s = (x, y, heading) in metres and radians evolves by Euler's rule (Section IV-A)

    x' = x + dt v cos(heading),   y' = y + dt v sin(heading),   heading' = heading + dt u

with v = 1 m/s, dt = 0.05 s and turn rate u in [-1.25, 1.25] rad/s. The failure set is the open disc
|p| < 0.5 m around the origin; the margin is l(s) = |p|^2 - 0.25.

Everything is batched over states, so that data, truth and evaluation draw the very same pixels.
"""

import numpy as np

SPEED = 1.0
"""Longitudinal speed, m/s."""
DT = 0.05
"""Time step, s."""
FPS = 20
MAX_TURN_RATE = 1.25
"""Largest turn rate, rad/s."""
RADIUS = 0.5
"""Radius of the obstacle, m."""
TURN_RATES = np.array([-MAX_TURN_RATE, 0.0, MAX_TURN_RATE])
"""The paper's three actions, rad/s."""
VIEW = 1.1
"""Half the width of the camera's view, m."""
ARENA = 1.0
"""The paper's trajectories end where |x| or |y| exceeds this, m."""

STATE_NAMES = ["heading_cos.pos", "heading_sin.pos"]
POSITION_NAMES = ["x.pos", "y.pos"]
ACTION_NAMES = ["turn_rate.vel", "speed.vel"]
"""Commands in rad/s and m/s. The speed is always 1: LeRobot 0.6.1 squeezes actions of a single number, and its
policies then fail to train, so the constant is recorded too."""


def step(states: np.ndarray, turn_rates: np.ndarray | float) -> np.ndarray:
    """One Euler step. states: (..., 3), turn_rates: (...,) in rad/s -> (..., 3); headings are not wrapped."""
    x, y, heading = np.moveaxis(states, -1, 0)
    return np.stack([x + DT * SPEED * np.cos(heading), y + DT * SPEED * np.sin(heading), heading + DT * turn_rates], -1)


def margin(states: np.ndarray) -> np.ndarray:
    """Signed failure margin l(s) = |p|^2 - r^2 in m^2: (..., 3) -> (...,); negative means failure."""
    return states[..., 0] ** 2 + states[..., 1] ** 2 - RADIUS**2


def in_view(states: np.ndarray) -> np.ndarray:
    """Whether the car's centre is inside the camera's view: (..., 3) -> bool (...,)."""
    return np.abs(states[..., :2]).max(-1) <= VIEW


class Renderer:
    """Anti-aliased drawing by signed distances: the obstacle as a red ring, the car as a blue arrow.

    Only the patch around the car is computed per frame; the rest is the precomputed background.
    """

    body_radius, arrow_length, arrow_half_width, ring_half_width = 0.055, 0.20, 0.022, 0.012

    def __init__(self, size: int = 128):
        self.size = size
        self.pixel = 2 * VIEW / size
        self.patch = int(np.ceil(2 * (self.arrow_length + self.body_radius) / self.pixel)) + 2
        pad = self.patch
        centres = (np.arange(-pad, size + pad) + 0.5) * self.pixel - VIEW
        self.xs, self.ys = centres.astype(np.float32), -centres.astype(np.float32)
        distance = np.abs(np.hypot(self.xs[None], self.ys[:, None]) - RADIUS) - self.ring_half_width
        ring = np.clip(0.5 - distance / self.pixel, 0, 1)
        self.background = np.ones((*ring.shape, 3), np.float32)
        self.background[..., 1:] -= ring[..., None]

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """states: (N, 3) -> uint8 RGB images (N, size, size, 3), first row at y = +VIEW."""
        states = np.asarray(states, np.float32)
        images = np.empty((len(states), self.size, self.size, 3), np.uint8)
        for start in range(0, len(states), 16):
            images[start : start + 16] = self._draw(states[start : start + 16])
        return images

    def _draw(self, states: np.ndarray) -> np.ndarray:
        n, pad, patch = len(states), self.patch, self.patch
        x, y, heading = states.T
        # Top-left corner of each patch in the padded image; cars far outside are clamped to the padding.
        last = self.size + 2 * pad - patch
        column = np.clip(np.round((x + VIEW) / self.pixel).astype(int) + pad - patch // 2, 0, last)
        row = np.clip(np.round((VIEW - y) / self.pixel).astype(int) + pad - patch // 2, 0, last)
        columns, rows = column[:, None] + np.arange(patch), row[:, None] + np.arange(patch)
        dx = (self.xs[columns] - x[:, None])[:, None, :]
        dy = (self.ys[rows] - y[:, None])[:, :, None]
        cos, sin = np.cos(heading)[:, None, None], np.sin(heading)[:, None, None]
        forward, left = cos * dx + sin * dy, cos * dy - sin * dx
        half = self.arrow_length / 2
        body = np.sqrt(forward**2 + left**2) - self.body_radius
        arrow = np.maximum(np.abs(forward - half) - half, np.abs(left) - self.arrow_half_width)
        alpha = np.clip(0.5 - np.minimum(body, arrow) / self.pixel, 0, 1)[..., None]

        padded = np.repeat((self.background * 255).round().astype(np.uint8)[None], n, axis=0)
        index = np.arange(n)[:, None, None], rows[:, :, None], columns[:, None, :]
        blue = np.array([0, 0, 1], np.float32)
        behind = self.background[rows[:, :, None], columns[:, None, :]]
        padded[index] = ((behind * (1 - alpha) + blue * alpha) * 255).round().astype(np.uint8)
        return padded[:, pad:-pad, pad:-pad]


def observe(states: np.ndarray, renderer: Renderer) -> dict[str, np.ndarray]:
    """What the robot sees of states (N, 3): image (N, H, W, 3) uint8 and heading (N, 2) as (cos, sin).

    `position` (N, 2) is what a motion-capture system would add; the safety filter never reads it.
    """
    heading = states[:, 2]
    return {
        "image": renderer(states),
        "heading": np.stack([np.cos(heading), np.sin(heading)], -1).astype(np.float32),
        "position": states[:, :2].astype(np.float32),
    }
