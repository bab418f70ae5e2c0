"""What tells the episodes of a dataset apart, whatever their names, videos and added columns: their numbers."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_latentsafe.datasets.label_places import UnlabelledDatasetError
from lerobot_latentsafe.units import TrainedOn

TELLING = ("action", "observation.state")
SHORT = 8
"""Hex digits that a filter keeps of each episode that it was trained on: of a thousand of those and a hundred others,
one in forty thousand is taken for one of them."""


class TrainedOnError(ValueError):
    """Episodes that were held out are among those trained on: what a filter says of them promises nothing."""


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


# -- what was trained on ---


def episode_marks(episode: np.ndarray, state: np.ndarray, action: np.ndarray) -> dict[int, str]:
    """Episode -> short fingerprint, from the episode (N,), state (N, S) and action (N, A) of each frame."""
    frames = {"action": action, "observation.state": state}
    numbers, start, length = np.unique(episode, return_index=True, return_counts=True)
    return {
        int(number): fingerprint(frames, [*frames], slice(first, first + n))[:SHORT]
        for number, first, n in zip(numbers, start, length)
    }


def with_episodes(known: TrainedOn, marks: dict[int, str], chosen: Sequence[int] | None = None) -> TrainedOn:
    """What is known of a training with these episodes beside those before; what was unknown before stays unknown.

    Args:
        marks: of all episodes of a dataset.
        chosen: those that are trained on; None: all.
    """
    if known.episodes is None and known.has_reached("world_model"):
        return known
    added = {mark for episode, mark in marks.items() if chosen is None or episode in chosen}
    return replace(known, episodes="".join(sorted(added | _kept(known))))


def _kept(known: TrainedOn) -> set[str]:
    joined = known.episodes or ""
    return {joined[i : i + SHORT] for i in range(0, len(joined), SHORT)}


def refuse_trained_on(known: TrainedOn, marks: dict[int, str], chosen: np.ndarray | Sequence[int]) -> bool:
    """Refuse held-out episodes that were trained on; returns whether that is known at all.

    Raises:
        TrainedOnError: naming how many, and which.
    """
    trained = _kept(known)
    same = [int(episode) for episode in chosen if marks[int(episode)] in trained]
    if same:
        raise TrainedOnError(
            f"{len(same)} of the {len(chosen)} held-out episodes were trained on: {', '.join(map(str, same[:8]))}"
            f"{', ...' if len(same) > 8 else ''}. What a filter says of them promises nothing of others: name episodes "
            "that it has not seen (--dataset.episodes), or record new ones"
        )
    return known.episodes is not None
