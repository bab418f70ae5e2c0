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


@contextmanager
def storing_what_was_sent(take_sent: Callable[[], dict[str, float] | None]) -> Iterator[None]:
    """Meanwhile each frame that is added to a dataset holds the action that was sent since the last one.

    Args:
        take_sent: gives that action by name, in robot units, and forgets it; None if nothing was sent.

    Raises:
        ValueError: before a frame is stored: nothing was sent, or the dataset is to hold other commands.
    """
    add = LeRobotDataset.add_frame

    def add_sent(dataset: LeRobotDataset, frame: dict) -> None:
        names, sent = dataset.features[ACTION]["names"], take_sent()
        if sent is None or set(names) != set(sent):
            raise ValueError(
                f"a frame with the commands {', '.join(names)} was to be stored, and the robot was sent "
                f"{', '.join(sent) if sent else 'nothing'}. Something replaces LeRobot's processors: record without "
                "that plugin. Nothing of this episode was stored"
            )
        add(dataset, {**frame, ACTION: np.array([sent[name] for name in names], np.float32)})

    with patch.object(LeRobotDataset, "add_frame", add_sent):
        yield
