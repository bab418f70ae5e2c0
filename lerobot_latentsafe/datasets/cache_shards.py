"""A frame cache in shards: folders of arrays, each of some whole episodes, written whole by one task.

    frame_cache/manifest.json             what all shards are of, and name, frames and digests of each, in order
    frame_cache/state.npy, action.npy     of all frames
    frame_cache/shards/00000/tokens.npy   what is perceived of the frames of a shard
    frame_cache/shards/00000/shard.json   what the shard is of, and its digests

A cache without shards has these arrays in `frame_cache/` itself. Either is uploaded to the Hub as it is, and read by
memory map.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

SHARDS, SHARD = "shards", "shard.json"
OPEN = 128
"""Files of an array that are open at once: a system lets a process open some thousand."""
AGAIN = "remove it and {manifest}, and run the same latentsafe cache again, which makes it anew; or download it again"


class FrameCacheError(ValueError):
    """A frame cache that is torn, of another dataset, resolution or encoder."""


class ShardedArray:
    """Rows of several .npy files, one after the other, read as if they were one memory map.

    Args:
        files: of rows of one shape and type.
        frames: rows of each.

    Attributes:
        shape, dtype: of the whole.
    """

    def __init__(self, files: Sequence[Path], frames: Sequence[int]):
        self.files, self.ends = list(files), np.cumsum(frames)
        self._maps: dict[int, np.ndarray] = {}
        first = self._open(0)
        self.shape, self.dtype = (int(self.ends[-1]), *first.shape[1:]), first.dtype

    def __len__(self) -> int:
        return self.shape[0]

    @property
    def nbytes(self) -> int:
        """Bytes of all rows."""
        return int(np.prod(self.shape)) * self.dtype.itemsize

    def __getitem__(self, index: Any) -> np.ndarray:
        """Rows at an index of the first axis: a number, a slice, or numbers of any shape (...)."""
        index = np.asarray(range(len(self))[index] if isinstance(index, slice | int) else index, dtype=np.int64)
        if index.size and (index.min() < 0 or index.max() >= len(self)):
            raise IndexError(f"rows {index.min()} to {index.max()} of {len(self)}")
        shard = np.searchsorted(self.ends, index, side="right")
        rows = np.empty((*index.shape, *self.shape[1:]), self.dtype)
        for number in np.unique(shard):
            here = shard == number
            begin = self.ends[number - 1] if number else 0
            rows[here] = self._open(int(number))[index[here] - begin]
        return rows

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self[:] if dtype is None else self[:].astype(dtype)

    def _open(self, number: int) -> np.ndarray:
        if number not in self._maps:
            while len(self._maps) >= OPEN:
                del self._maps[next(iter(self._maps))]
            self._maps[number] = np.load(self.files[number], mmap_mode="r")
        return self._maps[number]


def shard_names(n_shards: int) -> list[str]:
    """Folders of shards, in order."""
    return [f"{number:05d}" for number in range(n_shards)]


def write_note(shard: Path, arrays: Sequence[str], made_of: dict[str, Any]) -> None:
    """Note of what the arrays in a shard's folder are, and their digests.

    Args:
        made_of: what the recipe notes.
    """
    frames = len(np.load(shard / f"{arrays[0]}.npy", mmap_mode="r"))
    note = {"frames": frames, "made_of": made_of, "sha256": {name: digest(shard / f"{name}.npy") for name in arrays}}
    (shard / SHARD).write_text(json.dumps(note, indent=2))


def digest(file: Path) -> str:
    """SHA-256 of a file's content."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_note(shard: Path) -> dict[str, Any]:
    """What a shard's folder says of it: frames, made_of and sha256.

    Raises:
        FrameCacheError: it is missing or torn.
    """
    try:
        note = json.loads((shard / SHARD).read_text())
        return {"frames": int(note["frames"]), "made_of": dict(note["made_of"]), "sha256": dict(note["sha256"])}
    except FileNotFoundError as e:
        raise FrameCacheError(
            f"the shard {shard} is missing. If all tasks have ended, another computer wrote it to a folder of its own: "
            "all must see the same --output_dir. Else run the same latentsafe cache again, or download it again"
        ) from e
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise FrameCacheError(f"the shard {shard} is torn ({SHARD}: {e}); {_again(shard)}") from e


