"""A dataset's files name other files: none of these lies outside of the dataset's folder.

Otherwise a dataset that somebody shares could show, or send to a vision-language model, any file of this machine.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import pyarrow.compute as pc
import pyarrow.parquet as pq

from lerobot_latentsafe.datasets.reading import BrokenFileError, DatasetContractError, reading

BLOBS = "blobs"
"""Beside the snapshots of the Hub's cache, whose files are links to there."""


def leads_out(path: str) -> bool:
    """Whether a path is absolute, has a drive, or goes up, on any system."""
    windows, posix = PureWindowsPath(path), PurePosixPath(path)
    return bool(windows.anchor or windows.drive or posix.anchor) or ".." in (*windows.parts, *posix.parts)


def inside_dataset(root: Path, path: str) -> Path:
    """The file of a dataset's folder that a file of it names.

    Raises:
        DatasetContractError: it lies, or is a link to, elsewhere.
    """
    file, home = root / path, root.resolve()
    allowed = [home, home.parents[1] / BLOBS] if home.parent.name == "snapshots" else [home]
    if leads_out(path) or not any(file.resolve().is_relative_to(place) for place in allowed):
        raise DatasetContractError(
            f"{root} names the file {path}, which is not in that folder. A dataset may show what lies in it alone; if "
            "it is yours, embed its pictures (LeRobot's to_parquet_with_hf_images does), else do not use it"
        )
    return file


def stored_picture_bytes(root: Path, stored: Mapping[str, Any] | None) -> bytes:
    """The encoded picture of an entry of a dataset's table.

    Args:
        stored: bytes, or a path inside of the dataset's folder.

    Raises:
        DatasetContractError: the path leads elsewhere.
        BrokenFileError: there is no picture.
    """
    stored = stored or {}
    if stored.get("bytes"):
        return stored["bytes"]
    if not stored.get("path"):
        raise BrokenFileError(f"{root / 'data'} has an entry without a picture; download or copy the dataset again")
    file = inside_dataset(root, stored["path"])
    with reading(file):
        return file.read_bytes()


def check_paths(root: Path, info: Mapping[str, Any]) -> None:
    """Refuse a dataset that names files outside of its folder.

    Args:
        info: data_path, video_path and features, as in `meta/info.json`.

    Raises:
        DatasetContractError: naming the path.
    """
    for path in (info.get("data_path"), info.get("video_path"), *info["features"]):
        if path:
            inside_dataset(root, str(path))
    pictures = [key for key, feature in info["features"].items() if feature["dtype"] == "image"]
    for file in sorted(root.glob("data/*/*.parquet")) if pictures else []:
        with reading(file):
            for path in _paths_without_bytes(file, pictures):
                inside_dataset(root, path)


def _paths_without_bytes(file: Path, cameras: list[str]) -> Iterator[str]:
    """Paths of a table that would be opened; pictures that are embedded have one, too, and it means nothing."""
    table = pq.ParquetFile(file)
    for camera in (c for c in cameras if c in table.schema_arrow.names):
        paths = pc.struct_field(table.read(columns=[f"{camera}.path"])[camera], "path").unique().to_pylist()
        if any(path and leads_out(path) for path in paths):
            stored = table.read(columns=[camera])[camera]
            empty = pc.is_null(pc.struct_field(stored, "bytes"))
            yield from filter(None, pc.struct_field(stored.filter(empty), "path").unique().to_pylist())
