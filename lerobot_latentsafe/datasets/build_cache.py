"""Making a frame cache: a copy of the dataset without its images, and beside it what a world model perceives.

A build that was killed goes on where it stopped if it is started again, and several processes (`torchrun`) share the
episodes among them. On several computers it is built in shards: see `cache_tasks.py`.
"""

import os
import time
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tqdm import tqdm

from lerobot_latentsafe.datasets.cache_layout import (
    LAYOUT,
    Layout,
    contract_with_cameras,
    lay_out,
    shapes_of,
    write_manifest,
)
from lerobot_latentsafe.datasets.cache_recipes import Pictures, Recipe, Sight
from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.frame_cache import FOLDER, MANIFEST, FrameCache, FrameCacheError
from lerobot_latentsafe.runtime.files import allocate, keep_room, locked_folder, refuse_existing
from lerobot_latentsafe.runtime.malloc import keep_freed_memory
from lerobot_latentsafe.runtime.options import require_at_least

DONE = "done.npy"

MakeRecipe = Callable[[list[str], int | None], Recipe]
"""From cameras and image size, where None is the recipe's default: `Pictures`, or `Tokens` with its encoder."""


def build_frame_cache(
    dataset: LeRobotDataset, output_dir: str | Path, image_size: int | None, recipe: MakeRecipe = Pictures,
    episodes: list[int] | None = None,
) -> FrameCache | None:  # fmt: skip
    """Make a cache, or go on making it.

    Args:
        image_size: None: the recipe's default.
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
        begun = is_begun(folder)
        if _rank() == 0 and not begun:
            refuse_existing(output_dir)
        contract = contract_with_cameras(dataset)
        frames = DatasetFrames(dataset.meta, episodes)
        frames.cameras = list(contract.cameras)
        kept = recipe(frames.cameras, image_size)
        see = Sight(frames, kept.manifest["image_size"])
        keep_freed_memory()
        layout = Layout.of(dataset.meta, frames.episodes, kept, shapes_of(contract))
        if _rank() == 0 and not begun:
            lay_out(dataset, contract, output_dir, layout, partial(_make_room, kept=kept, see=see))
        _await_layout(layout, folder)
        kept.start(folder)
        copy = LeRobotDatasetMetadata(f"{dataset.repo_id}_cache", root=output_dir)
        return _finish(contract, copy, kept) if _fill(copy, kept, see) else None


def is_begun(folder: Path) -> bool:
    """Whether a folder holds a cache that is laid out and not finished."""
    return (folder / LAYOUT).exists() and not (folder / MANIFEST).exists()


def _rank() -> int:
    """Which of several processes this is."""
    return int(os.environ.get("RANK", 0))


def _make_room(folder: Path, n_frames: int, kept: Recipe, see: Sight) -> None:
    """For all frames."""
    for name, (shape, dtype) in kept.arrays.items():
        allocate(folder / f"{name}.npy", dtype, (n_frames, *shape))
    n_episodes = len(see.frames.episodes)
    np.save(folder / DONE, np.zeros(n_episodes, bool))
    kept.prepare(folder, see, n_episodes)


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
        end = perceive_episode(folder, kept, see, episode, row["dataset_from_index"])
        if end != row["dataset_to_index"]:
            raise FrameCacheError(f"{copy.root}: episode {episode} ends at frame {end}, not {row['dataset_to_index']}")
        for name in kept.arrays:
            _array(folder, name).flush()
        done[episode] = True
        done.flush()
    return bool(done.all())


def perceive_episode(folder: Path, kept: Recipe, see: Sight, place: int, at: int) -> int:
    """Write what is perceived of an episode into a folder's arrays.

    Args:
        place: of the episode, among those that are seen.
        at: the row of its first frame.

    Returns:
        The row behind its last.
    """
    for piece in see.pieces(place):
        for name, values in kept.perceive(piece).items():
            _array(folder, name)[at : at + len(values)] = values
        at += len(values)
    return at


def _array(folder: Path, name: str) -> np.memmap:
    """An array to write into; what was written leaves this process's memory with it."""
    return np.load(folder / f"{name}.npy", mmap_mode="r+")


def _await_layout(expected: Layout, folder: Path, patience_s: float = 600) -> None:
    """Wait until the first process has laid the cache out, and check that it is the one that is expected."""
    given_up = time.monotonic() + patience_s
    while (layout := Layout.read(folder)) is None:
        if time.monotonic() > given_up:
            raise FrameCacheError(f"{folder} was not laid out within {patience_s:.0f} s; did the first process stop?")
        time.sleep(0.1)
    layout.require_same(expected, folder)


def _finish(contract: Contract, copy: LeRobotDatasetMetadata, kept: Recipe) -> FrameCache:
    write_manifest(Path(copy.root), copy, shapes_of(contract), {**kept.manifest, "repo_id": contract.repo_id})
    return FrameCache.open(copy.root, copy)
