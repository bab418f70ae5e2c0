"""Options of datasets that several verbs share, in LeRobot's grammar: `--dataset.repo_id`; and what is there."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import CompatibilityError
from lerobot.utils.constants import HF_LEROBOT_HOME

from lerobot_latentsafe.cli.places import DatasetPlace
from lerobot_latentsafe.datasets.cameras import settled_cameras
from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.folder import load_metadata, open_dataset
from lerobot_latentsafe.datasets.layout import INFO
from lerobot_latentsafe.datasets.reading import DatasetContractError
from lerobot_latentsafe.runtime.options import require_at_least


@dataclass
class DatasetSource(DatasetPlace):
    """A LeRobotDataset that is read: its id, and its folder if it is not in LeRobot's home."""

    def metadata(self) -> LeRobotDatasetMetadata:
        """What is known of a dataset that was read and found fit; see `Contract`.

        Raises:
            DatasetContractError: there is no such dataset, or it cannot be used as it is.
            ValueError: `episodes` names one that it does not have.
        """
        return self.contract()[0]

    def opened(self) -> LeRobotDataset:
        """The whole dataset, after the same checks."""
        meta = self.metadata()
        return open_dataset(meta.repo_id, meta.root)

    def frames(self) -> DatasetFrames:
        """The dataset's pictures, after the same checks.

        Raises:
            ValueError: it has no camera.
        """
        if self.episodes is not None and self._folder() is None:  # of the Hub's dataset these episodes suffice
            meta = self._fetched()
            self._require_known_episodes(meta)
            cameras, left_out = settled_cameras(meta)
        else:
            meta, contract = self.contract()
            cameras, left_out = contract.cameras, contract.left_out
        if left_out and not cameras:
            raise ValueError(
                f"{meta.repo_id} has no pictures to look at: {', '.join(left_out)} are depth maps; record a "
                "camera that shows colours or grey"
            )
        frames = DatasetFrames(meta, self.episodes)
        frames.cameras = list(cameras)
        return frames

    def contract(self) -> tuple[LeRobotDatasetMetadata, Contract]:
        """Metadata of the dataset, and what it says of its robot."""
        meta = self.found()
        self._require_known_episodes(meta)
        return meta, Contract.read(meta)

    def found(self) -> LeRobotDatasetMetadata:
        """Metadata of the dataset, whose numbers and names are not checked."""
        folder = self._folder()
        return self._fetched() if folder is None else load_metadata(self._id, folder)

    @property
    def _id(self) -> str:
        if self.repo_id not in (None, DatasetSource.repo_id):
            return self.repo_id
        return f"local/{Path(self.root).name}" if self.root else DatasetSource.repo_id

    def _folder(self) -> Path | None:
        """Where the dataset lies on this machine; None: it must be fetched."""
        if self.root:
            return Path(self.root)
        own = HF_LEROBOT_HOME / self._id
        return own if (own / INFO).exists() else None

    def _fetched(self) -> LeRobotDatasetMetadata:
        if self._id == DatasetSource.repo_id:
            raise DatasetContractError(
                "which dataset? Give the folder of a LeRobotDataset with --dataset.root, or its id with "
                "--dataset.repo_id"
            )
        try:
            return LeRobotDataset(self._id, episodes=self.episodes).meta
        except (OSError, CompatibilityError, NotImplementedError) as e:
            raise DatasetContractError(
                f"{self._id} is not in {HF_LEROBOT_HOME / self._id}, and it cannot be fetched from the Hub: "
                f"{' '.join(str(e).split())} If it is on this machine, give its folder: --dataset.root=..."
            ) from e

    def _require_known_episodes(self, meta: LeRobotDatasetMetadata) -> None:
        unknown = [e for e in self.episodes or [] if not 0 <= e < meta.total_episodes]
        if unknown or self.episodes == []:
            raise ValueError(
                f"--dataset.episodes is {self.episodes}; expected numbers of episodes of {self._id}, "
                f"which are 0 to {meta.total_episodes - 1}"
            )

    def of(self, known: np.ndarray, at_most: int) -> np.ndarray:
        """Those of the dataset's episodes that are named, or else the last ones, at most so many."""
        return np.unique(known)[-at_most:] if self.episodes is None else np.unique(self.episodes)


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
    """How many to record; by default 2,000 of the car, and as many of the Franka and the SO-101 as the source says."""

    def __post_init__(self) -> None:
        require_at_least("--dataset.num_episodes", self.num_episodes, 1)

    @property
    def folder(self) -> Path:
        """Where it is written."""
        return self.root or HF_LEROBOT_HOME / self.repo_id
