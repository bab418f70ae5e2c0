"""What a frame cache keeps of a frame: its pictures, or the tokens of a frozen encoder."""

import hashlib
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.frame_cache import BASIS, FrameCache, FrameCacheError, basis_file
from lerobot_latentsafe.encoders.patch_encoders import Seen, joined
from lerobot_latentsafe.encoders.perception import Perception, PerceptionConfig
from lerobot_latentsafe.pictures import to_model_images

TOKEN_TYPES = ("float16", "int8")
TOKEN_COMPONENTS = 16
"""Principal components of each camera's token of a patch that are kept: 78% of the variance of the bag's."""
ENCODED_AT_ONCE = 8
"""Frames an encoder reads together: few enough for its activations to stay in a CPU's cache."""
TOGETHER = 2**21
"""Numbers of pictures that are made small together."""
SAMPLED_EPISODES, SAMPLED_FRAMES, SAMPLED_BYTES = 100, 4000, 2**30
"""From so many episodes, and at most so many frames and bytes of tokens, principal components are found."""
PICTURE_SIZE = 32
"""Side of pictures that are kept themselves, by default."""


@dataclass(frozen=True)
class Sight:
    """Episodes as a world model takes them, a few frames at a time."""

    frames: DatasetFrames
    image_size: int

    def length(self, place: int) -> int:
        """Frames of the episode at a place among those that are kept."""
        return self.frames.length(self.frames.episodes[place])

    def pieces(self, place: int, numbers: Sequence[int] | None = None) -> Iterator[dict[str, Tensor]]:
        """Of all its frames, or of some, in order: camera key -> (n, 3, S, S) in [0, 1]."""
        for piece in self.frames.pieces(self.frames.cameras, self.frames.episodes[place], numbers):
            yield {key: self._small(images) for key, images in piece.items()}

    def _small(self, images: Tensor) -> Tensor:
        """Large ones one by one: in floats, a picture is a hundred times as large as what becomes of it."""
        parts = images.split(max(1, TOGETHER // images[0].numel()))
        return torch.cat([to_model_images(part, self.image_size) for part in parts])


class Recipe(Protocol):
    """What is kept of a frame: arrays by name with a frame's shape and type, and what to note of them."""

    arrays: dict[str, tuple[tuple[int, ...], str]]
    manifest: dict

    def prepare(self, folder: Path, see: Sight, n_episodes: int) -> None:
        """What one process must do before any can start."""

    def start(self, folder: Path) -> None:
        """What each process does then."""

    def perceive(self, images: dict[str, Tensor]) -> dict[str, np.ndarray]:
        """Camera key -> (T, 3, S, S) in [0, 1] to name -> (T, ...)."""


class Pictures:
    """Each camera's picture, in 8 bits."""

    def __init__(self, cameras: list[str], image_size: int | None):
        image_size = PICTURE_SIZE if image_size is None else image_size
        self.arrays: dict[str, tuple[tuple[int, ...], str]] = {
            key: ((3, image_size, image_size), "uint8") for key in cameras
        }
        self.manifest = {"image_size": image_size, "percepts": list(cameras)}

    def prepare(self, folder: Path, see: Sight, n_episodes: int) -> None:
        """Nothing is needed beforehand."""

    def start(self, folder: Path) -> None:
        """Nothing is needed then."""

    def perceive(self, images: dict[str, Tensor]) -> dict[str, np.ndarray]:
        """The pictures of some frames: camera key -> uint8 (T, 3, S, S)."""
        return {key: (value * 255).round().to(torch.uint8).numpy() for key, value in images.items()}


class Tokens:
    """A frozen encoder's tokens, whole or their principal components, and what stands for a whole frame: the principal
    components of all its tokens, and the class tokens of an encoder that has them.

    Args:
        image_size: None: the encoder's default.
        dtype: of the tokens: float16, or int8 with a scale for each token.
        basis_from: a folder with a cache whose principal components to use, so that one world model reads both.
        engine: what encodes: torch, or onnx, a graph of ONNX Runtime.

    Raises:
        GraphError: there is no such graph.
    """

    def __init__(
        self, cameras: list[str], image_size: int | None, config: PerceptionConfig, dtype: str = "float16",
        basis_from: str | Path | None = None, engine: str = "torch",
    ):  # fmt: skip
        if dtype not in TOKEN_TYPES:
            raise ValueError(f"--dtype is {dtype!r}; expected {' or '.join(TOKEN_TYPES)}")
        self.perception, self.dtype, self.basis_from = Perception(config, cameras, image_size), dtype, basis_from
        if engine == "onnx":
            self.perception.encode_by_graphs(ENCODED_AT_ONCE)
        self.arrays = {name: (size, "float16") for name, size in self.perception.sizes.items()}
        if dtype == "int8":
            n_patches, _ = shape = self.perception.sizes["tokens"]
            self.arrays |= {"tokens": (shape, dtype), "tokens.scale": ((n_patches, 1), "float16")}
        self.manifest = {
            "image_size": self.perception.image_size,
            "percepts": list(self.perception.sizes),
            "encoder": self.perception.config.encoder,
            "encoder_hash": self.perception.config.encoder_hash,
            "components": config.components,
            "token_components": config.token_components or 0,
        }

    def prepare(self, folder: Path, see: Sight, n_episodes: int) -> None:
        """Take the principal components from elsewhere, or find them in a sample of frames."""
        if self.basis_from is not None:
            other = FrameCache.open(self.basis_from)
            if other.manifest.get("encoder_hash") != self.manifest["encoder_hash"]:
                raise FrameCacheError(
                    f"the cache in {self.basis_from} was made by {other.manifest.get('encoder')}, not by "
                    f"{self.manifest['encoder']} with the same weights; their principal components do not fit"
                )
            if sorted(other.manifest["cameras"]) != self.perception.image_keys:
                raise FrameCacheError(
                    f"the cache in {self.basis_from} sees {', '.join(sorted(other.manifest['cameras']))}, this dataset "
                    f"has {', '.join(self.perception.image_keys)}; their principal components do not fit"
                )
            n, n_other = (manifest.get("token_components", 0) for manifest in (self.manifest, other.manifest))
            if n not in (0, n_other):
                raise FrameCacheError(
                    f"--token_components is {n}, and the cache in {self.basis_from} keeps {n_other}; give the same, or "
                    "0 for whole tokens"
                )
            if other.manifest["percepts"] != list(self.perception.sizes):
                raise FrameCacheError(
                    f"the cache in {self.basis_from} holds {', '.join(other.manifest['percepts'])}, and this one is to "
                    f"hold {', '.join(self.perception.sizes)}; an older version made it, build it anew"
                )
            shutil.copyfile(basis_file(self.basis_from), folder / BASIS)
            return
        rng = np.random.default_rng(0)
        episodes = rng.permutation(n_episodes)[:SAMPLED_EPISODES]
        n_frames = min(SAMPLED_FRAMES, SAMPLED_BYTES // (4 * self.perception.basis.mean.numel()))
        sample = []
        for episode in episodes:
            picked = rng.permutation(see.length(episode))[: -(-n_frames // len(episodes))]
            sample += [self._seen(images) for images in see.pieces(episode, np.sort(picked).tolist())]
        torch.manual_seed(0)
        self.perception.fit(joined(sample))
        save_file(self.perception.components(), folder / BASIS)

    def start(self, folder: Path) -> None:
        """Read the principal components, and note their hash."""
        self.perception.load_basis(folder / BASIS)
        self.manifest["basis_hash"] = hashlib.sha256((folder / BASIS).read_bytes()).hexdigest()[:16]

    def perceive(self, images: dict[str, Tensor]) -> dict[str, np.ndarray]:
        """Numbers of some frames: name -> (T, ...)."""
        kept = self.perception.kept(self._seen(images))
        numbers = {name: value.half() for name, value in kept.items()}
        if self.dtype == "int8":
            numbers["tokens"], numbers["tokens.scale"] = eight_bits(kept["tokens"])
        return {name: value.numpy() for name, value in numbers.items()}

    def _seen(self, images: dict[str, Tensor]) -> Seen:
        n = len(next(iter(images.values())))
        parts = range(0, n, ENCODED_AT_ONCE)
        return joined(
            [self.perception.see({k: v[at : at + ENCODED_AT_ONCE] for k, v in images.items()}) for at in parts]
        )


def eight_bits(tokens: Tensor) -> tuple[Tensor, Tensor]:
    """Tokens (..., C) as int8 and, for each token, the float16 scale (..., 1) that they are multiplied by."""
    scale = (tokens.abs().amax(-1, keepdim=True) / 127).clamp(min=1e-6).half()
    return (tokens / scale.float()).round().clamp(-127, 127).to(torch.int8), scale
