"""Scenes of the simulated arms as worlds, and scripted operators as actors, for whoever drives episodes of them."""

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from lerobot_latentsafe.evaluation.rollouts import Choice
from lerobot_latentsafe.franka.behaviors import Actions
from lerobot_latentsafe.franka.scene import CAMERAS
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

FRONT = "observation.images.front"


class Scene(Protocol):
    """What a simulated arm and its surroundings have."""

    def truth(self) -> dict[str, Any]:
        """What only a simulation knows."""

    def render(self, camera: str) -> np.ndarray:
        """A picture (H, W, 3), uint8."""

    def proprioception(self) -> np.ndarray:
        """The state (S,), float32."""

    def location(self) -> dict[str, float]:
        """What policies may be told that are not to look; most scenes tell nothing."""

    def step(self, action: np.ndarray) -> None:
        """Advance one control step under an action (A,)."""


class SceneWorld:
    """One episode of a scene that has just been reset; `info` is the scene's truth.

    Args:
        n_steps: how long it lasts.
        cameras: those that somebody looks through; drawing takes most of the time.
    """

    def __init__(self, scene: Scene, n_steps: int, cameras: Sequence[str] = CAMERAS):
        self.scene, self.left, self.cameras = scene, n_steps, cameras
        self.info = scene.truth()

    @property
    def over(self) -> np.ndarray:
        """Whether the time is up: bool (1,)."""
        return np.array([self.left <= 0])

    def observe(self) -> dict[str, Tensor]:
        """What the robot would send, as a LeRobot batch of one."""
        images = {
            f"observation.images.{name}": torch.from_numpy(self.scene.render(name)).permute(2, 0, 1)[None] / 255.0
            for name in self.cameras
        }
        told = self.scene.location()
        located = {OBS_ENV_STATE: torch.tensor([[*told.values()]])} if told else {}
        return {**images, **located, OBS_STATE: torch.from_numpy(self.scene.proprioception())[None]}

    def step(self, action: np.ndarray) -> None:
        """Act (1, A) in robot units."""
        self.scene.step(np.asarray(action[0], float))
        self.info, self.left = self.scene.truth(), self.left - 1


def picture(images: Tensor) -> np.ndarray:
    """The first picture of a LeRobot batch (B, 3, H, W) in [0, 1], as uint8 (H, W, 3)."""
    return (images[0].permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()


class OperatorActor:
    """A scripted operator, who goes on trying where a filter overrides.

    Args:
        operator: what it does; a Franka's hand stays where it ends.
        filter: what it is shielded by; None: nothing.
    """

    def __init__(self, operator: Actions, filter: LatentSafePolicy | None = None):
        self.operator, self.filter = operator, filter
        self.action: np.ndarray = np.zeros(7)
        if filter is not None:
            filter.shield.clock = standing_still  # the simulation waits for what is decided
            filter.reset()

    def __call__(self, batch: dict[str, Tensor]) -> Choice:
        wanted = next(self.operator, None)
        self.action = np.append(np.zeros(6), self.action[6]) if wanted is None else wanted
        if self.filter is None:
            return Choice(self.action[None])
        decision = self.filter.shield(batch, torch.from_numpy(self.action).float()[None])
        return Choice(decision.action.cpu().numpy(), decision)
