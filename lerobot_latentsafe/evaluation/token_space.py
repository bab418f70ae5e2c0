"""Where world models of every kind are compared: the tokens of one frozen encoder, and their principal components.

Whatever a world model imagines is turned into the tokens of the frame that it means. What is recorded has such
tokens, too: in a token cache. So the frames of a GRU, of a DINO-WM and of an RSSM are held against the same truth.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from safetensors.torch import load_file
from torch import Tensor

from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.datasets.frame_cache import FrameCache, FrameCacheError, basis_file
from lerobot_latentsafe.encoders.perception import FrameBasis, Perception, PerceptionConfig
from lerobot_latentsafe.evaluation.world_model import seen
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.pictures import to_model_images
from lerobot_latentsafe.safety_model import SafetyModel

COMPONENTS, TOKENS = SPACES = ("frame components", "all tokens")
ALL = "all cameras"
SECONDS = (1 / 3, 0.4, 2 / 3, 0.8, 1.0, 2.0)
"""How far ahead frames are compared."""
ENCODED_AT_ONCE = 32


class Moment(NamedTuple):
    """A time ahead that frames are compared at: its name, and how many recorded ticks ahead it is."""

    name: str
    ticks: int


def moments(fps: int) -> list[Moment]:
    """All of them, of recordings at so many ticks a second."""
    return [Moment(f"{seconds:.2g} s", round(seconds * fps)) for seconds in SECONDS]


def ticks_a_step(config: LatentSafeConfig) -> int:
    """Recorded ticks that a step of a filter's world model takes."""
    return config.world_model.frame_skip


def steps_of(config: LatentSafeConfig, ticks: int) -> int | None:
    """Steps of a filter's world model that take so many recorded ticks; None if no number of steps does."""
    steps, rest = divmod(ticks, ticks_a_step(config))
    return None if rest or not steps else steps


class TokenSpace:
    """The tokens of a recording, and what becomes of other frames' tokens beside them.

    Args:
        meta: of the recording's copy with a token cache.

    Raises:
        FrameCacheError: it has no cache, or one of pictures.
    """

    def __init__(self, meta: LeRobotDatasetMetadata):
        self.cache = FrameCache.open(meta.root, meta)
        manifest = self.cache.manifest
        if "encoder_hash" not in manifest:
            raise FrameCacheError(
                f"the cache in {meta.root} holds pictures, but world models are compared by an encoder's tokens; build "
                "one with latentsafe cache --encoder=auto"
            )
        self.root, self.cameras, self.fps = Path(meta.root), sorted(manifest["cameras"]), meta.fps
        found = load_file(basis_file(meta.root))
        self.basis = FrameBasis(*found["axes"].shape)
        self.basis.load_state_dict({key: found[key] for key in self.basis.state_dict()})

    def recorded(self, index: np.ndarray) -> Tensor:
        """Tokens (N, P, C) of frames (N,)."""
        return self.cache.frames(index, ["tokens"])[0]["tokens"]

    @cached_property
    def mean(self) -> Tensor:
        """The tokens (P, C) of the mean of the data that the components were found in."""
        return self.basis.mean.unflatten(0, self.cache.percepts["tokens"].shape[1:])

    def imagined(self, model: SafetyModel, latent: Latent) -> Tensor | None:
        """Tokens (B, P, C) of the frames that latents mean: told by the world model, or seen in what it draws.

        Returns:
            None where there are none: it is blind, it does not draw, or it draws other cameras.
        """
        world_model = model.world_model
        tokens = world_model.tokens_of(latent)
        if tokens is None and world_model.draws and world_model.image_keys == self.cameras:
            tokens = self._encoded(world_model.decode(world_model.features(latent)))
        return None if tokens is None else tokens.cpu()

    def _encoded(self, pictures: dict[str, Tensor]) -> Tensor:
        """Tokens (N, P, C) of pictures, camera key -> (N, 3, S, S), about in [0, 1]."""
        small = {key: to_model_images(p.clamp(0, 1), self.cache.image_size) for key, p in pictures.items()}
        parts = zip(*(small[key].split(ENCODED_AT_ONCE) for key in self.cameras))
        return torch.cat([self._perception.tokens(dict(zip(self.cameras, part))) for part in parts])

    @cached_property
    def _perception(self) -> Perception:
        manifest, n_components = self.cache.manifest, self.basis.axes.shape[1]
        config = PerceptionConfig(manifest["encoder"], manifest["encoder_hash"], components=n_components)
        return Perception(config, self.cameras, self.cache.image_size)

    def views(self, difference: Tensor) -> dict[str, dict[str, Tensor]]:
        """A difference of tokens (N, P, C) in both spaces: space -> all cameras or one of them -> (N, D).

        What one camera shows is the difference if the others' frames were as they should be.
        """
        parts = difference.unflatten(-1, (len(self.cameras), -1)).unbind(-2)
        axes = self.basis.axes.unflatten(0, (difference.shape[1], len(self.cameras), -1)).unbind(1)
        components = [part.flatten(1) @ axis.flatten(0, 1) for part, axis in zip(parts, axes)]
        by_camera = lambda rows: dict(zip(self.cameras, rows))  # noqa: E731
        return {
            COMPONENTS: {ALL: torch.stack(components).sum(0), **by_camera(components)},
            TOKENS: {ALL: difference.flatten(1), **by_camera(part.flatten(1) for part in parts)},
        }

    def nearest(self, tokens: Tensor) -> np.ndarray:
        """Indices (N,) of the recorded frames whose components are nearest to those of tokens (N, P, C)."""
        recorded = torch.from_numpy(np.array(self.cache.percepts["vector"])).float()
        return torch.cdist(self.basis(tokens), recorded).argmin(1).numpy()


