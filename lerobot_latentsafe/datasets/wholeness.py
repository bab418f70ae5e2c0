"""Is a dataset whole: are there all episodes, frames and videos that its metadata promise? Nothing is decoded here."""

from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import av
import numpy as np

from lerobot_latentsafe.datasets.layout import EPISODES, INFO
from lerobot_latentsafe.datasets.reading import DOWNLOAD_AGAIN, BrokenFileError, DatasetContractError, reading, some

if TYPE_CHECKING:  # the package imports this module, and LeRobot's datasets are heavy
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata


def check_order(meta: "LeRobotDatasetMetadata", index: np.ndarray, episode: np.ndarray) -> None:
    """Refuse frames that do not lie where the metadata say.

    Args:
        index, episode: (N,) of the frames, in the order of the index.

    Raises:
        DatasetContractError: with the remedy.
    """
    if len(index) != meta.total_frames:
        raise DatasetContractError(
            f"{meta.root} holds {len(index)} frames on disk, {meta.total_frames} by its {INFO}; {DOWNLOAD_AGAIN}"
        )
    if not np.array_equal(index, np.arange(len(index))) or (np.diff(episode) < 0).any():
        raise DatasetContractError(
            f"the columns index and episode_index of {meta.root / 'data'} must count up from 0, each index once; "
            f"{DOWNLOAD_AGAIN}, or convert it again"
        )
    first = np.searchsorted(episode, np.asarray(meta.episodes["episode_index"]))
    moved = np.flatnonzero(first != np.asarray(meta.episodes["dataset_from_index"])).tolist()
    if moved:
        raise DatasetContractError(
            f"{meta.root / EPISODES} says that episodes {some(moved)} begin elsewhere than in data/; {DOWNLOAD_AGAIN}, "
            "or convert it again"
        )


def check_videos(meta: "LeRobotDatasetMetadata", cameras: dict[str, tuple[int, int, int]]) -> None:
    """Refuse videos that are missing, cut off before the last frame of an episode in them, or of another size.

    Args:
        cameras: key -> (C, H, W) of those that are videos.

    Raises:
        DatasetContractError: naming the video.
    """
    for camera, (_, height, width) in cameras.items():
        ends: dict[Path, tuple[float, int]] = {}
        places = [f"videos/{camera}/{name}" for name in ("chunk_index", "file_index", "to_timestamp")]
        if missing := [place for place in places if place not in meta.episodes.column_names]:
            raise BrokenFileError(f"{meta.root / EPISODES} lacks the columns {', '.join(missing)}; {DOWNLOAD_AGAIN}")
        for episode, chunk, file, end in zip(meta.episodes["episode_index"], *(meta.episodes[p] for p in places)):
            path = meta.root / meta.info.video_path.format(video_key=camera, chunk_index=chunk, file_index=file)
            ends[path] = max(ends.get(path, (0.0, 0)), (float(end), episode))
        for path, (end, episode) in ends.items():
            if not path.exists():
                raise BrokenFileError(
                    f"{path} is missing, the video of {camera} with episode {episode}; {DOWNLOAD_AGAIN}, or leave the "
                    "camera out with lerobot-edit-dataset --operation.type=remove_feature"
                )
            with reading(path):
                check_video(path, end - 1.5 / float(meta.fps), (height, width))


def check_video(path: Path, since: float, size: tuple[int, int]) -> None:
    """Refuse a video that ends before a time in seconds, or is of another (height, width); only its end is read.

    Raises:
        DatasetContractError: naming what was expected.
    """
    with av.open(path) as container:
        if not container.streams.video:
            raise BrokenFileError(f"{path} holds no video; {DOWNLOAD_AGAIN}")
        stream = container.streams.video[0]
        require_size(str(path), (stream.height, stream.width), size)
        container.seek(int(max(since, 0.0) / (stream.time_base or Fraction(1, 1000))), stream=stream)
        times = [float(p.pts * p.time_base) for p in container.demux(stream) if p.pts is not None and p.size]
    if not times or max(times) < since:
        raise BrokenFileError(
            f"{path} is cut off: it has no frame after {since:.2f} s, where its episodes' last ones should be; "
            f"{DOWNLOAD_AGAIN}"
        )


def require_size(what: str, found: tuple[int, int], promised: tuple[int, int]) -> None:
    """Refuse pictures of another (height, width) than a dataset's info gives.

    Raises:
        DatasetContractError: naming both.
    """
    if found != promised:
        raise DatasetContractError(
            f"the pictures of {what} have {found[0]} x {found[1]} pixels (height x width), {promised[0]} x "
            f"{promised[1]} by {INFO}; correct the shape there"
        )
