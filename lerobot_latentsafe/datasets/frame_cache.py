"""Frames decoded once: training reads a memory map instead of decoding images at every step.

A cache lies in `frame_cache/` in a copy of the dataset without its images (see `build_cache.py`): one array for each
thing that a world model perceives, keyed by the dataset's frame index. That is each camera's picture at the world
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

if TYPE_CHECKING:  # the package imports this module, and LeRobot's datasets are heavy
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

FOLDER, MANIFEST, BASIS, VERSION = "frame_cache", "manifest.json", "basis.safetensors", 2


class FrameCacheError(ValueError):
    """A frame cache that is torn, of another dataset, resolution or encoder."""


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

    percepts: dict[str, np.ndarray | Tensor]
    scales: dict[str, np.ndarray]
    state: np.ndarray
    action: np.ndarray
    manifest: dict

    @classmethod
    def open(cls, root: str | Path, meta: "LeRobotDatasetMetadata | None" = None) -> "FrameCache":
        """Open the cache in a dataset's folder, checking it against the dataset's metadata.

        Raises:
            FrameCacheError: no manifest (a build was cut off), arrays of other sizes, or another dataset.
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
        if version != VERSION:
            raise FrameCacheError(
                f"{folder} is of version {version}, this package reads version {VERSION}; delete it and run latentsafe "
                "cache again"
            )
        if meta is not None and fingerprint != dataset_fingerprint(meta):
            raise FrameCacheError(
                f"{folder} was made from {manifest['repo_id']} ({manifest['fingerprint']}), the dataset is "
                f"{meta.repo_id} ({dataset_fingerprint(meta)}); run latentsafe cache on this dataset"
            )
        try:
            percepts = {k: np.load(folder / f"{k}.npy", mmap_mode="r") for k in manifest["percepts"]}
            eight_bits = [k for k, v in percepts.items() if v.dtype == np.int8]
            scales = {k: np.load(scale_file(folder, k), mmap_mode="r") for k in eight_bits}
            state, action = (np.load(folder / f"{k}.npy", mmap_mode="r") for k in ("state", "action"))
        except (OSError, ValueError, EOFError) as e:
            raise FrameCacheError(f"{folder} is torn ({e}); delete it and run latentsafe cache again") from e
        lengths = {len(a) for a in (*percepts.values(), *scales.values(), state, action)}
        if lengths != {manifest["n_frames"]}:
            raise FrameCacheError(f"{folder} holds arrays of {sorted(lengths)} frames, not {manifest['n_frames']}")
        return cls(percepts, scales, state, action, manifest)

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
