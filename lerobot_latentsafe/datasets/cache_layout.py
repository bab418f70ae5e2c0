"""Beginning a frame cache, and ending it: the copy of the dataset that it lies in, and the notes of what it is of.

The layout is noted before a frame is decoded, so that whoever goes on with an unfinished cache can tell whether it is
the same one. The manifest is written last and atomically, so what is unfinished is never taken for a whole.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.dataset_tools import delete_episodes, remove_feature
from lerobot.datasets.io_utils import write_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe._compat import drop_episode_statistics
from lerobot_latentsafe.datasets.cache_recipes import Recipe
from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.frame_cache import FOLDER, MANIFEST, VERSION, FrameCacheError, dataset_fingerprint
from lerobot_latentsafe.datasets.label_places import sidecar_path, specifications_of
from lerobot_latentsafe.datasets.labels import Content, Sidecar, all_labels
from lerobot_latentsafe.runtime.files import replacing, replacing_folder, scratch_folder

LAYOUT = "layout.json"
WORDS = {
    "dataset": "dataset", "arrays": "size or encoder", "recipe": "size or encoder", "episodes": "choice of episodes",
    "shards": "number of shards",
}  # fmt: skip
"""Entry of a layout -> what differs if it differs."""


@dataclass(frozen=True)
class Layout:
    """What an unfinished cache is of.

    Attributes:
        dataset: its fingerprint.
        arrays: name -> a frame's shape, and its type.
        recipe: what the recipe notes.
        episodes: those that are kept.
        shards: into how many the cache is cut; None: it is not.
        cameras: key -> (height, width, channels).
    """

    dataset: str
    arrays: dict[str, Any]
    recipe: dict[str, Any]
    episodes: list[int]
    shards: int | None
    cameras: dict[str, Any]

    @classmethod
    def of(
        cls, meta: LeRobotDatasetMetadata, episodes: list[int], kept: Recipe, cameras: dict[str, list[int]],
        shards: int | None = None,
    ) -> "Layout":  # fmt: skip
        """As it is read again from a file."""
        recipe = {key: value for key, value in kept.manifest.items() if key != "basis_hash"}  # noted when it is found
        layout = cls(dataset_fingerprint(meta), kept.arrays, recipe, episodes, shards, cameras)
        return cls(**json.loads(json.dumps(vars(layout))))

    @classmethod
    def read(cls, folder: Path) -> "Layout | None":
        """Of the cache in a folder, which another process may be about to lay out.

        Raises:
            FileExistsError: another version of this package began it.
        """
        if not (folder / LAYOUT).exists():
            return None
        try:
            return cls(**json.loads((folder / LAYOUT).read_text()))
        except (ValueError, TypeError) as e:
            raise FileExistsError(
                f"{folder} holds an unfinished cache of another version of this package; delete it, or choose another "
                "--output_dir"
            ) from e

    def require_same(self, expected: "Layout", folder: Path) -> None:
        """Refuse to go on with a cache of something else.

        Raises:
            FileExistsError: naming what differs.
        """
        differing = {WORDS[name]: name for name in WORDS if getattr(self, name) != getattr(expected, name)}
        if not differing:
            return
        known = f"it is cut for --tasks.number={self.shards}" if self.shards else "it is in one piece"
        cut = f" ({known})" if "shards" in differing.values() else ""
        raise FileExistsError(
            f"{folder} holds an unfinished cache of another {', '.join(differing)}{cut}; give the same to go on with "
            "it, or choose another --output_dir"
        )

    def parts(self) -> list[list[int]]:
        """The episodes of each shard, neighbours in one."""
        return [part.tolist() for part in np.array_split(self.episodes, self.shards or 1)]


def contract_with_cameras(dataset: LeRobotDataset) -> Contract:
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


def shapes_of(contract: Contract) -> dict[str, list[int]]:
    """Camera key -> (height, width, channels)."""
    return {key: [height, width, channels] for key, (channels, height, width) in contract.cameras.items()}


def lay_out(
    dataset: LeRobotDataset, contract: Contract, output_dir: Path, layout: Layout, fill: Callable[[Path, int], None]
) -> None:
    """Copy the dataset without images; output_dir appears when that is done.

    Args:
        fill: what else must be in the cache's folder before a frame is decoded; it is given the folder, and how many
            frames there are.
    """
    with replacing_folder(output_dir) as begun:
        copy = _without_cameras(dataset, layout.episodes, begun, output_dir)
        _copy_labels(dataset, layout.episodes, begun)
        if not copy.meta.stats:  # lerobot-train wants some
            write_stats(Contract.read(copy.meta).statistics, begun)
        folder = begun / FOLDER
        folder.mkdir()
        rows = np.isin(contract.episode, layout.episodes)
        np.save(folder / "state.npy", contract.state[rows])
        np.save(folder / "action.npy", contract.action[rows])
        fill(folder, copy.num_frames)
        _write(folder / LAYOUT, vars(layout))


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
