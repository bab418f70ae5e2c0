"""The Franka's scenes as gymnasium environments, for `lerobot-eval`."""

from typing import ClassVar

import gymnasium as gym
import numpy as np

from lerobot_latentsafe.franka.actions import ACTION_NAMES, STATE_NAMES, action_limits
from lerobot_latentsafe.franka.scene import CAMERAS
from lerobot_latentsafe.franka.scenes import SCENES, make_scene


class FrankaEnv(gym.Env):
    """A scene with the actions and observations of the robot `latentsafe_franka_mujoco`.

    Failing does not end an episode: what a policy does afterwards is part of the record. `info` carries the privileged
    truth: `is_success`, `failure` (so far), `margin` (< 0: failing now), and what else the scene measures.
    """

    scene_name: ClassVar[str]
    metadata: ClassVar[dict] = {"render_modes": ["rgb_array"]}

    def __init__(self, variant: str | None = None, episode_length: int | None = None, image_size: int | None = None,
                 render_mode: str = "rgb_array"):  # fmt: skip
        info = SCENES[self.scene_name]
        self.metadata = {**self.metadata, "render_fps": info.fps}
        self.render_mode = render_mode
        self.scene = make_scene(self.scene_name, variant, image_size)
        self.task_description = self.task = self.scene.task
        self._max_episode_steps = episode_length or round(info.episode_seconds * info.fps)
        size = self.scene.image_size
        image = gym.spaces.Box(0, 255, (size, size, 3), np.uint8)
        self.observation_space = gym.spaces.Dict(
            {
                "pixels": gym.spaces.Dict(dict.fromkeys(CAMERAS, image)),
                "agent_pos": gym.spaces.Box(-np.inf, np.inf, (len(STATE_NAMES),), np.float32),
            }
        )
        low, high = action_limits(info.fps)
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
        """One control step under an action (7,) in robot units."""
        action = np.asarray(action, float).reshape(-1)
        if action.shape != (len(ACTION_NAMES),) or not np.isfinite(action).all():
            raise ValueError(f"action is {action}; expected finite numbers for {', '.join(ACTION_NAMES)}")
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
        pixels = {camera: self.scene.render(camera) for camera in CAMERAS}
        return {"pixels": pixels, "agent_pos": self.scene.proprioception()}

    def _info(self) -> dict:
        truth = self.scene.truth()
        self.failed |= bool(truth["failure"])
        return {**truth, "failure": self.failed, "is_success": truth["is_success"] and not self.failed}


class BagEnv(FrankaEnv):
    """Lift an open bag without spilling candy."""

    scene_name = "bag"


class BlocksEnv(FrankaEnv):
    """Pluck a block from between two others."""

    scene_name = "blocks"
