"""Frames that were seen, to illustrate what a world model imagines but cannot draw."""

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.datasets.episodes import DatasetFrames, shrunk
from lerobot_latentsafe.evaluation.along_episodes import check_fit, numbers_of
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.safety_model import SafetyModel

EPISODES, FRAMES = 40, 2000
"""Of a dataset, at most so many episodes and frames are put in, evenly spread."""
SHOWN_ROWS = 240
"""Rows of a picture that is kept to be shown."""


class NearestFrames:
    """Pictures with what a filter's world model perceives in them, looked through for the one most like a latent."""

    def __init__(self, model: SafetyModel):
        self.model = model
        self.pictures: list[np.ndarray] = []
        self._seen: list[tuple[dict[str, Tensor], Tensor]] = []

    def __len__(self) -> int:
        return len(self.pictures)

    @torch.no_grad()
    def add(self, pictures: list[np.ndarray], images: dict[str, Tensor], state: Tensor) -> None:
        """Put frames in.

        Args:
            pictures: N RGB pictures (H, W, 3), uint8: what is shown of each.
            images: camera key -> (N, C, H, W), uint8 or in [0, 1]: all that the filter sees of them.
            state: (N, S) in robot units.
        """
        self._seen.append(self.model.see({**images, "observation.state": state}))
        self.pictures += pictures

    def add_dataset(self, frames: DatasetFrames) -> None:
        """Put a sample of a recorded dataset in.

        Raises:
            ValueError: it was recorded with another robot, rate or camera than the filter's.
        """
        check_fit(self.model, frames)
        total = len(frames.episodes)
        step = -(-min(EPISODES, total) * frames.meta.total_frames // (frames.meta.total_episodes * FRAMES))
        places = np.unique(np.linspace(0, total - 1, min(EPISODES, total)).round().astype(int))
        for episode in np.array(frames.episodes)[places].tolist():
            state = numbers_of(frames, episode, "observation.state")[::step]
            numbers, at = range(0, frames.length(episode), step), 0
            for images in frames.pieces(self.model.world_model.image_keys, episode, numbers):
                shown = images[self.model.config.trained_on.cameras[0]].permute(0, 2, 3, 1).numpy()
                self.add([shrunk(image, SHOWN_ROWS) for image in shown], images, state[at : at + len(shown)])
                at += len(shown)

    @torch.no_grad()
    def nearest(self, latent: Latent) -> np.ndarray:
        """The picture (H, W, 3) of the frame that the world model would have been least surprised to see.

        Args:
            latent: (1, ...).

        Raises:
            ValueError: there are no frames.
        """
        if not self._seen:
            raise ValueError("no frames to choose from: give --dataset.repo_id, or episodes to film")
        errors = []
        for percepts, state in self._seen:
            repeated = {key: t.expand(len(state), *t.shape[1:]) for key, t in latent.items()}
            errors.append(self.model.world_model.error(repeated, percepts, state))
        return self.pictures[int(torch.cat(errors).argmin())]
