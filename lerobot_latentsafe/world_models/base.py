"""The contract between a world model and the rest: encode episodes, step in imagination, be differentiable.

A `Latent` is a batch-first dict of tensors and Markov by construction: everything the model needs to go on is in it.
Among them is the `action` (B, A) that led to it.
Within models actions are in [-1, 1] and images in [0, 1]; `action[t]` is the action that *led to* frame t.
"""

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import draccus
import torch
from torch import Tensor, nn

from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.datasets.frame_cache import FrameCacheError
from lerobot_latentsafe.encoders.perception import Perception
from lerobot_latentsafe.latent import Latent, replace_rows


@dataclass
class WorldModelConfig(draccus.ChoiceRegistry, abc.ABC):
    """Base of world-model configurations; `type` chooses among the registered ones.

    Attributes:
        image_size: side of the square images the model reads; others are area-averaged to it.
        clip_length: frames of a training window.
        frame_skip: ticks of the robot in one step of the model, which sees every so many frames and hears as many
            actions side by side.
    """

    image_size: int = 128
    clip_length: int = 64
    frame_skip: int = 1

    def __post_init__(self) -> None:
        if self.frame_skip < 1:
            raise ValueError(f"frame_skip is {self.frame_skip}; expected at least 1 tick a step of the world model")

    def steps(self, ticks: int) -> int:
        """Steps of the model that cover so many ticks of the robot."""
        return -(-ticks // self.frame_skip)

    @property
    def type(self) -> str:
        """The name it is registered by."""
        return self.get_choice_name(type(self))

    def of_cache(self, manifest: dict) -> "WorldModelConfig":
        """This configuration with what a frame cache tells; by default a cache holds each camera's picture.

        Raises:
            FrameCacheError, EncoderMismatchError: it holds something else.
        """
        if "encoder_hash" in manifest:
            raise FrameCacheError(
                f"this cache holds the tokens of {manifest['encoder']}, a {self.type} world model reads pictures; "
                "build one with latentsafe cache --image_size=... and no encoder"
            )
        return self

    @abc.abstractmethod
    def build(self, image_keys: list[str], state_dim: int, action_dim: int) -> "WorldModel":
        """The world model with fresh weights."""


class WorldModel(nn.Module, abc.ABC):
    """z_t ~ encoder(z_t | z_hat_t, o_t), z_hat_{t+1} ~ transition(z_t, a_t) (Section III)."""

    config: WorldModelConfig
    feature_dim: int
    action_dim: int
    image_keys: list[str]

    @abc.abstractmethod
    def initial(self, batch_size: int) -> Latent:
        """The latent before anything has been seen."""

    @abc.abstractmethod
    def step(self, latent: Latent, action: Tensor) -> Latent:
        """Imagine: next latent (B, ...) under actions (B, A) in [-1, 1], those of `frame_skip` ticks side by side."""

    def sample_step(self, latent: Latent, action: Tensor) -> Latent:
        """One of the latents that may come next; a model that knows only one takes that."""
        return self.step(latent, action)

    @property
    def draws(self) -> bool:
        """Whether it shows a latent's features as pictures, by `decode`."""
        return False

    def decode(self, features: Tensor) -> dict[str, Tensor]:
        """Features (N, D) as pictures, of a model that `draws`: camera key -> (N, 3, S, S), about in [0, 1]."""
        raise NotImplementedError(f"a {self.config.type} world model draws no pictures")

    def tokens_of(self, latent: Latent) -> Tensor | None:
        """The frozen encoder's tokens of the frame that a latent (B, ...) means: (B, P, C), None if it has none."""
        return None

    def frozen_perception(self) -> Perception | None:
        """What makes percepts by a frozen encoder; None of a model that sees otherwise."""
        return None

    @property
    def percept_names(self) -> list[str]:
        """Keys of what `perceive` returns."""
        return self.image_keys

    def load_basis(self, root: Path) -> None:
        """Take over what the frame cache of a dataset was made with beyond its frames, if anything."""

    def perceive(self, images: dict[str, Tensor]) -> dict[str, Tensor]:
        """The part of seeing that is never trained, and that a cache can therefore keep: by default the images.

        Args:
            images: camera key -> (B, C, H, W) in [0, 1].

        Returns:
            name -> (B, ...).
        """
        return images

    def from_cache(self, cached: dict[str, Tensor]) -> dict[str, Tensor]:
        """Percepts of what a frame cache holds of frames, name -> (..., ...): by default the same."""
        return cached

    @abc.abstractmethod
    def correct(self, predicted: Latent, percepts: dict[str, Tensor], state: Tensor) -> Latent:
        """Posterior of a predicted latent given an observation: percepts (B, ...), state (B, S)."""

    @abc.abstractmethod
    def features(self, latent: Latent) -> Tensor:
        """(..., D), what margin, actor and critic read."""

    def latent_of(self, features: Tensor, action: Tensor) -> Latent:
        """The latent with these features (N, D), led to by actions (N, A), of a model whose features tell all of it."""
        raise NotImplementedError(f"the features of a {self.config.type} world model do not tell its latent")

    @abc.abstractmethod
    def ended(self, latent: Latent) -> Tensor:
        """Whether imagination has left the data because episodes end there: bool (...,)."""

    @abc.abstractmethod
    def error(self, latent: Latent, percepts: dict[str, Tensor], state: Tensor) -> Tensor:
        """How far a latent is from what was then seen: squared error (B,), in a unit of the model's own."""

    @abc.abstractmethod
    def loss(self, clip: Clip) -> tuple[Tensor, Tensor, Mapping[str, Tensor | float]]:
        """Training loss, features (B, T, D) of the posterior for the co-trained margin, and metrics."""

    def observe(
        self, latent: Latent | None, action: Tensor | None, percepts: dict[str, Tensor], state: Tensor
    ) -> Latent:
        """Posterior after acting and seeing: one tick of the filter. `latent` None starts an episode."""
        if latent is None:
            latent = self.initial(len(state))
        if action is None:
            action = torch.zeros(len(state), self.action_dim, device=state.device)
        return self.correct(self.step(latent, action), percepts, state)

    def encode(self, clip: Clip) -> Latent:
        """Filtered posteriors of every frame of a clip: tensors (B, T, ...)."""
        latents: list[Latent] = []
        latent = fresh = self.initial(len(clip.state))
        for t in range(clip.state.shape[1]):
            latent = replace_rows(latent, fresh, where=clip.is_first[:, t])
            percepts = {key: value[:, t] for key, value in clip.percepts.items()}
            latent = self.observe(latent, clip.action[:, t], percepts, clip.state[:, t])
            latents.append(latent)
        return {key: torch.stack([z[key] for z in latents], 1) for key in latents[0]}
