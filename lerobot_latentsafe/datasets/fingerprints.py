"""What tells the episodes of a dataset apart, whatever their names, videos and added columns: their numbers."""

import hashlib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_latentsafe.datasets.label_places import UnlabelledDatasetError

TELLING = ("action", "observation.state")


def telling_columns(root: Path) -> list[str]:
    """Columns that tell a dataset's episodes apart: actions and states, and the time.

    Where one of them is missing, every column of fractions takes part.
    """
    file = next(root.glob("data/*/*.parquet"), None)
    schema = pq.ParquetFile(file).schema_arrow if file else pa.schema([])
    chosen = [name for name in TELLING if name in schema.names]
    if len(chosen) < len(TELLING):
        numbers = [f.name for f in schema if _is_fraction(f.type) and not f.name.startswith("next.")]
        chosen += sorted({*numbers} - {*chosen, "timestamp"})
    return [*chosen, *({"timestamp"} & {*schema.names})]


def _is_fraction(kind: pa.DataType) -> bool:
    while pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        kind = kind.value_type
    return pa.types.is_floating(kind)


def by_length_alone(columns: list[str]) -> bool:
    """Whether these columns know nothing of a frame but its time."""
    return set(columns) <= {"timestamp"}


def fingerprint(frames: dict[str, np.ndarray], columns: list[str], rows: slice) -> str:
    """Of the frames of one episode: how many, and their numbers in these columns."""
    digest = hashlib.sha256(str(rows.stop - rows.start).encode())
    for name in columns:
        values = frames[name][rows]
        as_bytes = repr(values.tolist()).encode() if values.dtype == object else values.astype("<f4").tobytes()
        digest.update(name.encode() + as_bytes)
    return digest.hexdigest()[:16]


def episode_spans(episode: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First frame and length of each episode, from the episode of each frame (N,).

    Raises:
        UnlabelledDatasetError: an episode is missing.
    """
    start = np.flatnonzero(np.r_[True, episode[1:] != episode[:-1]])
    if not np.array_equal(episode[start], np.arange(len(start))):
        raise UnlabelledDatasetError(
            f"episodes are numbered {episode[start][:5].tolist()}...; expected 0, 1, 2, ...: an episode file is "
            "missing. Download or restore the whole dataset"
        )
    return start, np.diff(np.r_[start, len(episode)])
