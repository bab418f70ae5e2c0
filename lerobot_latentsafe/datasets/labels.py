"""Failure labels: one verdict a frame, kept outside `observation.*` so that no policy can read the answer."""

import hashlib
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_latentsafe.datasets.reading import DOWNLOAD_AGAIN, BrokenFileError, reading
from lerobot_latentsafe.runtime.files import replacing

FAILING, SAFE, UNLABELLED = 1, 0, -1
FOLDER, SCHEMA, METADATA = "labels", 1, b"latentsafe_labels"
NAME = re.compile(r"(?!action|observation|index|episode|frame|task|timestamp|next)[a-z][a-z0-9_]{0,39}")
"""Names of specifications: a file and a column, and none that LeRobot would hand to a policy."""


class UnlabelledDatasetError(ValueError):
    """The dataset has no usable failure labels."""


class LabelFileError(UnlabelledDatasetError):
    """A label file of another dataset, of another schema, or with values that are no labels."""


def sidecar_path(root: str | Path, specification: str) -> Path:
    """`labels/<specification>.parquet` of a dataset.

    Raises:
        LabelFileError: the name is not fit for a file and a column.
    """
    if not NAME.fullmatch(specification):
        raise LabelFileError(
            f"specification name {specification!r} is not usable: expected lower-case letters, digits and _ (at most "
            "40, a letter first), such as failure or spilled, and no name that LeRobot gives columns of its own"
        )
    return Path(root) / FOLDER / f"{specification}.parquet"


def specifications_of(root: str | Path) -> list[str]:
    """Names of the specifications that have a label file."""
    return sorted(p.stem for p in (Path(root) / FOLDER).glob("*.parquet") if NAME.fullmatch(p.stem))


def read_frames(root: str | Path, columns: Iterable[str] = ()) -> dict[str, np.ndarray]:
    """`index`, `episode_index` and those of `columns` that exist, of every frame in the order of the index.

    Raises:
        BrokenFileError: no dataset at root, or a file of it that cannot be read.
    """
    files = sorted(Path(root).glob("data/*/*.parquet"))
    if not files:
        raise BrokenFileError(
            f"{root} holds no data/*/*.parquet, where the frames of a LeRobotDataset (v3) lie; {DOWNLOAD_AGAIN}"
        )
    with reading(files[0]):
        present = set(pq.ParquetFile(files[0]).schema_arrow.names)
    wanted = ["index", "episode_index", *sorted(set(columns) & present)]
    frames = [_read_columns(file, wanted) for file in files]
    read = {name: _joined([part[name] for part in frames]) for name in wanted}
    order = np.argsort(read["index"], kind="stable")
    return {name: values[order] for name, values in read.items()}


def _read_columns(file: Path, names: list[str]) -> dict[str, np.ndarray]:
    with reading(file):
        table = pq.ParquetFile(file).read(columns=names)
        return {name: _to_numpy(table[name]) for name in names}


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    """Of all files; arrays of objects where they are not of one shape."""
    if len({part.shape[1:] for part in parts}) > 1:
        parts = [np.fromiter(part, object, len(part)) for part in parts]
    return np.concatenate(parts)


def _to_numpy(column: pa.Array | pa.ChunkedArray) -> np.ndarray:
    """(N,) or (N, D): lists of one length become rows, anything ragged or with holes an array of objects."""
    if isinstance(column, pa.ChunkedArray):
        column = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], column.type)
    values, n = _plain(column), len(column)
    while _is_list(values.type):
        lengths = set(values.value_lengths().to_pylist()) if not pa.types.is_fixed_size_list(values.type) else {0}
        if len(lengths) > 1 or values.null_count:
            return column.to_numpy(zero_copy_only=False)
        values = _plain(values.flatten())
    numbers = values.to_numpy(zero_copy_only=False)
    return numbers.reshape(n, -1) if _is_list(_plain(column).type) and n else numbers


def _plain(column: pa.Array) -> pa.Array:
    """Without what LeRobot's and Arrow's types wrap around the values."""
    if isinstance(column.type, pa.ExtensionType):
        column = column.storage
    return column.dictionary_decode() if pa.types.is_dictionary(column.type) else column


def _is_list(kind: pa.DataType) -> bool:
    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)


