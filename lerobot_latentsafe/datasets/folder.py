"""A dataset's folder: is it one, of the right version, and are its metadata readable?"""

import json
from pathlib import Path

import pyarrow.parquet as pq
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_latentsafe.datasets.reading import DOWNLOAD_AGAIN, BrokenFileError, DatasetContractError, reading
from lerobot_latentsafe.datasets.wholeness import EPISODES, INFO

STATISTICS, TASKS = "meta/stats.json", "meta/tasks.parquet"
CONVERTER = "python -m lerobot.scripts.convert_dataset_v21_to_v30"


def check_folder(root: Path) -> None:
    """Refuse a folder that is no LeRobotDataset of version 3.

    Raises:
        DatasetContractError: naming the folder and what was expected.
    """
    if not root.is_dir():
        raise DatasetContractError(
            f"there is no folder {root}; --dataset.root must be the folder of a LeRobotDataset, which holds {INFO}"
        )
    info = root / INFO
    if not info.exists():
        raise DatasetContractError(
            f"{root} is no LeRobotDataset: it has no {INFO}. Give the folder that holds meta/ and data/ as "
            f"--dataset.root, or {DOWNLOAD_AGAIN}"
        )
    with reading(info):
        content = json.loads(info.read_text())
        version = str(content["codebase_version"])
    if not version.lstrip("v").startswith("3."):
        raise DatasetContractError(
            f"{root} is in LeRobot's format {version}, expected v3.0; convert a copy of it with {CONVERTER} "
            f"--repo-id=<id> --root={root} --push-to-hub=false"
        )
    with reading(info, "repair it"):
        for feature, described in content["features"].items():
            if missing := {"dtype", "shape"} - set(described):
                raise DatasetContractError(f"{info} does not say the {' and '.join(missing)} of {feature}; add it")
    if not content.get("total_episodes") or not content.get("total_frames"):
        raise DatasetContractError(f"{root} is empty: by its {INFO} it has no episode. Record some, or give another")


def load_metadata(repo_id: str, root: str | Path) -> LeRobotDatasetMetadata:
    """Metadata of a dataset on disk; nothing is fetched from the Hub.

    Raises:
        DatasetContractError: there is no such folder, it is no dataset of version 3, or a file is missing or broken.
    """
    root = Path(root)
    check_folder(root)
    files = sorted(root.glob(f"{EPISODES}/*/*.parquet"))
    if not files:
        raise BrokenFileError(f"{root} has no {EPISODES}/*/*.parquet, which list its episodes; {DOWNLOAD_AGAIN}")
    for file in files:
        with reading(file):
            pq.read_metadata(file)
    statistics = root / STATISTICS
    if statistics.exists():
        with reading(statistics, "delete it and run lerobot-edit-dataset --operation.type=recompute_stats"):
            json.loads(statistics.read_text())
    # What is missing LeRobot would look for on the Hub, under whatever name was given.
    tasks = root / TASKS
    if not tasks.exists():
        raise BrokenFileError(f"{tasks} is missing, which lists the tasks of {repo_id}; {DOWNLOAD_AGAIN}")
    with reading(root / "meta"):
        return LeRobotDatasetMetadata(repo_id, root=root)
