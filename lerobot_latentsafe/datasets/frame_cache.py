"""Frames decoded once: training reads a memory map instead of decoding images at every step.

`build_frame_cache` writes a copy of the dataset without its images, and beside it, in `frame_cache/`, one array a
camera at the world model's resolution, keyed by the dataset's frame index. `lerobot-train --dataset.root=<copy>` finds
it by itself. Windows are cut the same way as LeRobot cuts them, so the losses equal those of decoding.
"""

import hashlib
import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

FOLDER, MANIFEST, VERSION = "frame_cache", "manifest.json", 1


class FrameCacheError(ValueError):
    """A frame cache that is torn, of another dataset or of another resolution."""


def to_model_images(images: Tensor, size: int) -> Tensor:
    """What every path into a world model does to images: area-average to (size, size), round to 8 bits.

    Args:
        images: (..., 3, H, W), uint8 or float in [0, 1].

    Returns:
        float (..., 3, size, size) in [0, 1].
    """
    images = images.float() if images.dtype == torch.uint8 else images * 255.0
    if images.shape[-1] != size or images.shape[-2] != size:
        lead = images.shape[:-3]
        images = F.interpolate(images.reshape(-1, *images.shape[-3:]), size=(size, size), mode="area")
        images = images.reshape(*lead, *images.shape[-3:])
    return (images + 1e-3).round() / 255.0  # the offset keeps x.5 from rounding by float noise


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
    """Memory-mapped frames of a dataset by frame index.

    Attributes:
        images: camera key -> uint8 (N, 3, S, S).
        state: float32 (N, S); action: float32 (N, A) in robot units, taken *after* each frame.
        manifest: what it was made from.
    """

    images: dict[str, np.ndarray]
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
            if manifest["version"] != VERSION:
                raise KeyError("version")
            fingerprint = manifest["fingerprint"]
        except (OSError, json.JSONDecodeError, KeyError, TypeError) as e:
            raise FrameCacheError(
                f"{folder} has no readable {MANIFEST}; the build was cut off. Delete it and run latentsafe cache again"
            ) from e
        if meta is not None and fingerprint != dataset_fingerprint(meta):
            raise FrameCacheError(
                f"{folder} was made from {manifest['repo_id']} ({manifest['fingerprint']}), the dataset is "
                f"{meta.repo_id} ({dataset_fingerprint(meta)}); run latentsafe cache on this dataset"
            )
        try:
            images = {k: np.load(folder / f"{k}.npy", mmap_mode="r") for k in manifest["cameras"]}
            state, action = np.load(folder / "state.npy"), np.load(folder / "action.npy")
        except (OSError, ValueError, EOFError) as e:
            raise FrameCacheError(f"{folder} is torn ({e}); delete it and run latentsafe cache again") from e
        lengths = {len(a) for a in (*images.values(), state, action)}
        if lengths != {manifest["n_frames"]}:
            raise FrameCacheError(f"{folder} holds arrays of {sorted(lengths)} frames, not {manifest['n_frames']}")
        return cls(images, state, action, manifest)

    @property
    def image_size(self) -> int:
        return self.manifest["image_size"]

    def frames(self, index: np.ndarray) -> tuple[dict[str, Tensor], Tensor]:
        """Images in [0, 1] and proprioception at frame indices of any shape (...)."""
        images = {key: torch.from_numpy(value[index]).float() / 255.0 for key, value in self.images.items()}
        return images, torch.from_numpy(self.state[index])


def build_frame_cache(dataset: "LeRobotDataset", output_dir: str | Path, image_size: int) -> FrameCache:
    """Copy a dataset without images and store its frames at `image_size`.

    The manifest is written last and atomically, so a build that was cut off is never taken for a whole one.

    Raises:
        FileExistsError: output_dir exists.
    """
    from lerobot.datasets.dataset_tools import remove_feature
    from lerobot.utils.constants import ACTION, OBS_STATE
    from tqdm import trange

    output_dir = Path(output_dir)
    if output_dir.exists():
        raise FileExistsError(f"{output_dir} exists; choose another --output_dir or delete it")
    cameras = list(dataset.meta.camera_keys)
    if not cameras:
        raise FrameCacheError(f"{dataset.repo_id} has no camera; its features are {list(dataset.meta.features)}")
    copy = remove_feature(dataset, cameras, output_dir=output_dir, repo_id=f"{dataset.repo_id}_cache")
    if (Path(dataset.root) / "labels").exists():
        shutil.copytree(Path(dataset.root) / "labels", output_dir / "labels")
    folder = output_dir / FOLDER
    folder.mkdir()
    n = dataset.num_frames
    shape = (n, 3, image_size, image_size)
    arrays = {
        key: np.lib.format.open_memmap(folder / f"{key}.npy", mode="w+", dtype=np.uint8, shape=shape) for key in cameras
    }
    for i in trange(n, desc="decoding frames", unit="frame"):
        item = dataset[i]
        for key, array in arrays.items():
            array[i] = (to_model_images(item[key], image_size) * 255).round().to(torch.uint8).numpy()
    for array in arrays.values():
        array.flush()
    columns = copy.hf_dataset.with_format("numpy")
    np.save(folder / "state.npy", np.asarray(columns[OBS_STATE], np.float32).reshape(n, -1))
    np.save(folder / "action.npy", np.asarray(columns[ACTION], np.float32).reshape(n, -1))
    manifest = {
        "version": VERSION,
        "repo_id": dataset.repo_id,
        "fingerprint": dataset_fingerprint(dataset.meta),
        "n_frames": n,
        "fps": dataset.fps,
        "image_size": image_size,
        "cameras": {key: list(dataset.meta.features[key]["shape"]) for key in cameras},
    }
    partial = folder / f"{MANIFEST}.partial"
    partial.write_text(json.dumps(manifest, indent=2))
    os.replace(partial, folder / MANIFEST)
    return FrameCache.open(output_dir, copy.meta)