def identity(frames: dict[str, np.ndarray], n: int) -> str:
    """Tells datasets apart by the episodes and actions of their first n frames.

    Copies without cameras, with more columns or with episodes recorded since keep the identity of those n frames.
    """
    digest = hashlib.sha256(np.ascontiguousarray(frames["episode_index"][:n], dtype="<i8").tobytes())
    if "action" in frames:
        digest.update(np.ascontiguousarray(frames["action"][:n], dtype="<f4").tobytes())
    return digest.hexdigest()[:16]


@dataclass
class Sidecar:
    """The label file of one specification: labels by frame index, and who gave each, and when.

    Attributes:
        failure: int8 (N,).
        by: int32 (N,), a place in `names`, or -1.
        at: int64 (N,), microseconds since 1970 UTC; 0 where unlabelled or unknown.
        names: who labelled.
    """

    failure: np.ndarray
    by: np.ndarray
    at: np.ndarray
    names: list[str]

    @classmethod
    def empty(cls, n: int) -> "Sidecar":
        """Labels of n frames that nobody has labelled."""
        return cls(np.full(n, UNLABELLED, np.int8), np.full(n, -1, np.int32), np.zeros(n, np.int64), [])

    @classmethod
    def read(cls, path: Path, frames: dict[str, np.ndarray]) -> "Sidecar":
        """Read a file written by `write`, or a plain table with the columns `index` and `failure`.

        A file written before more episodes were recorded leaves those unlabelled.

        Raises:
            LabelFileError: of another dataset, of another schema, not readable, or values that are no labels.
        """
        try:
            table = pq.read_table(path)
        except (pa.ArrowInvalid, OSError) as e:
            raise LabelFileError(f"{path} is not a readable parquet file ({e}); restore it or move it away") from e
        missing = {"index", "failure"} - set(table.column_names)
        if missing:
            raise LabelFileError(f"{path} lacks the columns {sorted(missing)}; expected index and failure")
        n, index = len(frames["index"]), _to_numpy(table["index"].combine_chunks())
        covered = n
        if METADATA in (table.schema.metadata or {}):
            covered = cls._check_metadata(path, json.loads(table.schema.metadata[METADATA]), frames)
        if len(index) != covered or not np.array_equal(np.sort(index), np.arange(covered)):
            raise LabelFileError(
                f"{path} labels {len(index)} frames, the dataset has {n}; expected each index 0..{covered - 1} once. "
                "It may belong to another dataset"
            )
        sidecar = cls.empty(n)
        failure = _to_numpy(table["failure"].combine_chunks())
        sidecar.failure[index] = as_labels(failure, covered, str(path))
        if "labelled_by" in table.column_names:
            column = table["labelled_by"].combine_chunks()
            column = column if pa.types.is_dictionary(column.type) else column.dictionary_encode()
            sidecar.by[index], sidecar.names = column.indices.fill_null(-1).to_numpy(), column.dictionary.to_pylist()
        if "labelled_at" in table.column_names:
            sidecar.at[index] = table["labelled_at"].cast(pa.int64()).fill_null(0).to_numpy()
        return sidecar

    @staticmethod
    def _check_metadata(path: Path, written: dict, frames: dict[str, np.ndarray]) -> int:
        """How many frames a file covers, once its schema and dataset are known to be ours."""
        if written.get("schema") != SCHEMA:
            raise LabelFileError(
                f"{path} has schema {written.get('schema')}, this version reads and writes {SCHEMA}; "
                "use the version that wrote it, or move the file away. Nothing was overwritten"
            )
        covered = written["frames"]
        found = identity(frames, covered) if covered <= len(frames["index"]) else "fewer frames"
        if found != written["identity"]:
            raise LabelFileError(
                f"{path} was made for another dataset ({written['repo_id']}, {covered} frames, {written['identity']}); "
                f"this one has {len(frames['index'])} frames ({found}). Move the file to its dataset. Nothing was "
                "overwritten"
            )
        return covered

    def write(self, path: Path, repo_id: str, identity: str) -> None:
        """Replace the file atomically: whatever happens, the old or the new one is there, whole."""
        n = len(self.failure)
        described = {"schema": SCHEMA, "frames": n, "identity": identity, "repo_id": repo_id}
        by = pa.DictionaryArray.from_arrays(pa.array(self.by, mask=self.by < 0), pa.array(self.names, pa.string()))
        table = pa.table(
            {
                "index": pa.array(np.arange(n)),
                "failure": pa.array(self.failure),
                "labelled_by": by,
                "labelled_at": pa.array(self.at, pa.timestamp("us", "UTC"), mask=self.at == 0),
            }
        ).replace_schema_metadata({METADATA: json.dumps(described)})
        with replacing(path) as partial:
            pq.write_table(
                table,
                partial,
                use_dictionary=["labelled_by", "labelled_at"],
                column_encoding={"index": "DELTA_BINARY_PACKED"},
                compression="zstd",
            )


