"""What `latentsafe record` stored under a filter, read back as episodes that a report can show."""

from collections.abc import Iterator

import numpy as np
import torch

from lerobot_latentsafe.datasets.decisions import FILE, decision_columns
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.labels import read_frames
from lerobot_latentsafe.evaluation.along_episodes import check_fit, encode_episodes
from lerobot_latentsafe.evaluation.rollouts import Episodes
from lerobot_latentsafe.latent import map_latent
from lerobot_latentsafe.safety_model import SafetyModel


class Pictures:
    """One camera's frames of an episode, decoded whenever somebody looks at them."""

    def __init__(self, frames: DatasetFrames, camera: str, episode: int):
        self.frames, self.camera, self.episode = frames, camera, episode

    def __len__(self) -> int:
        return self.frames.length(self.episode)

    def __getitem__(self, t: int) -> np.ndarray:
        return next(self.frames.stream(self.camera, self.episode, [range(len(self))[t]]))

    def __iter__(self) -> Iterator[np.ndarray]:
        return self.frames.stream(self.camera, self.episode)


class RecordedEpisodes:
    """A dataset with the shield's decisions beside it, or some episodes of one.

    Attributes:
        episode: (N,) of each frame.
        state, executed: (N, S) and (N, A), of each frame.
        decisions: proposed (N, A), value, margin, intervened, adjusted and reason (N,) of each frame; see
            `decision_columns`.

    Raises:
        ValueError: the decisions are another dataset's, or the dataset another robot's than the filter's.
    """

    def __init__(self, model: SafetyModel, frames: DatasetFrames):
        check_fit(model, frames)
        self.model, self.frames = model, frames
        stored = read_frames(frames.root, ["frame_index", "action", "observation.state"])
        meant = np.isin(stored["episode_index"], frames.episodes)
        stored = {name: column[meant] for name, column in stored.items()}
        self.episode, self.executed = stored["episode_index"], stored["action"]
        self.state = stored.get("observation.state", np.zeros((len(self.episode), 0)))
        self.decisions = decision_columns(frames.root / FILE, stored)

    @staticmethod
    def is_one(frames: DatasetFrames) -> bool:
        """Whether decisions lie beside a dataset."""
        return (frames.root / FILE).exists()

    def read(self, episode: int) -> Episodes:
        """One episode; whether it succeeded or failed is not known here, and stands as no."""
        rows, no = self.episode == episode, np.zeros(1, bool)
        trace = {name: column[rows].tolist() for name, column in self.decisions.items()}
        proposed, state = (torch.from_numpy(x[rows]).float() for x in (self.decisions["proposed"], self.state))
        trace["heard"] = self.model.units.heard_action(proposed, state).tolist()
        change = np.linalg.norm(self.executed[rows] - self.decisions["proposed"][rows], axis=-1)
        latents, (length,) = encode_episodes(self.model, self.frames, [episode])
        return Episodes(
            success=no, violation=no, stall=no, steps=np.array([length]),
            overridden=np.array([sum(trace["intervened"])]), action_change=np.array([change.sum()]),
            severity=np.full(1, np.nan),
            traces=[{**trace, "action": self.executed[rows].tolist()}],
            frames=[Pictures(self.frames, self.model.config.trained_on.cameras[0], episode)],  # type: ignore[list-item]
            latents=[[map_latent(latents, lambda z, t=t: z[:, t]) for t in range(length)]],
        )  # fmt: skip