def index_of(folder: Path, names: Sequence[str]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The index of shards for a manifest, and what they are all made of.

    Args:
        folder: of the cache.

    Raises:
        FrameCacheError: a shard is missing or torn, or they are of several encoders.
    """
    notes = {name: read_note(folder / SHARDS / name) for name in names}
    made_of = notes[names[0]]["made_of"]
    for name, note in notes.items():
        _require_made_of(folder / SHARDS / name, note["made_of"], made_of)
    return [{"name": name, "frames": n["frames"], "sha256": n["sha256"]} for name, n in notes.items()], made_of


def open_shards(folder: Path, manifest: dict[str, Any]) -> dict[str, ShardedArray]:
    """Arrays of a cache by name, each checked as far as that takes no reading of numbers.

    Args:
        folder: of the cache.
        manifest: with the index of its shards.

    Raises:
        FrameCacheError: a shard is missing, torn, of another encoder, or twice in the index.
    """
    shards = _index(folder, manifest)
    arrays: dict[str, dict[Path, int]] = {}
    for shard in shards:
        path = folder / SHARDS / shard["name"]
        note = read_note(path)
        _require_made_of(path, note["made_of"], {key: manifest.get(key) for key in note["made_of"]})
        if (note["frames"], note["sha256"]) != (shard["frames"], shard["sha256"]):
            raise FrameCacheError(f"the shard {path} is not the one that the index means; {_again(path)}")
        for name in shard["sha256"]:
            file = path / f"{name}.npy"
            _require_rows(file, shard["frames"])
            arrays.setdefault(name, {})[file] = shard["frames"]
    if short := [name for name, files in arrays.items() if len(files) < len(shards)]:
        raise FrameCacheError(f"{folder} is torn: not every shard has {', '.join(short)}; download it again")
    return {name: ShardedArray([*files], [*files.values()]) for name, files in arrays.items()}


def check_digests(folder: Path, manifest: dict[str, Any]) -> None:
    """Read all shards of a cache and compare them with the index.

    Raises:
        FrameCacheError: naming the first array that holds something else than was written.
    """
    for shard in manifest.get("shards", []):
        for name, expected in shard["sha256"].items():
            file = folder / SHARDS / shard["name"] / f"{name}.npy"
            if digest(file) != expected:
                raise FrameCacheError(f"{file} is not what was written (its SHA-256 differs); {_again(file.parent)}")


def _index(folder: Path, manifest: dict[str, Any]) -> list[dict[str, Any]]:
    """A manifest's list of shards, if it is one."""
    try:
        shards = [{key: shard[key] for key in ("name", "frames", "sha256")} for shard in manifest["shards"]]
        names = Counter(str(shard["name"]) for shard in shards)
    except (KeyError, TypeError) as e:
        raise FrameCacheError(f"{folder} is torn: its index of shards lacks {e}; download it again") from e
    if not shards:
        raise FrameCacheError(f"{folder} is torn: its index names no shard; download it again")
    if twice := [name for name, n in names.items() if n > 1]:
        raise FrameCacheError(f"the index of {folder} names the shard {', '.join(twice)} twice; download it again")
    if outside := [name for name in names if not name.isalnum()]:
        raise FrameCacheError(f"the index of {folder} names {', '.join(outside)}, which is no shard of that folder")
    return shards


def _require_made_of(shard: Path, found: dict[str, Any], expected: dict[str, Any]) -> None:
    for key in sorted({*found, *expected}):
        if found.get(key) != expected.get(key):
            raise FrameCacheError(
                f"the shard {shard} was made with {key} = {found.get(key)}, the others with {expected.get(key)}; all "
                f"shards of a cache have one encoder, with the same weights and principal components. {_again(shard)}"
            )


def _require_rows(file: Path, frames: int) -> None:
    try:
        found = len(np.load(file, mmap_mode="r"))
    except (OSError, ValueError, EOFError) as e:
        raise FrameCacheError(f"the shard {file.parent} is torn ({file.name}: {e}); {_again(file.parent)}") from e
    if found != frames:
        raise FrameCacheError(
            f"the shard {file.parent} is torn: {file.name} holds {found} frames, not {frames}; {_again(file.parent)}"
        )


def _again(shard: Path) -> str:
    return AGAIN.format(manifest=shard.parents[1] / "manifest.json")