@dataclass
class FailureLabels:
    """Labels by the dataset's frame index.

    Attributes:
        failure: int8 (N,), 1 failing, 0 safe, -1 unlabelled.
        terminal: int8 (N,), 1 where an episode ended by itself, 0 where it goes on, -1 unknown.
        episode: int64 (N,), the episode of each frame.
    """

    failure: np.ndarray
    terminal: np.ndarray
    episode: np.ndarray

    @classmethod
    def load(cls, root: str | Path, specification: str = "failure") -> "FailureLabels":
        """Read labels of a dataset on disk.

        They come from the column `specification`, or from the sidecar `labels/<specification>.parquet` with the
        columns `index` and `failure`, which wins where both exist.

        Raises:
            UnlabelledDatasetError: neither exists, a sidecar does not match the frames, or one class is missing.
        """
        root = Path(root)
        data = read_frames(root, [specification, "next.done", "action"])
        n, episode = len(data["index"]), data["episode_index"].astype(np.int64)
        terminal = np.full(n, UNLABELLED, np.int8)
        if "next.done" in data:
            terminal = as_labels(data["next.done"], n, f"column 'next.done' of {root}")
        sidecar = sidecar_path(root, specification)
        if sidecar.exists():
            failure = Sidecar.read(sidecar, data).failure
        elif specification in data:
            failure = as_labels(data[specification], n, f"column {specification!r} of {root}")
        else:
            columns = pq.ParquetFile(next(root.glob("data/*/*.parquet"))).schema_arrow.names
            raise UnlabelledDatasetError(
                f"{root} has no failure labels: expected a column {specification!r} (1 failing, 0 "
                f"safe, -1 unlabelled) or {sidecar.relative_to(root)}, which latentsafe label makes; its columns are "
                f"{', '.join(sorted(columns))}, its label files {', '.join(specifications_of(root)) or 'none'}"
            )
        labels = cls(failure, terminal, episode)
        labels._check(root, specification)
        return labels

    def _check(self, root: Path, specification: str) -> None:
        for value, name in ((FAILING, "failing"), (SAFE, "safe")):
            if not (self.failure == value).any():
                raise UnlabelledDatasetError(
                    f"labels {specification!r} of {root} have no {name} frame among {len(self.failure)}; "
                    "a failure margin needs examples of both classes"
                )

    @property
    def balance(self) -> float:
        """Share of failing frames among the labelled."""
        return float((self.failure == FAILING).sum() / (self.failure != UNLABELLED).sum())


def all_labels(root: str | Path, features: dict[str, dict]) -> dict[str, np.ndarray]:
    """The labels of all specifications that a dataset has, name -> int8 (N,).

    Args:
        features: of the dataset. `failure` must hold labels; others do if their name is fit and all values are labels.

    Raises:
        LabelFileError: a label file of another dataset, or values that are no labels.
    """
    numbers = [name for name, f in features.items() if f["dtype"].startswith(("bool", "int", "uint", "float"))]
    frames = read_frames(root, ["action", *(name for name in ["failure", *numbers] if NAME.fullmatch(name))])
    n, found = len(frames["index"]), {}
    for name in sorted(set(frames) - {"index", "episode_index", "action"}):
        try:
            found[name] = as_labels(frames[name], n, f"column {name!r} of {root}")
        except LabelFileError:
            if name == "failure":
                raise
    for name in specifications_of(root):
        found[name] = Sidecar.read(sidecar_path(root, name), frames).failure
    return found


def as_labels(values: np.ndarray, n: int, source: str) -> np.ndarray:
    """Exactly -1, 0 or 1 for each of n frames: what is cast to int8 unchecked could turn into "safe"."""
    if values.shape == (n, 1):
        values = values[:, 0]
    if values.shape != (n,):
        raise LabelFileError(f"{source} holds {values.size} labels for {n} frames; expected one a frame")
    unknown = sorted({str(v) for v in set(values.tolist()) if v not in (FAILING, SAFE, UNLABELLED)})
    if unknown:
        raise LabelFileError(f"{source} holds {', '.join(unknown[:5])}; expected 1, 0 or -1")
    return values.astype(np.int8)
