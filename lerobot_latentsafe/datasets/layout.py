"""The layout of a dataset's folder: is it LeRobot's, of the right version, and is each file of tables readable?

This looks at files alone, so that it can be asked before LeRobot opens the dataset; LeRobot takes whatever it does not
find for something to fetch from the Hub.
"""

import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from lerobot_latentsafe.datasets.reading import DOWNLOAD_AGAIN, BrokenFileError, DatasetContractError, reading

INFO, STATISTICS, TASKS, EPISODES = "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/episodes"
CONVERTER = "python -m lerobot.scripts.convert_dataset_v21_to_v30"


def check_layout(root: Path) -> dict[str, Any]:
    """The content of a dataset's `meta/info.json`, once all files of tables are found readable.

    Raises:
        DatasetContractError: no folder, no dataset of version 3, or one that is empty.
        BrokenFileError: a file that is missing, cut or damaged.
    """
    info = _read_info(root)
    if info.get("total_tasks") and not (root / TASKS).exists():
        raise BrokenFileError(f"{root / TASKS} is missing, which lists the tasks; {DOWNLOAD_AGAIN}")
    _rows(root, root.glob(TASKS))
    episodes, frames = (_rows(root, root.glob(f"{folder}/*/*.parquet")) for folder in (EPISODES, "data"))
    for folder, found, what in ((EPISODES, episodes, "total_episodes"), ("data", frames, "total_frames")):
        if found != info[what]:
            raise BrokenFileError(
                f"{root / folder} holds {found} rows, {info[what]} by {what} of {INFO}: files are missing, or are of "
                f"another recording; {DOWNLOAD_AGAIN}"
            )
    if (root / STATISTICS).exists():
        with reading(
            root / STATISTICS, "delete it: lerobot-edit-dataset --operation.type=recompute_stats makes another"
        ):
            json.loads((root / STATISTICS).read_text())
    return info


def _read_info(root: Path) -> dict[str, Any]:
    path = root / INFO
    if not root.is_dir():
        raise DatasetContractError(
            f"there is no folder {root}; --dataset.root must be the folder of a LeRobotDataset, which holds {INFO}"
        )
    if not path.exists():
        raise DatasetContractError(
            f"{root} is no LeRobotDataset: it has no {INFO}. Give the folder that holds meta/ and data/ as "
            f"--dataset.root, or {DOWNLOAD_AGAIN}"
        )
    with reading(path):
        info = json.loads(path.read_text())
        version, features, fps = str(info["codebase_version"]), info["features"], info["fps"]
    if not version.lstrip("v").startswith("3."):
        raise DatasetContractError(
            f"{root} is in LeRobot's format {version}, expected v3.0; convert a copy of it with {CONVERTER} "
            f"--repo-id=<id> --root={root} --push-to-hub=false"
        )
    if not isinstance(fps, int | float) or not fps > 0:
        raise DatasetContractError(f"fps is {fps!r} in {path}; expected frames a second, such as 30. Correct it there")
    for feature, described in features.items():
        if missing := [entry for entry in ("dtype", "shape") if entry not in described]:
            raise DatasetContractError(f"{path} does not say the {' and '.join(missing)} of {feature}; add it there")
    if not info.get("total_episodes") or not info.get("total_frames"):
        raise DatasetContractError(f"{root} is empty: by its {INFO} it has no episode. Record some, or give another")
    return info


def _rows(root: Path, files: Any) -> int:
    """Rows of parquet files together; only their ends are read."""
    rows = 0
    for file in files:
        with reading(file):
            rows += pq.read_metadata(file).num_rows
    return rows


def check_for_lerobot(root: Path, imagenet_statistics: bool) -> None:
    """Refuse a dataset on which lerobot-train would end in an error of its own.

    Args:
        imagenet_statistics: whether it writes those of ImageNet over the dataset's.

    Raises:
        DatasetContractError: with the remedy.
    """
    info = check_layout(root)
    cameras = [key for key, feature in info["features"].items() if feature["dtype"] in ("image", "video")]
    if cameras and imagenet_statistics and not (root / STATISTICS).exists():
        raise DatasetContractError(
            f"{root / STATISTICS} is missing, which lerobot-train writes to. Give --dataset.use_imagenet_stats=false, as "
            "a filter needs no statistics of pictures; or run latentsafe cache and train on that"
        )
    for key in cameras:
        if len(info["features"][key].get("names") or []) != 3:
            raise DatasetContractError(
                f'{key} does not name its axes in {root / INFO}, which lerobot-train wants: write "names": ["height", '
                '"width", "channels"] there, or run latentsafe cache and train on that'
            )
        if info["features"][key]["dtype"] == "video" and not any(root.glob(f"videos/{key}/*/*.mp4")):
            raise BrokenFileError(f"{root / 'videos' / key} holds no video; {DOWNLOAD_AGAIN}")
