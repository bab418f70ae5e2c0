"""Where label files lie: beside their dataset, or in LeRobot's home where its folder is no place to keep them.

A snapshot of the Hub's cache belongs to one commit, and is left behind at the next. Labels are a person's work: those
of such a dataset, and of one whose folder cannot be written, lie in `$HF_LEROBOT_HOME/labels/<repo_id>`.
"""

import os
import re
from pathlib import Path

from lerobot.utils import constants

FOLDER = "labels"
NAME = re.compile(r"(?!action|observation|index|episode|frame|task|timestamp|next)[a-z][a-z0-9_]{0,39}")
"""Names of specifications: a file and a column, and none that LeRobot would hand to a policy."""


class UnlabelledDatasetError(ValueError):
    """The dataset has no usable failure labels."""


class LabelFileError(UnlabelledDatasetError):
    """A label file of another dataset, of another schema, or with values that are no labels."""


def label_folders(root: str | Path, repo_id: str | None = None) -> list[Path]:
    """Folders in which labels of a dataset may lie; new ones go to the first.

    Args:
        root: the dataset's folder.
        repo_id: its id, where that is known; of a folder in the Hub's cache it always is.
    """
    root = Path(root).absolute()
    beside, cached = root / FOLDER, _repo_of_snapshot(root)
    if cached:
        others = (folder for folder in root.parent.glob(f"*/{FOLDER}") if folder != beside)
        return [_home(cached), beside, *sorted(others, key=lambda folder: folder.stat().st_mtime, reverse=True)]
    if repo_id is None:
        return [beside]
    writable = os.access(beside if beside.exists() else root, os.W_OK)
    return [beside, _home(repo_id)] if writable else [_home(repo_id), beside]


def sidecar_path(root: str | Path, specification: str, repo_id: str | None = None) -> Path:
    """The file that new labels of a dataset go to: `labels/<specification>.parquet`, beside it or in LeRobot's home.

    Raises:
        LabelFileError: the name is not fit for a file and a column.
    """
    if not NAME.fullmatch(specification):
        raise LabelFileError(
            f"specification name {specification!r} is not usable: expected lower-case letters, digits and _ (at most "
            "40, a letter first), such as failure or spilled, and no name that LeRobot gives columns of its own"
        )
    return label_folders(root, repo_id)[0] / f"{specification}.parquet"


def label_files(root: str | Path, specification: str, repo_id: str | None = None) -> list[Path]:
    """Files that exist of a specification: first where new labels go, and everywhere those that were kept aside."""
    own, found = sidecar_path(root, specification, repo_id), []
    for folder in label_folders(root, repo_id):
        found += [folder / own.name, *sorted(folder.glob(f"{specification}.*.parquet"))]
    return [file for file in found if file.is_file()]


def specifications_of(root: str | Path, repo_id: str | None = None) -> list[str]:
    """Names of the specifications that have a label file."""
    files = (file for folder in label_folders(root, repo_id) for file in folder.glob("*.parquet"))
    return sorted({file.stem for file in files if NAME.fullmatch(file.stem)})


def label_folders_nearby(root: str | Path) -> list[Path]:
    """Folders with labels of other datasets: of the neighbours of this one, and in LeRobot's home."""
    root = Path(root).absolute()
    near = [*root.parent.glob(f"*/{FOLDER}"), *(constants.HF_LEROBOT_HOME / FOLDER).glob("*/*")]
    return [folder for folder in sorted(near) if folder != root / FOLDER and folder.is_dir()]


def _home(repo_id: str) -> Path:
    return constants.HF_LEROBOT_HOME / FOLDER / repo_id


def _repo_of_snapshot(root: Path) -> str | None:
    """The id of a dataset in the Hub's cache, `datasets--<owner>--<name>/snapshots/<commit>`; None elsewhere."""
    kind, _, name = root.parent.parent.name.partition("--")
    if root.parent.name != "snapshots" or kind != "datasets":
        return None
    return name.replace("--", "/")
