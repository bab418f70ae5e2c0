"""Making a frame cache: a copy of the dataset without its images, and beside it what a world model perceives.

A build that was killed goes on where it stopped if it is started again, and several processes (`torchrun`) share the
episodes among them. The manifest is written last and atomically, so what is unfinished is never taken for a whole.
"""

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.dataset_tools import delete_episodes, remove_feature
from lerobot.datasets.io_utils import write_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors.torch import save_file
from torch import Tensor
from tqdm import tqdm

from lerobot_latentsafe._compat import drop_episode_statistics
from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.frame_cache import (
    BASIS,
    FOLDER,
    MANIFEST,
    VERSION,
    FrameCache,
    FrameCacheError,
    basis_file,
    dataset_fingerprint,
)
from lerobot_latentsafe.datasets.label_places import sidecar_path, specifications_of
from lerobot_latentsafe.datasets.labels import Content, Sidecar, all_labels
from lerobot_latentsafe.encoders.patch_encoders import Seen, joined
from lerobot_latentsafe.encoders.perception import Perception, PerceptionConfig
from lerobot_latentsafe.pictures import to_model_images
from lerobot_latentsafe.runtime.files import (
    allocate,
    keep_room,
    locked_folder,
    refuse_existing,
    replacing,
    replacing_folder,
    scratch_folder,
)
from lerobot_latentsafe.runtime.malloc import keep_freed_memory
from lerobot_latentsafe.runtime.options import require_at_least

LAYOUT, DONE = "layout.json", "done.npy"
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
    """

    def __init__(
        self, cameras: list[str], image_size: int | None, config: PerceptionConfig, dtype: str = "float16",
        basis_from: str | Path | None = None,
    ):  # fmt: skip
        if dtype not in TOKEN_TYPES:
            raise ValueError(f"--dtype is {dtype!r}; expected {' or '.join(TOKEN_TYPES)}")
        self.perception, self.dtype, self.basis_from = Perception(config, cameras, image_size), dtype, basis_from
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


def build_frame_cache(
    dataset: LeRobotDataset, output_dir: str | Path, image_size: int | None,
    recipe: Callable[[list[str], int | None], Recipe] = Pictures, episodes: list[int] | None = None,
) -> FrameCache | None:  # fmt: skip
    """Make a cache, or go on making it.

    Args:
        image_size: None: the recipe's default.
        recipe: from cameras and image size: `Pictures`, or `Tokens` with its encoder.
        episodes: those to keep, which are numbered anew from 0; None: all.

    Returns:
        The cache; None in a process that was not the last to finish.

    Raises:
        FileExistsError: output_dir holds something else, a finished cache, or an unfinished one of something else.
        FolderInUseError: another build writes it.
        OSError: the disk has no room for all of it.
        ValueError: there are no pictures of such a size.
        DatasetContractError: a dataset that cannot be used as it is.
        LabelFileError: its labels are none.
        FrameCacheError: it has no camera.
    """
    require_at_least("--image_size", image_size, 1)
    output_dir = Path(output_dir)
    with locked_folder(output_dir) if _rank() == 0 else nullcontext():
        folder = output_dir / FOLDER
        unfinished = (folder / LAYOUT).exists() and not (folder / MANIFEST).exists()
        if _rank() == 0 and not unfinished:
            refuse_existing(output_dir)
        contract = _contract_with_cameras(dataset)
        frames = DatasetFrames(dataset.meta, episodes)
        frames.cameras = list(contract.cameras)
        kept = recipe(frames.cameras, image_size)
        see = Sight(frames, kept.manifest["image_size"])
        keep_freed_memory()
        if _rank() == 0 and not unfinished:
            _lay_out(dataset, contract, frames.episodes, output_dir, kept, see)
        _await_layout(_layout(dataset, frames.episodes, kept), folder)
        kept.start(folder)
        copy = LeRobotDatasetMetadata(f"{dataset.repo_id}_cache", root=output_dir)
        return _finish(contract, copy, kept) if _fill(copy, kept, see) else None


def _rank() -> int:
    """Which of several processes this is."""
    return int(os.environ.get("RANK", 0))


def _contract_with_cameras(dataset: LeRobotDataset) -> Contract:
    """What a dataset says, if it has pictures, and labels that training would not refuse."""
    contract = Contract.read(dataset.meta)
    if not contract.cameras:
        known = "".join(f"{key} is left out: {why}; " for key, why in contract.left_out.items())
        raise FrameCacheError(
            f"{dataset.repo_id} has no camera to cache: {known}its features are {', '.join(dataset.meta.features)}. "
            "Record one with a camera"
        )
    all_labels(dataset.root, dataset.meta.features, dataset.repo_id)
    return contract


def _fill(copy: LeRobotDatasetMetadata, kept: Recipe, see: Sight) -> bool:
    """Perceive this process's share of the episodes; whether all processes have done theirs."""
    rank, world = _rank(), int(os.environ.get("WORLD_SIZE", 1))
    folder = Path(copy.root) / FOLDER
    for name in kept.arrays:
        keep_room(folder / f"{name}.npy")  # an array that was copied may have holes
    done = np.load(folder / DONE, mmap_mode="r+")
    mine = [e for e in range(rank, copy.total_episodes, world) if not done[e]]
    for episode in tqdm(mine, desc="decoding episodes", unit="episode", disable=rank > 0):
        row = copy.episodes[episode]
        at = row["dataset_from_index"]
        for piece in see.pieces(episode):
            for name, values in kept.perceive(piece).items():
                _array(folder, name)[at : at + len(values)] = values
            at += len(values)
        if at != row["dataset_to_index"]:
            raise FrameCacheError(f"{copy.root}: episode {episode} ends at frame {at}, not {row['dataset_to_index']}")
        for name in kept.arrays:
            _array(folder, name).flush()
        done[episode] = True
        done.flush()
    return bool(done.all())


