"""A recording's actions are what the robot was sent, whatever lies between the operator and the dataset.

LeRobot stores what comes out of its `teleop_action_processor`, not what `send_action` returns. Plugins replace that
processor, or change the action after it. So what is stored is taken from the robot, where LeRobot stores it.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from unittest.mock import patch

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION

from lerobot_latentsafe._compat import last_added


@contextmanager
def storing_what_was_sent(take_sent: Callable[[], dict[str, float] | None]) -> Iterator[None]:
    """Meanwhile each frame that is added to a dataset holds the action that was sent since the last one.

    Args:
        take_sent: gives that action by name, in robot units, and forgets it; None if nothing was sent.

    Raises:
        ValueError: before an episode is stored: nothing was sent, the dataset is to hold other commands, or something
            else changes what it holds.
    """
    add = LeRobotDataset.add_frame

    def add_sent(dataset: LeRobotDataset, frame: dict) -> None:
        names, sent = dataset.features[ACTION]["names"], take_sent()
        if sent is None or set(names) != set(sent):
            _refuse(", ".join(names), ", ".join(sent) if sent else "nothing")
        action = np.array([sent[name] for name in names], np.float32)
        add(dataset, {**frame, ACTION: action})
        stored = last_added(dataset, ACTION)
        if not np.array_equal(stored, action):
            _refuse(str(stored), str(action))

    with patch.object(LeRobotDataset, "add_frame", add_sent):
        yield


def _refuse(stored: str, sent: str) -> None:
    raise ValueError(
        f"a frame was to store {stored}, and the robot was sent {sent}. A plugin changes what LeRobot stores: record "
        "without it. Nothing of this episode was stored"
    )
