"""What stands in a label file, checked before it is used: its rows, and what it tells of its dataset."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_latentsafe.datasets.arrow import to_numpy
from lerobot_latentsafe.datasets.frame_labels import as_labels
from lerobot_latentsafe.datasets.label_places import LabelFileError

SCHEMA, METADATA = 2, b"latentsafe_labels"
LATEST = 2**53
"""Of times, in microseconds: the largest whole number that a browser tells from its neighbours."""
REMEDY = "restore the file from a copy, or move it away and label anew. Nothing was overwritten"


def _is_count(value: object) -> bool:
    return type(value) is int and value >= 0


def _is_name(value: object) -> bool:
    return isinstance(value, str)


def _each(fits: Callable[[object], bool]) -> Callable[[object], bool]:
    return lambda value: isinstance(value, list) and all(map(fits, value))


ENTRIES_1 = {
    "frames": (_is_count, "a whole number"),
    "identity": (_is_name, "a text"),
    "repo_id": (_is_name, "a text"),
}
ENTRIES_2 = {
    **ENTRIES_1,
    "columns": (_each(_is_name), "a list of texts"),
    "lengths": (_each(_is_count), "a list of whole numbers"),
    "episodes": (_each(_is_name), "a list of texts"),
}
"""What each entry of a schema must be, and in words."""


@dataclass(frozen=True)
class Written:
    """What a label file tells of the dataset it was made for.

    Attributes:
        frames: how many it labels. identity: of the dataset, see `Content`. repo_id: its id.
        columns: those that the fingerprints are of; schema 1 has neither these, nor
        lengths, episodes: frames and fingerprint of each episode.
    """

    schema: int
    frames: int
    identity: str
    repo_id: str
    columns: list[str] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    episodes: list[str] = field(default_factory=list)

    @classmethod
    def read(cls, content: bytes, path: Path) -> Self:
        """From the JSON in a file's metadata.

        Raises:
            LabelFileError: no JSON, another schema, or an entry that is missing or of another kind.
        """
        told = _parsed(content, path)
        if told.get("schema") not in (1, SCHEMA):
            raise LabelFileError(
                f"{path} has schema {told.get('schema')}, this version reads 1 and {SCHEMA}; "
                "use the version that wrote it, or move the file away. Nothing was overwritten"
            )
        entries = ENTRIES_2 if told["schema"] == SCHEMA else ENTRIES_1
        for name, (fits, expected) in entries.items():
            if not fits(told.get(name)):
                raise LabelFileError(
                    f"{path} tells {name} {told.get(name)!r:.60} of its dataset; expected {expected}. Please {REMEDY}"
                )
        written = cls(told["schema"], **{name: told[name] for name in entries})
        written._check_lengths(path)
        return written

    def _check_lengths(self, path: Path) -> None:
        if self.schema == SCHEMA and (len(self.lengths), sum(self.lengths)) != (len(self.episodes), self.frames):
            raise LabelFileError(
                f"{path} tells {len(self.lengths)} lengths of {len(self.episodes)} episodes, and {sum(self.lengths)} "
                f"frames of {self.frames}; expected the same numbers. Please {REMEDY}"
            )

    def as_json(self) -> str:
        """What `read` reads."""
        return json.dumps(asdict(self))


def _parsed(content: bytes, path: Path) -> dict[str, Any]:
    try:
        told = json.loads(content)
    except (ValueError, RecursionError) as e:
        raise LabelFileError(f"{path} does not tell its dataset in JSON ({str(e)[:80]}). Please {REMEDY}") from e
    if not isinstance(told, dict):
        raise LabelFileError(f"{path} tells its dataset as {told!r:.60}; expected a JSON object. Please {REMEDY}")
    return told


@dataclass(frozen=True)
class LabelTable:
    """The rows of a label file, in its order; see `FrameLabels` for what the columns mean.

    Attributes:
        index: int64 (N,), frames.
        failure: int8 (N,). by: int32 (N,). at: int64 (N,).
        names: who labelled.
    """

    index: np.ndarray
    failure: np.ndarray
    by: np.ndarray
    at: np.ndarray
    names: list[str]


def read_label_file(path: Path) -> tuple[Written | None, LabelTable]:
    """What a label file says, or a plain table with the columns `index` and `failure`.

    Raises:
        LabelFileError: not readable, another schema, or a column or an entry that is not what it must be.
    """
    try:
        return _read(path)
    except (pa.ArrowException, OSError, UnicodeError) as e:
        raise LabelFileError(f"{path} is not a readable parquet file ({e}); restore it or move it away") from e


def _read(path: Path) -> tuple[Written | None, LabelTable]:
    table = pq.ParquetFile(path, page_checksum_verification=True).read()
    table.validate(full=True)
    missing = {"index", "failure"} - set(table.column_names)
    if missing:
        raise LabelFileError(f"{path} lacks the columns {sorted(missing)}; expected index and failure")
    for name in COLUMNS:
        _check_column(table, name, path)
    described, n = (table.schema.metadata or {}).get(METADATA), len(table)
    written = None if described is None else Written.read(described, path)
    by, names = _names_of(table, n)
    failure = as_labels(to_numpy(table["failure"]), n, str(path))
    return written, LabelTable(to_numpy(table["index"]).astype(np.int64), failure, by, _times_of(table, n, path), names)


def _check_column(table: pa.Table, name: str, path: Path) -> None:
    fits, expected = COLUMNS[name]
    found = table.column_names.count(name)
    if found > 1:
        raise LabelFileError(f"{path} has {found} columns {name!r}; expected one. Please {REMEDY}")
    if found and not fits(table[name]):
        raise LabelFileError(
            f"{path} holds {table[name].type} in its column {name!r}; expected {expected}. Please {REMEDY}"
        )


def _is_text(column: pa.ChunkedArray) -> bool:
    kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    return pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_null(kind)


def _is_time(column: pa.ChunkedArray) -> bool:
    kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    return pa.types.is_timestamp(kind) or pa.types.is_integer(kind) or pa.types.is_null(kind)


COLUMNS = {
    "index": (lambda c: pa.types.is_integer(c.type) and not c.null_count, "whole numbers, none missing"),
    "failure": (lambda c: True, ""),  # its values are looked at one by one
    "labelled_by": (_is_text, "names"),
    "labelled_at": (_is_time, "times, or whole numbers of microseconds since 1970"),
}
"""What each column must be, and in words."""


def _names_of(table: pa.Table, n: int) -> tuple[np.ndarray, list[str]]:
    if "labelled_by" not in table.column_names:
        return np.full(n, -1, np.int32), []
    column = table["labelled_by"].cast(pa.string()).combine_chunks().dictionary_encode()
    column = pa.concat_arrays(column.chunks) if isinstance(column, pa.ChunkedArray) else column
    return column.indices.fill_null(-1).to_numpy(), column.dictionary.to_pylist()


def _times_of(table: pa.Table, n: int, path: Path) -> np.ndarray:
    """int64 (N,), microseconds since 1970 UTC; 0 where none is told."""
    if "labelled_at" not in table.column_names:
        return np.zeros(n, np.int64)
    column = table["labelled_at"]
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if pa.types.is_timestamp(column.type):
        column = column.cast(pa.timestamp("us", column.type.tz), safe=False)
    at = column.cast(pa.int64(), safe=False).fill_null(0).to_numpy()
    if n and (at.min() < 0 or at.max() >= LATEST):
        raise LabelFileError(
            f"{path} tells times from {at.min()} to {at.max()} in its column 'labelled_at'; expected microseconds "
            f"since 1970, at most {LATEST}. Please {REMEDY}"
        )
    return at
