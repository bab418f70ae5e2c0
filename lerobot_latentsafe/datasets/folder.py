"""Metadata of a dataset on this machine."""

from pathlib import Path

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_latentsafe.datasets.layout import check_layout
from lerobot_latentsafe.datasets.reading import reading


def load_metadata(repo_id: str, root: str | Path) -> LeRobotDatasetMetadata:
    """Metadata of a dataset in a folder; nothing is fetched from the Hub.

    Raises:
        DatasetContractError: there is no such folder, it is no dataset of version 3, or a file is missing or broken.
    """
    root = Path(root)
    check_layout(root)
    with reading(root / "meta"):
        return LeRobotDatasetMetadata(repo_id, root=root)
