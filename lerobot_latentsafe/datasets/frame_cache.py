"""Frames decoded once: training reads a memory map instead of decoding images at every step.

A cache lies in `frame_cache/` in a copy of the dataset without its images (see `build_cache.py`): one array for each
thing that a world model perceives, or several, one after the other (see `cache_shards.py`), keyed by the dataset's
frame index. That is each camera's picture at the world
model's resolution, or a frozen encoder's tokens. `lerobot-train --dataset.root=<copy>` finds it by itself. Windows are
cut the same way as LeRobot cuts them, so the losses equal those of decoding.
"""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.datasets.cache_shards import FrameCacheError, ShardedArray, check_digests, open_shards

if TYPE_CHECKING:  # the package imports this module, and LeRobot's datasets are heavy
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

FOLDER, MANIFEST, BASIS = "frame_cache", "manifest.json", "basis.safetensors"
VERSION, SHARDED = 2, 3
"""Of the manifest of a cache in one piece, and of one in shards."""


def dataset_fingerprint(meta: "LeRobotDatasetMetadata") -> str:
    """Identifies a dataset by all but its cameras, so that a copy without images has the same one."""
    features = {k: [v["dtype"], list(v["shape"])] for k, v in meta.features.items() if k not in meta.camera_keys}
    statistics = {
        key: {name: np.asarray(value).round(5).tolist() for name, value in meta.stats[key].items()}
        for key in ("action", "observation.state")
        if meta.stats and key in meta.stats
    }
    identity = [meta.total_frames, meta.total_episodes, meta.fps, features, statistics]
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]


@dataclass
class FrameCache:
    """Memory-mapped percepts of a dataset by frame index.

    Attributes:
        percepts: name -> (N, ...): uint8 pictures, or float16, float32 or int8 numbers; may be tensors of any device.
        scales: name -> float16 (N, ..., 1), what int8 numbers are multiplied by.
        state: float32 (N, S); action: float32 (N, A) in robot units, taken *after* each frame.
        manifest: what it was made from.
    """

    percepts: dict[str, np.ndarray | ShardedArray | Tensor]
    scales: dict[str, np.ndarray | ShardedArray]
    state: np.ndarray
    action: np.ndarray
    manifest: dict

    @classmethod
    def open(cls, root: str | Path, meta: "LeRobotDatasetMetadata | None" = None) -> "FrameCache":
        """Open the cache in a dataset's folder, checking it against the dataset's metadata.

        Raises:
            FrameCacheError: no manifest (a build was cut off), arrays of other sizes, another dataset, or a shard that
                is missing, torn, of another encoder, or twice in the index.
        """
        folder = Path(root) / FOLDER
        try:
            manifest = json.loads((folder / MANIFEST).read_text())
            version, fingerprint = manifest["version"], manifest["fingerprint"]
        except (OSError, json.JSONDecodeError, KeyError, TypeError) as e:
            raise FrameCacheError(
                f"{folder} has no readable {MANIFEST}; the build was cut off. Run the same latentsafe cache "
                "again, which goes on where it stopped, or delete it"
            ) from e
        if version not in (VERSION, SHARDED):
            raise FrameCacheError(
                f"{folder} is of version {version}, this package reads versions {VERSION} and {SHARDED}; delete it and "
                "run latentsafe cache again"
            )
        if meta is not None and fingerprint != dataset_fingerprint(meta):
            raise FrameCacheError(
                f"{folder} was made from {manifest['repo_id']} ({manifest['fingerprint']}), the dataset is "
                f"{meta.repo_id} ({dataset_fingerprint(meta)}); run latentsafe cache on this dataset"
            )
        shards = open_shards(folder, manifest) if version == SHARDED else {}
        read = lambda name: shards[name] if name in shards else np.load(folder / f"{name}.npy", mmap_mode="r")  # noqa: E731
        try:
            percepts = {k: read(k) for k in manifest["percepts"]}
            scales = {k: read(f"{k}.scale") for k, v in percepts.items() if v.dtype == np.int8}
            state, action = (read(k) for k in ("state", "action"))
        except (OSError, ValueError, EOFError) as e:
            raise FrameCacheError(f"{folder} is torn ({e}); delete it and run latentsafe cache again") from e
        lengths = {len(a) for a in (*percepts.values(), *scales.values(), state, action)}
        if lengths != {manifest["n_frames"]}:
            raise FrameCacheError(f"{folder} holds arrays of {sorted(lengths)} frames, not {manifest['n_frames']}")
        return cls(percepts, scales, np.asarray(state), np.asarray(action), manifest)

    @staticmethod
    def check_content(root: str | Path) -> None:
        """Read all shards in a dataset's folder, and compare them with their digests; a cache in one piece has none.

        Raises:
            FrameCacheError: one holds something else than was written.
        """
        folder = Path(root) / FOLDER
        check_digests(folder, json.loads((folder / MANIFEST).read_text()))

    @property
    def image_size(self) -> int:
        """Side of the pictures that were seen, pixels."""
        return self.manifest["image_size"]

    def require_image_size(self, size: int) -> None:
        """Refuse pictures of another size than a world model reads.

        Raises:
            FrameCacheError: naming both, and the command that builds another.
        """
        if self.image_size != size:
            raise FrameCacheError(
                f"this cache holds {self.image_size}-pixel frames, the world model reads {size}; build it with "
                f"latentsafe cache --image_size={size}, or train with --policy.world_model.image_size={self.image_size}"
            )

    def frames(self, index: np.ndarray, names: list[str] | None = None) -> tuple[dict[str, Tensor], Tensor]:
        """Percepts, pictures in [0, 1], and proprioception at frame indices of any shape (...).

        Args:
            names: of the percepts; by default all.
        """
        names = list(self.percepts) if names is None else names
        return {name: self._read(name, index) for name in names}, torch.from_numpy(self.state[index])

    def _read(self, name: str, index: np.ndarray) -> Tensor:
        numbers = torch.as_tensor(self.percepts[name][index])
        if numbers.dtype == torch.uint8:
            return numbers.float() / 255.0
        if name in self.scales:
            return numbers.float() * torch.from_numpy(self.scales[name][index]).float()
        return numbers.float()


def basis_file(root: str | Path) -> Path:
    """Where the principal components of a token cache lie, in the folder of its dataset."""
    return Path(root) / FOLDER / BASIS


def scale_file(folder: Path, name: str) -> Path:
    """Where the scales of an int8 array lie."""
    return folder / f"{name}.scale.npy"
