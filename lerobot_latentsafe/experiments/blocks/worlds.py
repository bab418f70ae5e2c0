"""Environments of the blocks as a world, for whoever drives episodes of them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from lerobot.envs import preprocess_observation

from lerobot_latentsafe.envs.franka_env import FrankaEnv


class EnvironmentsWorld:
    """One episode in each of some environments of one scene; `info` is the list of theirs."""

    def __init__(self, envs: Sequence[FrankaEnv], seeds: Sequence[int]):
        self.envs, self.over = envs, np.zeros(len(envs), bool)
        self._observations, self.info = zip(*[env.reset(seed=seed) for env, seed in zip(envs, seeds)])

    def observe(self) -> dict[str, Any]:
        """A LeRobot batch."""
        cameras = self._observations[0]["pixels"]
        pixels = {name: np.stack([seen["pixels"][name] for seen in self._observations]) for name in cameras}
        stacked = {"pixels": pixels, "agent_pos": np.stack([seen["agent_pos"] for seen in self._observations])}
        return {**preprocess_observation(stacked), "task": [env.task for env in self.envs]}

    def step(self, action: np.ndarray) -> None:
        """Act (B, 7) in robot units."""
        stepped = [env.step(a) for env, a in zip(self.envs, action)]
        self._observations, _, _, truncated, self.info = zip(*stepped)
        self.over = self.over | np.array(truncated)
