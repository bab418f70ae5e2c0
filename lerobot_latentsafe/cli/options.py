"""Options that several verbs share, in LeRobot's grammar: `--policy.path`, `--dataset.repo_id`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import HF_LEROBOT_HOME

from lerobot_latentsafe.datasets.episodes import DatasetFrames


@dataclass
class DatasetSource:
    """A LeRobotDataset: its id, and its folder if it is not in LeRobot's home."""

    repo_id: str = "local/dataset"
    """Its id, such as me/bag."""
    root: str | None = None
    """Its folder; by default LeRobot's own for this id."""
    episodes: list[int] | None = None
    """Numbers of the episodes to use, such as [0,1,2]; by default all."""

    def metadata(self) -> LeRobotDatasetMetadata:
        """What is known of the dataset without reading it.

        Raises:
            ValueError: `episodes` names one that it does not have.
        """
        return self._checked(LeRobotDatasetMetadata(self.repo_id, root=self.root))

    def opened(self) -> LeRobotDataset:
        """The whole dataset.

        Raises:
            ValueError: `episodes` names one that it does not have.
        """
        dataset = LeRobotDataset(self.repo_id, root=self.root)
        self._checked(dataset.meta)
        return dataset

    def frames(self) -> DatasetFrames:
        """The dataset's pictures, on this machine: a dataset without a folder is fetched from the Hub.

        Raises:
            OSError: there is none.
            ValueError: it has no camera, or `episodes` names one that it does not have.
        """
        if self.root:
            return DatasetFrames(self.metadata(), self.episodes)
        try:
            meta = LeRobotDataset(self.repo_id, episodes=self.episodes).meta
        except OSError as e:
            raise OSError(f"{e} If {self.repo_id} is on this machine, give its folder: --dataset.root=...") from e
        return DatasetFrames(self._checked(meta), self.episodes)

    def of(self, known: np.ndarray, at_most: int) -> np.ndarray:
        """Those of the dataset's episodes that are named, or else the last ones, at most so many."""
        return np.unique(known)[-at_most:] if self.episodes is None else np.unique(self.episodes)

    def require_whole(self, verb: str, remedy: str) -> None:
        """Refuse `episodes` where a verb reads whole datasets.

        Raises:
            ValueError: with the remedy.
        """
        if self.episodes is not None:
            raise ValueError(f"--dataset.episodes: {verb} reads whole datasets; {remedy}")

    def _checked(self, meta: LeRobotDatasetMetadata) -> LeRobotDatasetMetadata:
        unknown = [e for e in self.episodes or [] if not 0 <= e < meta.total_episodes]
        if unknown or self.episodes == []:
            raise ValueError(
                f"--dataset.episodes is {self.episodes}; expected numbers of episodes of {self.repo_id}, "
                f"which are 0 to {meta.total_episodes - 1}"
            )
        return meta


CACHE_THEM = "cache those episodes: latentsafe cache --dataset.episodes=[...] writes a dataset that holds them alone"
"""The remedy of verbs that train."""


@dataclass
class OptionalDatasetSource(DatasetSource):
    """A LeRobotDataset, or none."""

    repo_id: str | None = None
    """Its id, such as me/bag."""


@dataclass
class NewDataset:
    """A LeRobotDataset that is to be recorded."""

    repo_id: str
    """Its id, such as me/bag."""
    root: Path | None = None
    """The folder to write; by default LeRobot's own for this id."""
    num_episodes: int | None = None
    """How many to record; by default 2,000 of the car, and as many of the Franka as the source says."""

    @property
    def folder(self) -> Path:
        """Where it is written."""
        return self.root or HF_LEROBOT_HOME / self.repo_id


@dataclass
class PolicySource:
    """A checkpoint."""

    path: str
    """A folder, a Hub id, or the name of a committed checkpoint (see `latentsafe path`)."""


@dataclass
class DefaultPolicySource(PolicySource):
    """A checkpoint, by default the committed filter of the car."""

    path: str = "dubins"
    """A folder, a Hub id, or the name of a committed checkpoint (see `latentsafe path`)."""


@dataclass
class OptionalPolicySource:
    """A checkpoint, or none."""

    path: str | None = None
    """A folder, a Hub id, or the name of a committed checkpoint (see `latentsafe path`)."""
