"""The layout of a dataset's folder: is it LeRobot's, of the right version, and is each file of tables readable?

This looks at files alone, so that it can be asked before LeRobot opens the dataset; LeRobot takes whatever it does not
find for something to fetch from the Hub.
"""

import json
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from lerobot_latentsafe.datasets.paths import check_paths
from lerobot_latentsafe.datasets.reading import DOWNLOAD_AGAIN, BrokenFileError, DatasetContractError, reading, some

INFO, STATISTICS, TASKS, EPISODES = "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/episodes"
NO_STATISTICS = (
    "give lerobot-train --dataset.use_imagenet_stats=false, as a filter needs no statistics; or run latentsafe cache "
    "and train on that"
)
CONVERTER = "python -m lerobot.scripts.convert_dataset_v21_to_v30"


def check_layout(root: Path) -> dict[str, Any]:
    """The content of a dataset's `meta/info.json`, once all files of tables are found readable.

    Raises:
        DatasetContractError: no folder, no dataset of version 3, one that is empty, or one that names files elsewhere.
        BrokenFileError: a file that is missing, cut or damaged.
    """
    info = _read_info(root)
    if info.get("total_tasks") and not (root / TASKS).exists():
        raise BrokenFileError(f"{root / TASKS} is missing, which lists the tasks; {DOWNLOAD_AGAIN}")
    for table in ([TASKS], [EPISODES, "*/*.parquet"], ["data", "*/*.parquet"]):
        _check_readable(root.glob("/".join(table)))
    check_paths(root, info)
    _check_episodes(root, info["total_episodes"])
    if (root / STATISTICS).exists():
        with reading(root / STATISTICS, f"delete it, and {NO_STATISTICS}"):
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


def _check_readable(files: Iterable[Path]) -> None:
    """Refuse a parquet file without its end, which is what is missing of one that was cut off."""
    for file in files:
        with reading(file):
            pq.read_metadata(file)


def _check_episodes(root: Path, n: int) -> None:
    """Refuse a dataset that lacks an episode, or frames of one."""
    listed = _columns(root, EPISODES, ["episode_index", "length"])
    found = Counter(_columns(root, "data", ["episode_index"])["episode_index"])
    lengths = dict(zip(listed["episode_index"], listed["length"]))
    unlisted = sorted({*range(n)} - {*lengths})
    if unlisted or len(listed["length"]) != n:
        raise BrokenFileError(
            f"{root / EPISODES} lists {len(listed['length'])} episodes, {n} by total_episodes of {INFO}: "
            f"{some(unlisted) or 'none'} missing; {DOWNLOAD_AGAIN}"
        )
    torn = [e for e in sorted({*lengths} | {*found}) if lengths.get(e, 0) != found[e]]
    if torn:
        e = torn[0]
        raise BrokenFileError(
            f"{root / 'data'} holds {found[e]} frames of episode {e}, {lengths.get(e, 0)} by {EPISODES}; episodes that "
            f"do not fit: {some(torn)}. Please {DOWNLOAD_AGAIN}"
        )


def _columns(root: Path, folder: str, names: list[str]) -> dict[str, list]:
    """Columns of all files of a folder."""
    columns: dict[str, list] = {name: [] for name in names}
    for file in sorted(root.glob(f"{folder}/*/*.parquet")):
        with reading(file):
            table = pq.ParquetFile(file).read(columns=names)
            for name in names:
                columns[name] += table[name].to_pylist()
    return columns


def check_for_lerobot(root: Path, imagenet_statistics: bool) -> None:
    """Refuse a dataset on which lerobot-train would end in an error of its own.

    Args:
        imagenet_statistics: whether it writes those of ImageNet over the dataset's.

    Raises:
        DatasetContractError: with the remedy.
    """
    info = check_layout(root)
    cameras = [key for key, feature in info["features"].items() if feature["dtype"] in ("image", "video")]
    if imagenet_statistics and lacks_statistics(root, cameras):
        raise DatasetContractError(
            f"{root / STATISTICS} is missing or lacks a camera, and lerobot-train would write ImageNet's there; "
            f"{NO_STATISTICS}"
        )
    for key in cameras:
        if len(info["features"][key].get("names") or []) != 3:
            raise DatasetContractError(
                f'{key} does not name its axes in {root / INFO}, which lerobot-train wants: write "names": ["height", '
                '"width", "channels"] there, or run latentsafe cache and train on that'
            )
        if info["features"][key]["dtype"] == "video" and not any(root.glob(f"videos/{key}/*/*.mp4")):
            raise BrokenFileError(f"{root / 'videos' / key} holds no video; {DOWNLOAD_AGAIN}")


def lacks_statistics(root: Path, cameras: Iterable[str]) -> bool:
    """Whether a dataset has no statistics of one of its cameras."""
    path = root / STATISTICS
    known = json.loads(path.read_text()) if path.exists() else {}
    return any(key not in known for key in cameras)
