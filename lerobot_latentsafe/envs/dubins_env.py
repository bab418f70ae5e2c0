"""The paper's Dubins car as a gymnasium environment, for `lerobot-eval`."""

from typing import ClassVar

import gymnasium as gym
import numpy as np

from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.dubins.ground_truth import exact_value, sample_task_start


def snap_to_three_actions(turn_rate: float) -> float:
    """The nearest of the paper's three turn rates."""
    return float(car.TURN_RATES[np.abs(car.TURN_RATES - turn_rate).argmin()])


class DubinsEnv(gym.Env):
    """Drive from the left edge to the right edge of the arena without entering the disc.

    Actions are (turn rate, speed); the drive holds 1 m/s whatever speed is asked for.
    Variants: `continuous` takes any turn rate in [-1.25, 1.25] rad/s, `discrete` the nearest of the paper's
    three; `anywhere` is `continuous` from a random state of the arena with V > 0.02, in any heading.
    Success: reaching x >= 0.9 without ever having been in the failure set. Driving on after a failure is
    allowed (the disc is a no-go zone, not a wall), leaving the view ends the episode.
    """

    metadata: ClassVar[dict] = {"render_modes": ["rgb_array"], "render_fps": car.FPS}
    variants = ("continuous", "discrete", "anywhere")

    def __init__(self, variant: str = "continuous", episode_length: int = 80, image_size: int = 128,
                 render_mode: str = "rgb_array"):  # fmt: skip
        if variant not in self.variants:
            raise ValueError(f"variant is {variant!r}; expected one of {', '.join(self.variants)}")
        self.variant, self.render_mode = variant, render_mode
        self._max_episode_steps = episode_length
        self.task_description = "drive to the right edge without entering the red disc"
        self.task = self.task_description
        self.renderer = car.Renderer(image_size)
        low, high = np.array([-car.MAX_TURN_RATE, car.SPEED]), np.array([car.MAX_TURN_RATE, car.SPEED])
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
        self.steps, self.failed = 0, bool(car.margin(self.state) < 0)
        return self._observation(), self._info(success=False)

    def step(self, action: np.ndarray):
        """One Euler step under (turn rate, speed); see the class for when an episode ends."""
        action = np.asarray(action, float).reshape(-1)
        if action.shape != (2,) or not np.isfinite(action).all():
            raise ValueError(f"action is {action}; expected a finite turn rate in rad/s and the speed in m/s")
        turn_rate = float(np.clip(action[0], -car.MAX_TURN_RATE, car.MAX_TURN_RATE))
        if self.variant == "discrete":
            turn_rate = snap_to_three_actions(turn_rate)
        self.state = car.step(self.state, turn_rate)
        self.steps += 1
        self.failed |= bool(car.margin(self.state) < 0)
        arrived = bool(self.state[0] >= 0.9 and car.in_view(self.state))
        success = arrived and not self.failed
        terminated = arrived or not car.in_view(self.state)
        truncated = self.steps >= self._max_episode_steps and not terminated
        return self._observation(), float(success), bool(terminated), truncated, self._info(success)

    def render(self) -> np.ndarray:
        """The camera's picture (H, W, 3), uint8."""
        return self.renderer(self.state[None])[0]

    def _sample_anywhere(self) -> np.ndarray:
        while True:
            state = self.np_random.uniform([-car.ARENA, -car.ARENA, -np.pi], [0.6, car.ARENA, np.pi])
            if exact_value(state[None])[0] > 0.02:
                return state

    def _observation(self) -> dict[str, np.ndarray]:
        seen = car.observe(self.state[None], self.renderer)
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
            "margin": float(car.margin(self.state)),
            "state": self.state.astype(np.float32),
        }
