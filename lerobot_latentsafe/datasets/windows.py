"""The windows of a small dataset that a LeRobot policy asks for, from memory.

LeRobot's loader reads every window through parquet; for a small policy without images that takes most of the training.
"""

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset


class Windows:
    """See the module's text.

    Args:
        dataset: none of `deltas` may be a camera.
        deltas: key -> offsets in frames.
        drop_last: frames at the end of each episode at which no window is anchored.
    """

    def __init__(self, dataset: "LeRobotDataset", deltas: dict[str, list[int]], drop_last: int = 0):
        columns = dataset.hf_dataset.with_format("numpy")
        episode = np.asarray(columns["episode_index"])
        self.columns = {key: torch.from_numpy(np.stack(columns[key]).astype(np.float32)) for key in deltas}
        self.offsets = {key: np.array(offsets) for key, offsets in deltas.items()}
        self.first = np.searchsorted(episode, episode, "left")
        self.last = np.searchsorted(episode, episode, "right") - 1
        self.anchors = np.flatnonzero(np.arange(len(episode)) <= self.last - drop_last)

    def draw(self, n: int) -> dict[str, Tensor]:
        """A LeRobot batch of n random windows."""
        return self.at(self.anchors[torch.randint(len(self.anchors), (n,)).numpy()])

    def at(self, frame: np.ndarray) -> dict[str, Tensor]:
        """The windows anchored at frames (B,): key -> (B, T, ...).

        Beyond an episode's ends its outermost frames repeat, and `<key>_is_pad` (B, T) is True.
        """
        batch: dict[str, Tensor] = {}
        for key, offsets in self.offsets.items():
            index = frame[:, None] + offsets
            inside = index.clip(self.first[frame, None], self.last[frame, None])
            batch[key] = self.columns[key][inside]
            batch[f"{key}_is_pad"] = torch.from_numpy(index != inside)
        return batch
