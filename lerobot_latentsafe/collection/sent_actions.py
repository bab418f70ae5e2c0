"""A recording's actions are what the robot was sent, whatever lies between the operator and the dataset.

LeRobot stores what comes out of its `teleop_action_processor`, not what `send_action` returns. Plugins replace that
processor, or change the action after it. So what is stored is taken from the robot, where LeRobot stores it. The
decision on each stored frame is kept beside it, and joins the dataset with its episode.
"""

import json
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
from lerobot.utils.constants import ACTION

from lerobot_latentsafe._compat import WRITER, episode_to_write
from lerobot_latentsafe.collection.whole_episodes import WORK, WholeEpisodes, recover
from lerobot_latentsafe.datasets.decisions import FILE, Journal, matching_rows
from lerobot_latentsafe.datasets.labels import read_frames
from lerobot_latentsafe.datasets.layout import INFO, check_layout
from lerobot_latentsafe.decision import FilterDecision
from lerobot_latentsafe.runtime.files import discard, locked_folder

logger = logging.getLogger(__name__)

Sent = tuple[dict[str, float], FilterDecision | None]
"""What was executed, by name, in robot units; and the decision that led to it, if it was judged."""

KEPT = "Nothing of this episode was stored; those before it are whole"


class SentActions(WholeEpisodes):
    """A writer that stores, with each frame, the action that was sent since the last one, and the decision on it."""

    def __init__(self, *args, take_sent: Callable[[], Sent | None], **options):
        super().__init__(*args, **options)
        self.take_sent, self.journal = take_sent, Journal(self.dataset / FILE)

    def add_frame(self, frame: dict) -> None:
        """Store a frame.

        Raises:
            ValueError: nothing was sent, it was not judged, or the dataset is to hold other commands.
        """
        names, (sent, decision) = self._meta.features[ACTION]["names"], self.take_sent() or ({}, None)
        if set(names) != set(sent):
            _refuse(", ".join(names), ", ".join(sent) or "nothing")
        if decision is None:
            raise ValueError(
                "the robot held still, for there is no decision on what the operator commands; the log says why. Use a "
                f"teleoperator that commands {', '.join(names)}. {KEPT}"
            )
        action, episode = np.array([sent[name] for name in names], np.float32), episode_to_write(self)
        if episode["size"] == 0:
            self.journal.begin(int(episode["episode_index"]))
        super().add_frame({**frame, ACTION: action})
        self.journal.add(decision, action.tolist())

    def save_episode(self, *args, **options) -> None:
        """Save the episode.

        Raises:
            ValueError: something else changed what it holds.
        """
        stored, sent = np.array(episode_to_write(self)[ACTION], np.float32), self.journal.executed()
        if not np.array_equal(stored, sent):
            changed = next((t for t, (a, b) in enumerate(zip(stored, sent)) if (a != b).any()), 0)
            _refuse(*(str(actions[changed : changed + 1].tolist()) for actions in (stored, sent)))
        super().save_episode(*args, **options)

    def write_beside(self, folder: Path) -> None:
        """The decisions join with their episode."""
        self.journal.write_to(folder / FILE)


def _refuse(stored: str, sent: str) -> None:
    raise ValueError(
        f"a frame was to store {stored}, and the robot was sent {sent}. A plugin changes what LeRobot stores: record "
        f"without it. {KEPT}"
    )


@contextmanager
def storing_what_was_sent(root: Path, resume: bool, take_sent: Callable[[], Sent | None]) -> Iterator[bool]:
    """Meanwhile LeRobot records whole episodes into `root`, with the actions that were sent and the decisions on them.

    Args:
        resume: whether a recording in `root` goes on; if it was killed, it is completed first.
        take_sent: gives what was sent since it was asked last, and forgets it.

    Yields:
        Whether there is a recording to go on with: one that was killed before it began is cleared away.

    Raises:
        FileExistsError: `root` exists, and no recording goes on.
        ValueError: the recording in `root` cannot go on; nothing was changed.
        FolderInUseError: another process records into it.
    """
    with locked_folder(root):
        if not resume and root.exists():
            raise FileExistsError(
                f"{root} exists already; --resume=true goes on with the recording in it, another --dataset.root begins "
                "one"
            )
        with patch(WRITER, partial(SentActions, take_sent=take_sent)):
            yield resume and _continue(root)


def _continue(root: Path) -> bool:
    """Complete a recording that was killed, if it had begun; refuse one without the decisions of its episodes."""
    if not root.is_dir() or not ((root / INFO).exists() or _never_began(root)):
        raise ValueError(f"there is no recording in {root} to go on with; leave --resume out to begin one elsewhere")
    if _never_began(root):
        logger.warning("the recording in %s was killed before it began; it begins now", root)
        discard(root)
        return False
    if (root / WORK).exists():
        logger.warning("the recording in %s was killed: what was saved is whole, a torn episode is left out", root)
        recover(root)
    if any(root.glob("data/*/*.parquet")):
        check_layout(root)
        _require_decisions(root)
    return True


def _never_began(root: Path) -> bool:
    """Whether there is nothing in a folder but what LeRobot leaves that is killed while it makes a dataset."""
    files = {file.relative_to(root).as_posix() for file in root.rglob("*") if file.is_file()}
    if not files <= {INFO}:
        return False
    try:
        return not json.loads((root / INFO).read_text())
    except (OSError, ValueError):
        return True


def _require_decisions(root: Path) -> None:
    try:
        matching_rows(root / FILE, read_frames(root, ["frame_index", ACTION]))
    except (ValueError, FileNotFoundError) as e:
        raise ValueError(
            f"the recording in {root} cannot go on: {e}. Or record into another --dataset.root, and join both with "
            "lerobot-edit-dataset --operation.type=merge. Nothing was changed"
        ) from e
