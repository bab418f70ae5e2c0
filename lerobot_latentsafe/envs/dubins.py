"""The paper's benchmark: a Dubins car that must avoid a disc, seen by one camera from above.

s = (x, y, heading) in metres and radians evolves by Euler's rule (Section IV-A)

    x' = x + dt v cos(heading),   y' = y + dt v sin(heading),   heading' = heading + dt u

with v = 1 m/s, dt = 0.05 s and turn rate u in [-1.25, 1.25] rad/s. The failure set is the open disc
|p| < 0.5 m around the origin; the margin is l(s) = |p|^2 - 0.25.

Everything is batched over states, so that data, truth and evaluation draw the very same pixels.
"""

from typing import ClassVar

import gymnasium as gym
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


def step(states: np.ndarray, turn_rates: np.ndarray) -> np.ndarray:
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


def snap_to_three_actions(turn_rate: float) -> float:
    """The nearest of the paper's three turn rates."""
    return float(TURN_RATES[np.abs(TURN_RATES - turn_rate).argmin()])


def sample_task_start(rng: np.random.Generator, min_value: float = 0.1) -> np.ndarray:
    """A start at the left edge, facing the goal, roughly; safety is feasible with room: V > min_value (m^2)."""
    from lerobot_latentsafe.evaluation.ground_truth import exact_value

    while True:
        y = rng.uniform(-0.6, 0.6)
        state = np.array([rng.uniform(-1.0, -0.85), y, np.arctan2(-y, 1.8) + rng.uniform(-0.5, 0.5)])
        if exact_value(state[None])[0] > min_value:
            return state


class DubinsEnv(gym.Env):
    """Drive from the left edge to the right edge of the arena without entering the disc.

    Actions are (turn rate, speed); the drive holds 1 m/s whatever speed is asked for.
    Variants: `continuous` takes any turn rate in [-1.25, 1.25] rad/s, `discrete` the nearest of the paper's
    three; `anywhere` is `continuous` from a random state of the arena with V > 0.02, in any heading.
    Success: reaching x >= 0.9 without ever having been in the failure set. Driving on after a failure is
    allowed (the disc is a no-go zone, not a wall), leaving the view ends the episode.
    """

    metadata: ClassVar[dict] = {"render_modes": ["rgb_array"], "render_fps": FPS}
    variants = ("continuous", "discrete", "anywhere")

    def __init__(self, variant: str = "continuous", episode_length: int = 80, image_size: int = 128,
                 render_mode: str = "rgb_array"):  # fmt: skip
        if variant not in self.variants:
            raise ValueError(f"variant is {variant!r}; expected one of {', '.join(self.variants)}")
        self.variant, self.render_mode = variant, render_mode
        self._max_episode_steps = episode_length
        self.task_description = "drive to the right edge without entering the red disc"
        self.task = self.task_description
        self.renderer = Renderer(image_size)
        low, high = np.array([-MAX_TURN_RATE, SPEED]), np.array([MAX_TURN_RATE, SPEED])
        self.action_space = gym.spaces.Box(low.astype(np.float32), high.astype(np.float32))
        self.observation_space = gym.spaces.Dict(
            {
                "pixels": gym.spaces.Box(0, 255, (image_size, image_size, 3), np.uint8),
                "agent_pos": gym.spaces.Box(-1, 1, (2,), np.float32),
                "environment_state": gym.spaces.Box(-np.inf, np.inf, (2,), np.float32),
            }
        )
        self.state = np.zeros(3)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start an episode; `options={"state": (x, y, heading)}` chooses the state."""
        super().reset(seed=seed)
        chosen = (options or {}).get("state")
        if chosen is not None:
            self.state = np.asarray(chosen, float)
        elif self.variant == "anywhere":
            self.state = self._sample_anywhere()
        else:
            self.state = sample_task_start(self.np_random)
        self.steps, self.failed = 0, bool(margin(self.state) < 0)
        return self._observation(), self._info(success=False)

    def step(self, action: np.ndarray):
        action = np.asarray(action, float).reshape(-1)
        if action.shape != (2,) or not np.isfinite(action).all():
            raise ValueError(f"action is {action}; expected a finite turn rate in rad/s and the speed in m/s")
        turn_rate = float(np.clip(action[0], -MAX_TURN_RATE, MAX_TURN_RATE))
        if self.variant == "discrete":
            turn_rate = snap_to_three_actions(turn_rate)
        self.state = step(self.state, turn_rate)
        self.steps += 1
        self.failed |= bool(margin(self.state) < 0)
        arrived = bool(self.state[0] >= 0.9 and in_view(self.state))
        success = arrived and not self.failed
        terminated = arrived or not in_view(self.state)
        truncated = self.steps >= self._max_episode_steps and not terminated
        return self._observation(), float(success), bool(terminated), truncated, self._info(success)

    def render(self) -> np.ndarray:
        return self.renderer(self.state[None])[0]

    def _sample_anywhere(self) -> np.ndarray:
        from lerobot_latentsafe.evaluation.ground_truth import exact_value

        while True:
            state = self.np_random.uniform([-ARENA, -ARENA, -np.pi], [0.6, ARENA, np.pi])
            if exact_value(state[None])[0] > 0.02:
                return state

    def _observation(self) -> dict[str, np.ndarray]:
        seen = observe(self.state[None], self.renderer)
        return {
            "pixels": seen["image"][0],
            "agent_pos": seen["heading"][0],
            "environment_state": seen["position"][0],
        }

    def _info(self, success: bool) -> dict:
        """Privileged truth, for evaluation only: nothing here reaches a policy."""
        return {
            "is_success": success,
            "failure": self.failed,
            "margin": float(margin(self.state)),
            "state": self.state.astype(np.float32),
        }
