"""Windows from memory are those of LeRobot's loader."""

import numpy as np
import pytest
import tiny
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.datasets.windows import Windows

DELTAS = {"observation.state": [-1, 0], "action": [-1, 0, 1, 2]}


@pytest.fixture(scope="module")
def windows(cache_root):
    return Windows(LeRobotDataset(tiny.REPO_ID + "_cache", root=cache_root), DELTAS, drop_last=2)


def test_windows_are_those_of_the_loader(windows, cache_root, cache_meta):
    seconds = {key: [offset / cache_meta.fps for offset in offsets] for key, offsets in DELTAS.items()}
    dataset = LeRobotDataset(tiny.REPO_ID + "_cache", root=cache_root, delta_timestamps=seconds)
    length = dataset.meta.episodes[0]["length"]
    frames = np.array([0, 1, length - 2, length - 1, length])  # both ends of an episode, and the next one's first frame
    batch = windows.at(frames)
    for row, frame in enumerate(frames):
        item = dataset[int(frame)]
        for key in [*DELTAS, *(f"{key}_is_pad" for key in DELTAS)]:
            torch.testing.assert_close(batch[key][row], item[key].reshape(batch[key][row].shape), rtol=0, atol=0)


def test_nothing_is_anchored_where_a_policy_drops_frames(windows):
    torch.manual_seed(0)
    drawn = windows.draw(256)
    assert drawn["action"].shape[:2] == (256, 4)
    assert not drawn["action_is_pad"][:, 1:].any()
