"""What a shield decided, frame by frame, beside the recording."""

import logging
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_latentsafe.decision import FilterDecision, Reason
from lerobot_latentsafe.runtime.files import replacing

logger = logging.getLogger(__name__)

FILE = Path("shield") / "decisions.parquet"
"""Where a recording's decisions are, in its dataset's folder."""


class Journal:
    """Rows of decisions by episode and frame, written to a parquet file after every episode.

    Columns: episode_index, frame_index, proposed and executed (lists of float, robot units), value, margin, intervened,
    reason (the name of a `Reason`). What was executed tells which dataset it belongs to. Frames count from 0 in each
    episode; the pauses between episodes leave no rows.
    """

    def __init__(self, path: Path):
        self.path = Path(path)
        self.episodes: dict[int, list[dict]] = {}
        self.episode: int | None = 0
        if self.path.exists():  # a recording that goes on
            for row in _read(self.path).to_pylist():
                self.episodes.setdefault(row["episode_index"], []).append(row)
            self.episode = max(self.episodes, default=-1) + 1

    def hear(self, announced: int | str) -> None:
        """Begin an episode, anew if it was begun before, or end one."""
        self.write()
        self.episode = announced if isinstance(announced, int) else None
        if self.episode is not None:
            self.episodes[self.episode] = []

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
                "reason": Reason(int(decision.reason.item())).name.lower(),
            }
        )

    def write(self) -> None:
        """Replace the file at once by what is known; a failure to write is logged, for the robot must go on."""
        rows = [row for _, episode in sorted(self.episodes.items()) for row in episode]
        if not rows:
            return
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with replacing(self.path) as partial:
                pq.write_table(pa.Table.from_pylist(rows), partial)
        except OSError as e:
            logger.error("decisions were not written to %s (%s); they are kept and tried again", self.path, e)


def _read(path: Path) -> pa.Table:
    """The table of a journal.

    Raises:
        ValueError: torn, or not a journal.
    """
    try:
        return pq.read_table(path)
    except (pa.ArrowInvalid, OSError) as e:
        raise ValueError(f"{path} is not a readable journal of decisions ({e}); move it away") from e


def decision_columns(path: Path, frames: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """A journal's columns for the frames of a dataset, in their order.

    Args:
        frames: episode_index, frame_index (N,) and action (N, A) of the dataset.

    Returns:
        proposed (N, A) and value, margin (N,) float32; intervened, reason (N,) int64.

    Raises:
        ValueError: the journal lacks a frame, or holds other actions: it belongs to another dataset.
        FileNotFoundError: there is no journal.
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"{path} does not exist; record with `latentsafe record` to get one")
    rows = {(row["episode_index"], row["frame_index"]): row for row in _read(path).to_pylist()}
    wanted = list(zip(frames["episode_index"].tolist(), frames["frame_index"].tolist()))
    _check_dataset(path, rows, wanted, frames["action"])
    found = [rows[key] for key in wanted]
    return {
        "proposed": np.array([row["proposed"] for row in found], np.float32),
        "value": np.array([row["value"] for row in found], np.float32),
        "margin": np.array([row["margin"] for row in found], np.float32),
        "intervened": np.array([row["intervened"] for row in found], np.int64),
        "reason": np.array([Reason[row["reason"].upper()] for row in found], np.int64),
    }


def check_recording(path: Path, frames: dict[str, np.ndarray]) -> None:
    """Refuse a recording whose stored actions are not those that its journal says the robot executed.

    Args:
        frames: episode_index, frame_index (N,) and action (N, A) of the dataset. Episodes without decisions, recorded
            in another way, are left alone.

    Raises:
        ValueError: naming the first frame that differs, with what to do.
    """
    executed = {(row["episode_index"], row["frame_index"]): row["executed"] for row in _read(path).to_pylist()}
    decided = {episode for episode, _ in executed}
    for episode, frame, stored in zip(
        frames["episode_index"].tolist(), frames["frame_index"].tolist(), frames["action"]
    ):
        sent = executed.get((episode, frame))
        if episode in decided and (sent is None or not np.allclose(sent, stored, rtol=1e-5, atol=1e-6)):
            raise ValueError(
                f"episode {episode}, frame {frame} stores {stored.tolist()}, and the robot executed {sent}: something "
                "changes what LeRobot stores. Record again without that plugin; what was executed is in "
                f"{path}"
            )


def _check_dataset(path: Path, rows: dict[tuple, dict], wanted: list[tuple], action: np.ndarray) -> None:
    missing = [key for key in wanted if key not in rows]
    if missing:
        raise ValueError(
            f"{path} holds no decision for episode {missing[0][0]}, frame {missing[0][1]} and {len(missing) - 1} more "
            "frames; it belongs to another dataset"
        )
    for key, stored in zip(wanted, action):
        executed = rows[key].get("executed")
        if executed is None or not np.allclose(executed, stored, rtol=1e-5, atol=1e-6):
            raise ValueError(
                f"{path} says that {executed} was executed in episode {key[0]}, frame {key[1]}, the dataset "
                f"{stored.tolist()}; it belongs to another dataset. Put the journal of this recording there"
            )
