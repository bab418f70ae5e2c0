"""What a shield decided, frame by frame, beside the recording."""

import logging
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_latentsafe.datasets.reading import some
from lerobot_latentsafe.decision import FilterDecision, Reason
from lerobot_latentsafe.runtime.files import replacing

logger = logging.getLogger(__name__)

FILE = Path("shield") / "decisions.parquet"
"""Where a recording's decisions are, in its dataset's folder."""


class Journal:
    """Rows of decisions by episode and frame, for a parquet file.

    Columns: episode_index, frame_index, proposed and executed (lists of float, robot units), value, margin, intervened,
    adjusted (journals of versions before 0.3 have none), reason (the name of a `Reason`); of a filter with a monitor of
    the unknown also unknown (share of its threshold) and drift (the session's evidence E). What was executed tells
    which dataset it belongs to. Frames count from 0 in each episode; the pauses between episodes leave no rows.

    Raises:
        ValueError: the file exists and is not readable.
    """

    def __init__(self, path: Path):
        self.path = Path(path)
        self.episodes: dict[int, list[dict]] = {}
        self.episode: int | None = 0
        if self.path.exists():  # a recording that goes on
            for row in _read(self.path).to_pylist():
                row.setdefault("adjusted", False)
                self.episodes.setdefault(row["episode_index"], []).append(row)
            self.episode = max(self.episodes, default=-1) + 1

    def begin(self, episode: int | None) -> None:
        """Begin an episode, anew if it was begun before; None: a pause."""
        self.episode = episode
        if episode is not None:
            self.episodes[episode] = []

    def add(self, decision: FilterDecision, executed: list[float]) -> None:
        """Note the decision on the next frame (batch of one), and what the robot made of it."""
        if self.episode is None:
            return
        rows = self.episodes.setdefault(self.episode, [])
        rows.append(
            {
                "episode_index": self.episode,
                "frame_index": len(rows),
                "proposed": decision.proposed[0].tolist(),
                "executed": executed,
                "value": decision.value.item(),
                "margin": decision.margin.item(),
                "intervened": bool(decision.intervened.item()),
                "adjusted": bool(decision.adjusted.item()),
                "reason": Reason(int(decision.reason.item())).name.lower(),
                **_of_the_unknown(decision),
            }
        )

    def executed(self) -> np.ndarray:
        """What was executed in the present episode, (T, A)."""
        return np.array([row["executed"] for row in self.episodes.get(self.episode, [])], np.float32)

    def write_to(self, path: Path) -> None:
        """Write all rows into a file.

        Raises:
            OSError: it cannot be written.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        rows = [row for _, episode in sorted(self.episodes.items()) for row in episode]
        pq.write_table(pa.Table.from_pylist(rows), path)

    def write(self) -> None:
        """Replace the file at once by what is known; a failure to write is logged, for the robot must go on."""
        if not any(self.episodes.values()):
            return
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(self.path) as partial:
                self.write_to(partial)
        except OSError as e:
            logger.error("decisions were not written to %s (%s); they are kept and tried again", self.path, e)


def _of_the_unknown(decision: FilterDecision) -> dict[str, float]:
    """What a monitor of the unknown found, if there is one."""
    found = {"unknown": decision.unknown, "drift": decision.drift}
    return {name: value.item() for name, value in found.items() if value is not None}


def _read(path: Path) -> pa.Table:
    """The table of a journal.

    Raises:
        FileNotFoundError: there is none.
        ValueError: torn, or not a journal.
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"{path} does not exist; `latentsafe record` writes it, put it back if it did")
    try:
        table = pq.read_table(path)
    except (pa.ArrowInvalid, OSError) as e:
        raise ValueError(f"{path} is not a readable file of decisions ({e}); put a copy of it there") from e
    if missing := {"episode_index", "frame_index", "executed"} - {*table.column_names}:
        raise ValueError(f"{path} holds no decisions: it lacks {', '.join(sorted(missing))}; put a copy of it there")
    return table


def decision_columns(path: Path, frames: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A journal's columns for the frames of a dataset, in their order.

    Args:
        frames: episode_index, frame_index (N,) and action (N, A) of the dataset.

    Returns:
        proposed (N, A) and value, margin (N,) float32; intervened, adjusted, reason (N,) int64.

    Raises:
        ValueError: the journal lacks an episode, or holds other actions: it belongs to another dataset.
        FileNotFoundError: there is no journal.
    """
    found = matching_rows(path, frames)
    return {
        "proposed": np.array([row["proposed"] for row in found], np.float32),
        "value": np.array([row["value"] for row in found], np.float32),
        "margin": np.array([row["margin"] for row in found], np.float32),
        "intervened": np.array([row["intervened"] for row in found], np.int64),
        "adjusted": np.array([row.get("adjusted", False) for row in found], np.int64),
        "reason": np.array([Reason[row["reason"].upper()] for row in found], np.int64),
    }


def matching_rows(path: Path, frames: dict[str, np.ndarray]) -> list[dict]:
    """A journal's row for each frame of a dataset, in their order.

    Args:
        frames: episode_index, frame_index (N,) and action (N, A) of the dataset.

    Raises:
        ValueError: naming the episodes without decisions, or the first frame that stores another action.
        FileNotFoundError: there is no journal.
    """
    rows = {(row["episode_index"], row["frame_index"]): row for row in _read(path).to_pylist()}
    decided, stored = {episode for episode, _ in rows}, {*frames["episode_index"].tolist()}
    if lacking := sorted(stored - decided):
        having = sorted(stored & decided)
        raise ValueError(
            f"{path} holds no decisions of episodes {some(lacking)}: they were recorded without `latentsafe record`, "
            f"or the file is not all. Put all of it there, or leave them out: --dataset.episodes={having}"
        )
    found = []
    for episode, frame, action in zip(*(frames[key].tolist() for key in ("episode_index", "frame_index", "action"))):
        row = rows.get((episode, frame), {"executed": None})
        if row["executed"] is None or not np.allclose(row["executed"], action, rtol=1e-5, atol=1e-6):
            raise ValueError(
                f"{path} says that {row['executed']} was executed in episode {episode}, frame {frame}, the dataset "
                f"{action}; it belongs to another dataset. Put the decisions of this one there"
            )
        found.append(row)
    return found
