"""A simulated scene as a gymnasium environment, for `lerobot-eval`."""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np


class SceneEnv(gym.Env):
    """A scene with the actions and observations of its robot.

    Failing does not end an episode: what a policy does afterwards is part of the record. `info` carries the privileged
    truth: `is_success`, `failure` (so far), `margin` (< 0: failing now), and what else the scene measures.

    Args:
        scene: with `fps`, `task`, `image_size`, `reset(seed)`, `step(action)`, `proprioception()`, `render(camera)`,
            `truth()`, `close()`; to branch from a state also `set_state`.
        episode_length: control steps.
        limits: lowest and highest action (A,).
    """

    cameras: ClassVar[tuple[str, ...]]
    state_names: ClassVar[list[str]]
    action_names: ClassVar[list[str]]
    metadata: ClassVar[dict] = {"render_modes": ["rgb_array"]}

    def __init__(self, scene: Any, episode_length: int, limits: tuple[np.ndarray, np.ndarray], render_mode: str):
        self.metadata = {**self.metadata, "render_fps": scene.fps}
        self.render_mode, self.scene = render_mode, scene
        self.task_description = self.task = scene.task
        self._max_episode_steps = episode_length
        image = gym.spaces.Box(0, 255, (scene.image_size, scene.image_size, 3), np.uint8)
        self.observation_space = gym.spaces.Dict(
            {
                "pixels": gym.spaces.Dict(dict.fromkeys(self.cameras, image)),
                "agent_pos": gym.spaces.Box(-np.inf, np.inf, (len(self.state_names),), np.float32),
            }
        )
        low, high = limits
        self.action_space = gym.spaces.Box(low.astype(np.float32), high.astype(np.float32))

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start an episode; `options={"state": scene.get_state()}` branches from a state."""
        super().reset(seed=seed)
        chosen = (options or {}).get("state")
        if chosen is not None:
            self.scene.set_state(chosen)
        else:
            self.scene.reset(int(self.np_random.integers(2**31)) if seed is None else seed)
        self.steps, self.failed = 0, False
        return self._observation(), self._info()

    def step(self, action: np.ndarray):
        """One control step under an action (A,) in robot units."""
        action = np.asarray(action, float).reshape(-1)
        if action.shape != (len(self.action_names),) or not np.isfinite(action).all():
            raise ValueError(f"action is {action}; expected finite numbers for {', '.join(self.action_names)}")
        self.scene.step(action)
        self.steps += 1
        info = self._info()
        truncated = self.steps >= self._max_episode_steps
        return self._observation(), float(info["reward"]), False, truncated, info

    def render(self) -> np.ndarray:
        """The front camera's picture (H, W, 3), uint8."""
        return self.scene.render("front")

    def close(self) -> None:
        """Free the OpenGL context."""
        self.scene.close()

    def _observation(self) -> dict:
        pixels = {camera: self.scene.render(camera) for camera in self.cameras}
        return {"pixels": pixels, "agent_pos": self.scene.proprioception()}

    def _info(self) -> dict:
        truth = self.scene.truth()
        self.failed |= bool(truth["failure"])
        return {**truth, "failure": self.failed, "is_success": truth["is_success"] and not self.failed}