def _array(folder: Path, name: str) -> np.memmap:
    """An array to write into; what was written leaves this process's memory with it."""
    return np.load(folder / f"{name}.npy", mmap_mode="r+")


def _layout(dataset: LeRobotDataset, episodes: list[int], kept: Recipe) -> list:
    """Tells whether an unfinished cache is of the same thing."""
    some = [episodes] if len(episodes) < dataset.num_episodes else []
    return json.loads(json.dumps([dataset_fingerprint(dataset.meta), kept.arrays, kept.manifest, *some]))


def _lay_out(
    dataset: LeRobotDataset, contract: Contract, episodes: list[int], output_dir: Path, kept: Recipe, see: Sight
) -> None:
    """Copy the dataset without images and make room for all frames; output_dir appears when that is done."""
    with replacing_folder(output_dir) as begun:
        copy = _without_cameras(dataset, episodes, begun, output_dir)
        _copy_labels(dataset, episodes, begun)
        if not copy.meta.stats:  # lerobot-train wants some
            write_stats(Contract.read(copy.meta).statistics, begun)
        folder, n = begun / FOLDER, copy.num_frames
        folder.mkdir()
        rows = np.isin(contract.episode, episodes)
        np.save(folder / "state.npy", contract.state[rows])
        np.save(folder / "action.npy", contract.action[rows])
        for name, (shape, dtype) in kept.arrays.items():
            allocate(folder / f"{name}.npy", dtype, (n, *shape))
        np.save(folder / DONE, np.zeros(copy.num_episodes, bool))
        kept.prepare(folder, see, copy.num_episodes)
        _write(folder / LAYOUT, _layout(dataset, episodes, kept))


def _without_cameras(dataset: LeRobotDataset, episodes: list[int], folder: Path, output_dir: Path) -> LeRobotDataset:
    """A copy of these episodes without pictures, for output_dir."""
    cameras, repo_id = list(dataset.meta.camera_keys), f"{dataset.repo_id}_cache"
    others = sorted({*range(dataset.num_episodes)} - {*episodes})
    if not others:
        return remove_feature(dataset, cameras, output_dir=folder, repo_id=repo_id)
    with scratch_folder(output_dir) as scratch:
        bare = remove_feature(dataset, cameras, output_dir=scratch / "bare", repo_id=repo_id)
        drop_episode_statistics(bare.root, cameras)
        return delete_episodes(bare, others, output_dir=folder, repo_id=repo_id)


def _copy_labels(dataset: LeRobotDataset, episodes: list[int], folder: Path) -> None:
    """The labels of these episodes for the copy of a dataset, wherever their files lie."""
    content, kept = Content(dataset.root), Content(folder)
    rows = np.isin(content.frames["episode_index"], episodes)
    for name in specifications_of(dataset.root, dataset.repo_id):
        whole = Sidecar.find(dataset.root, name, content, dataset.repo_id)
        if whole is not None:
            path = sidecar_path(folder, name)
            path.parent.mkdir(exist_ok=True)
            part = Sidecar(whole.failure[rows], whole.by[rows], whole.at[rows], whole.names)
            part.write(path, dataset.repo_id, kept)


def _await_layout(expected: list, folder: Path, patience_s: float = 600) -> None:
    """Wait until the first process has laid the cache out, and check that it is the one that is expected."""
    given_up = time.monotonic() + patience_s
    while not (folder / LAYOUT).exists():
        if time.monotonic() > given_up:
            raise FrameCacheError(f"{folder} was not laid out within {patience_s:.0f} s; did the first process stop?")
        time.sleep(0.1)
    if json.loads((folder / LAYOUT).read_text()) != expected:
        raise FileExistsError(
            f"{folder} holds an unfinished cache of another dataset, size or encoder; give the same to go on with it, "
            "or choose another --output_dir"
        )


def _finish(contract: Contract, copy: LeRobotDatasetMetadata, kept: Recipe) -> FrameCache:
    cameras = {key: [height, width, channels] for key, (channels, height, width) in contract.cameras.items()}
    write_manifest(Path(copy.root), copy, cameras, {**kept.manifest, "repo_id": contract.repo_id})
    return FrameCache.open(copy.root, copy)


def write_manifest(root: Path, meta: LeRobotDatasetMetadata, cameras: dict[str, list[int]], percepts: dict) -> None:
    """Note what the arrays in a dataset's frame cache are of, which makes them a cache.

    Args:
        cameras: key -> (height, width, channels) of what was seen.
        percepts: what the recipe notes: image_size, percepts, and more.
    """
    manifest = {
        "version": VERSION,
        "repo_id": meta.repo_id,
        "fingerprint": dataset_fingerprint(meta),
        "n_frames": meta.total_frames,
        "fps": meta.fps,
        "cameras": cameras,
        **percepts,
    }
    _write(root / FOLDER / MANIFEST, manifest)


def _write(file: Path, content: object) -> None:
    """Atomically, whichever of several processes does it."""
    with replacing(file) as partial:
        partial.write_text(json.dumps(content, indent=2))
