"""Making a frame cache in shards, one by each task, on one computer or several; see `cache_shards.py`.

A task reads its episodes, and writes its shard into a folder that takes its name when it is whole and on disk. So a
task that was killed leaves nothing, and all others stay. Nothing is written together: any storage that all computers
see will do.
"""

import socket
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from lerobot_latentsafe.datasets.build_cache import MakeRecipe, is_begun, perceive_episode
from lerobot_latentsafe.datasets.cache_layout import (
    LAYOUT,
    Layout,
    contract_with_cameras,
    lay_out,
    shapes_of,
    write_manifest,
)
from lerobot_latentsafe.datasets.cache_recipes import Recipe, Sight
from lerobot_latentsafe.datasets.cache_shards import SHARDS, index_of, shard_names, write_note
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.folder import load_metadata, open_dataset
from lerobot_latentsafe.datasets.frame_cache import FOLDER, SHARDED, FrameCache, FrameCacheError
from lerobot_latentsafe.runtime.files import allocate, locked_folder, refuse_existing, replacing_folder
from lerobot_latentsafe.runtime.malloc import keep_freed_memory
from lerobot_latentsafe.runtime.options import require_at_least
from lerobot_latentsafe.runtime.tasks import Job, Tasks, require_seen


def build_sharded_cache(build: "ShardedBuild", tasks: Tasks, episodes: list[int] | None = None) -> FrameCache | None:
    """Make a cache in as many shards as there are tasks, or go on making it.

    Args:
        episodes: those to keep, which are numbered anew from 0; None: all.

    Returns:
        The cache; None if it was handed to a cluster, whose last task finishes it.

    Raises:
        TasksFailedError: some tasks failed; the shards of the others stay.
        ImportError, OSError, ValueError: the tasks cannot be run so; see `Tasks.require_executor`.
        ValueError, OSError: what `build_frame_cache` raises.
    """
    tasks.require_executor()
    with locked_folder(build.output_dir):
        build.lay_out(tasks.number, episodes)
        logs = build.output_dir.with_name(f"{build.output_dir.name}.tasks")
        return tasks.run(Job("cache", build.make, build.is_made, build.finish, logs))


@dataclass(frozen=True)
class ShardedBuild:
    """A cache that is made in shards: all that a computer needs to know to make one. It is pickled.

    Attributes:
        repo_id, root: of the dataset.
        output_dir: the folder to write, which all computers see.
        image_size: None: the recipe's default.
        recipe: what is kept of a frame.
    """

    repo_id: str
    root: Path
    output_dir: Path
    image_size: int | None
    recipe: MakeRecipe

    @property
    def folder(self) -> Path:
        """Of the cache."""
        return self.output_dir / FOLDER

    def shard(self, number: int) -> Path:
        """The folder of a shard."""
        return self.folder / SHARDS / shard_names(number + 1)[-1]

    def is_made(self, number: int) -> bool:
        """Whether a shard is there, whole."""
        return self.shard(number).exists()

    def lay_out(self, n_shards: int, episodes: list[int] | None = None) -> None:
        """Write all but the shards, unless that was done before.

        Raises:
            FileExistsError: the folder holds something else, or a cache of something else.
        """
        require_at_least("--image_size", self.image_size, 1)
        begun = is_begun(self.folder)
        if not begun:
            refuse_existing(self.output_dir)
        dataset = open_dataset(self.repo_id, self.root)
        contract = contract_with_cameras(dataset)
        frames = DatasetFrames(dataset.meta, episodes)
        frames.cameras = list(contract.cameras)
        Tasks(n_shards).require_work(len(frames.episodes), "episodes")
        kept = self.recipe(frames.cameras, self.image_size)
        layout = Layout.of(dataset.meta, frames.episodes, kept, shapes_of(contract), n_shards)
        if begun:
            Layout.read(self.folder).require_same(layout, self.folder)
        else:
            see = Sight(frames, kept.manifest["image_size"])
            lay_out(dataset, contract, self.output_dir, layout, partial(_prepare, kept=kept, see=see))

    def make(self, number: int) -> None:
        """Make a shard, if it is not there.

        Raises:
            UnseenFolderError: this computer does not see what was laid out.
            FrameCacheError: it sees something else.
            OSError: the disk is full.
        """
        if self.is_made(number):
            return
        layout = self._layout()
        frames = DatasetFrames(load_metadata(self.repo_id, self.root), layout.parts()[number])
        frames.cameras = list(layout.cameras)
        kept = self.recipe(frames.cameras, self.image_size)
        self._require_same(layout, Layout.of(frames.meta, layout.episodes, kept, layout.cameras, layout.shards))
        kept.start(self.folder)
        keep_freed_memory()
        with replacing_folder(self.shard(number)) as begun:
            begun.mkdir(parents=True)
            _fill(begun, kept, Sight(frames, kept.manifest["image_size"]))

    def finish(self) -> FrameCache:
        """Write the index, which makes the shards a cache.

        Raises:
            FrameCacheError: a shard is missing or torn, or they are of several encoders.
        """
        layout = self._layout()
        shards, made_of = index_of(self.folder, shard_names(layout.shards))
        copy = load_metadata(f"{self.repo_id}_cache", self.output_dir)
        noted = {"version": SHARDED, "repo_id": self.repo_id, **made_of, "shards": shards}
        write_manifest(self.output_dir, copy, layout.cameras, noted)
        return FrameCache.open(self.output_dir, copy)

    def _layout(self) -> Layout:
        require_seen(self.folder / LAYOUT, "--output_dir")
        return Layout.read(self.folder)

    def _require_same(self, layout: Layout, seen: Layout) -> None:
        try:
            layout.require_same(seen, self.folder)
        except FileExistsError as e:
            raise FrameCacheError(
                f"{socket.gethostname()} sees another dataset in {self.root}, or has another encoder, than the process "
                f"that laid out {self.folder}: all computers must see the same --dataset.root, and have the same "
                "encoder and version of this package"
            ) from e


def _prepare(folder: Path, n_frames: int, kept: Recipe, see: Sight) -> None:
    (folder / SHARDS).mkdir()
    kept.prepare(folder, see, len(see.frames.episodes))


def _fill(shard: Path, kept: Recipe, see: Sight) -> None:
    """Perceive all episodes that are seen, and note what was written."""
    places = range(len(see.frames.episodes))
    n_frames = sum(map(see.length, places))
    for name, (shape, dtype) in kept.arrays.items():
        allocate(shard / f"{name}.npy", dtype, (n_frames, *shape))
    at = 0
    for place in places:
        at = perceive_episode(shard, kept, see, place, at)
    if at != n_frames:
        raise FrameCacheError(f"the episodes of {shard} have {at} frames, not {n_frames}; download the dataset again")
    write_note(shard, [*kept.arrays], kept.manifest)
