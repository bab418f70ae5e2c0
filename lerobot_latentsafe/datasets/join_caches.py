"""Several cached datasets as one, without copying what was perceived: that takes the same disk, under a second name."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_latentsafe.datasets.cache_layout import write_manifest
from lerobot_latentsafe.datasets.cache_shards import SHARD, SHARDS, index_of, shard_names, write_note
from lerobot_latentsafe.datasets.folder import load_metadata
from lerobot_latentsafe.datasets.frame_cache import BASIS, FOLDER, SHARDED, FrameCache, FrameCacheError
from lerobot_latentsafe.datasets.frame_labels import as_labels
from lerobot_latentsafe.datasets.label_places import sidecar_path, specifications_of
from lerobot_latentsafe.datasets.labels import Content, Sidecar
from lerobot_latentsafe.runtime.files import replacing_folder

OF_A_DATASET = ("version", "repo_id", "fingerprint", "n_frames", "shards")
"""Entries of a manifest that differ between caches of one kind."""


def join_caches(sources: Sequence[Path], repo_id: str, output_dir: Path) -> FrameCache:
    """Write a dataset of the episodes of several, with their labels, whose cache consists of their shards.

    Numbers and labels are copied. Files of tokens or pictures are linked: they take no room, and stay when a source is
    removed. Where the disk is another one, they are symbolic links, which need their source.

    Args:
        sources: folders of cached datasets. A cache in one piece becomes one shard.

    Raises:
        ValueError: a source is named twice, or there are none.
        FrameCacheError: caches of several encoders, sizes or cameras; or one is torn.
        DatasetContractError: there is no such dataset.
        FileExistsError: output_dir holds something.
    """
    roots = [Path(source).resolve() for source in sources]
    if not roots or len({*roots}) < len(roots):
        raise ValueError(f"--sources is {[str(s) for s in sources]}; expected folders of cached datasets, each once")
    metas = [load_metadata(f"local/{root.name}", root) for root in roots]
    caches = [FrameCache.open(root, meta) for root, meta in zip(roots, metas)]
    for root, cache in zip(roots[1:], caches[1:]):
        _require_alike(roots[0], caches[0].manifest, root, cache.manifest)
    return join_all(metas, caches, repo_id, output_dir)


def join_all(
    metas: Sequence[LeRobotDatasetMetadata], caches: Sequence[FrameCache], repo_id: str, output_dir: Path
) -> FrameCache:
    """The same of caches that are alike; one may come several times."""
    roots = [Path(meta.root) for meta in metas]
    with replacing_folder(output_dir) as begun:
        aggregate_datasets([meta.repo_id for meta in metas], repo_id, roots=roots, aggr_root=begun)
        folder = begun / FOLDER
        (folder / SHARDS).mkdir(parents=True)
        for name in ("state", "action"):
            _write_rows(folder / f"{name}.npy", [getattr(cache, name) for cache in caches])
        if (roots[0] / FOLDER / BASIS).exists():
            shutil.copyfile(roots[0] / FOLDER / BASIS, folder / BASIS)
        n_shards = 0
        for root, cache in zip(roots, caches):
            n_shards += _link_shards(root / FOLDER, cache.manifest, folder / SHARDS, n_shards)
        _join_labels(roots, begun, repo_id)
        shards, made_of = index_of(folder, shard_names(n_shards))
        joined = load_metadata(repo_id, begun)
        noted = {"version": SHARDED, **made_of, "shards": shards}
        write_manifest(begun, joined, caches[0].manifest["cameras"], noted)
        FrameCache.open(begun, joined)
    return FrameCache.open(output_dir)


def _require_alike(first: Path, known: dict[str, Any], root: Path, manifest: dict[str, Any]) -> None:
    for key in sorted({*known, *manifest} - {*OF_A_DATASET}):
        if known.get(key) != manifest.get(key):
            raise FrameCacheError(
                f"the cache in {root} has {key} = {manifest.get(key)}, the one in {first} has {known.get(key)}; one "
                f"world model reads all its data alike. Build it with the same options and --basis_from={first}"
            )


def _write_rows(file: Path, parts: Sequence[np.ndarray]) -> None:
    """Arrays (n, D), one after the other, in one file (N, D)."""
    shape = (sum(map(len, parts)), *parts[0].shape[1:])
    whole, at = np.lib.format.open_memmap(file, mode="w+", dtype=parts[0].dtype, shape=shape), 0
    for part in parts:
        whole[at : at + len(part)] = part
        at += len(part)
    whole.flush()


def _link_shards(cache: Path, manifest: dict[str, Any], shards: Path, begin: int) -> int:
    """Have a cache's shards under other numbers, from `begin` on; how many there are."""
    if "shards" in manifest:
        found = [cache / SHARDS / shard["name"] for shard in manifest["shards"]]
        for place, source in enumerate(found, begin):
            _link(shards / shard_names(place + 1)[-1], [*source.glob("*.npy"), source / SHARD])
        return len(found)
    files = [file for file in cache.glob("*.npy") if file.name.removesuffix(".npy").removesuffix(".scale") in
             manifest["percepts"]]  # fmt: skip
    shard = shards / shard_names(begin + 1)[-1]
    _link(shard, files)
    made_of = {key: value for key, value in manifest.items() if key not in (*OF_A_DATASET, "fps", "cameras")}
    write_note(shard, sorted(file.stem for file in files), made_of)
    return 1


def _link(shard: Path, files: Sequence[Path]) -> None:
    shard.mkdir()
    for file in files:
        try:
            os.link(file.resolve(), shard / file.name)
        except OSError:  # another disk
            (shard / file.name).symlink_to(file.resolve())


def _join_labels(roots: Sequence[Path], folder: Path, repo_id: str) -> None:
    specifications = [*dict.fromkeys(name for root in roots for name in specifications_of(root))]
    if not specifications:
        return
    contents, joined = [Content(root, specifications) for root in roots], Content(folder)
    for name in specifications:
        parts = [_labels_of(root, name, content) for root, content in zip(roots, contents)]
        names = [*dict.fromkeys(who for part in parts for who in part.names)]
        by = [np.array([*map(names.index, part.names), -1], np.int32)[part.by] for part in parts]
        failure, at = (np.concatenate([getattr(part, of) for part in parts]) for of in ("failure", "at"))
        path = sidecar_path(folder, name)
        path.parent.mkdir(exist_ok=True)
        Sidecar(failure, np.concatenate(by), at, names).write(path, repo_id, joined)


def _labels_of(root: Path, name: str, content: Content) -> Sidecar:
    """Of a label file, or else of a column; else none."""
    found = Sidecar.find(root, name, content)
    if found is None:
        found = Sidecar.empty(len(content))
        if name in content.frames:
            found.failure = as_labels(content.frames[name], len(content), f"column {name!r} of {root}")
    return found
