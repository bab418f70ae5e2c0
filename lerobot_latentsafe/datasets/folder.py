"""Datasets on this machine, opened after a look at their files: nothing is fetched, and no folder is made."""

from pathlib import Path

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.datasets.layout import check_layout
from lerobot_latentsafe.datasets.reading import reading


def load_metadata(repo_id: str, root: str | Path) -> LeRobotDatasetMetadata:
    """Metadata of a dataset in a folder.

    Raises:
        DatasetContractError: there is no such folder, it is no dataset of version 3, or a file is missing or broken.
    """
    root = Path(root)
    check_layout(root)
    with reading(root / "meta"):
        return LeRobotDatasetMetadata(repo_id, root=root)


def open_dataset(repo_id: str, root: str | Path | None) -> LeRobotDataset:
    """A dataset in a folder; without one, LeRobot's own of that id, which it may fetch.

    Raises:
        DatasetContractError: there is no such folder, it is no dataset of version 3, or a file is missing or broken.
    """
    if root is None:
        return LeRobotDataset(repo_id)
    check_layout(Path(root))
    with reading(Path(root)):
        return LeRobotDataset(repo_id, root=root)