# -- who says what comes next ---


class Futures(Protocol):
    """Says what comes after recorded frames under recorded actions."""

    def __call__(self, start: np.ndarray, follow: np.ndarray, observed: int) -> Iterator[tuple[Moment, Tensor | None]]:
        """The tokens (N, P, C) at each moment that it can speak of, or None if it tells no tokens.

        Args:
            start: (N,), the last frames that are seen.
            follow: (N,), the frames at which the actions begin that are taken from then on.
            observed: how many frames are seen.
        """


@dataclass(frozen=True)
class Imagination:
    """What a world model imagines.

    Attributes:
        deaf: it imagines standing still whatever is done: what a model is like that ignores the action.
    """

    model: SafetyModel
    reader: ClipReader
    space: TokenSpace
    deaf: bool = False

    @torch.no_grad()
    def __call__(self, start: np.ndarray, follow: np.ndarray, observed: int) -> Iterator[tuple[Moment, Tensor | None]]:
        """See `Futures`."""
        model, config = self.model, self.model.config
        steps = {steps_of(config, moment.ticks): moment for moment in moments(self.space.fps)}
        latent = self._seen(start, observed)
        action = self.reader.cut(follow, length=1 + max(n for n in steps if n)).action
        still = model.units.still_as(action[:, 0])
        for t in range(1, action.shape[1]):
            latent = model.world_model.step(latent, still if self.deaf else action[:, t])
            if t in steps:
                yield steps[t], self.space.imagined(model, latent)

    def _seen(self, start: np.ndarray, observed: int) -> Latent:
        first = start - (observed - 1) * ticks_a_step(self.model.config)
        clip, latent = self.reader.cut(first, self.model.world_model, length=observed), None
        for t in range(observed):
            latent = seen(self.model, latent, clip, t)
        return latent


@dataclass(frozen=True)
class Copy:
    """The last frame that was seen, for ever."""

    space: TokenSpace

    def __call__(self, start: np.ndarray, follow: np.ndarray, observed: int) -> Iterator[tuple[Moment, Tensor | None]]:
        """See `Futures`."""
        tokens = self.space.recorded(start)
        return ((moment, tokens) for moment in moments(self.space.fps))


@dataclass(frozen=True)
class Mean:
    """The mean of the data, whatever was seen."""

    space: TokenSpace

    def __call__(self, start: np.ndarray, follow: np.ndarray, observed: int) -> Iterator[tuple[Moment, Tensor | None]]:
        """See `Futures`."""
        tokens = self.space.mean.expand(len(start), -1, -1)
        return ((moment, tokens) for moment in moments(self.space.fps))
