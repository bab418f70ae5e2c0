"""Is a dataset whole: are there all episodes, frames and videos that its metadata promise? Nothing is decoded here."""

from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import av
import numpy as np

from lerobot_latentsafe.datasets.layout import EPISODES, INFO
from lerobot_latentsafe.datasets.reading import DOWNLOAD_AGAIN, BrokenFileError, DatasetContractError, reading

if TYPE_CHECKING:  # the package imports this module, and LeRobot's datasets are heavy
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata


def check_episodes(meta: "LeRobotDatasetMetadata", index: np.ndarray, episode: np.ndarray) -> None:
    """Refuse a dataset that lacks episodes or frames that its metadata promise.

    Args:
        index, episode: (N,) of the frames that were found, in the order of the index.

    Raises:
        DatasetContractError: naming the episodes.
    """
    listed = np.asarray(meta.episodes["episode_index"])
    unlisted = sorted({*range(meta.total_episodes)} - {*listed.tolist()})
    if unlisted or len(listed) != meta.total_episodes:
        raise DatasetContractError(
            f"{meta.root / EPISODES} lists {len(listed)} episodes, {INFO} counts {meta.total_episodes}: "
            f"{some(unlisted) or 'some'} are missing; {DOWNLOAD_AGAIN}"
        )
    lengths = dict(zip(listed.tolist(), meta.episodes["length"]))
    found = dict(zip(*(values.tolist() for values in np.unique(episode, return_counts=True))))
    torn = [e for e in sorted({*lengths} | {*found}) if lengths.get(e) != found.get(e)]
    if torn:
        e = torn[0]
        raise DatasetContractError(
            f"{meta.root / 'data'} holds {found.get(e, 0)} frames of episode {e}, expected {lengths.get(e, 0)}; "
            f"episodes that do not fit: {some(torn)}. Please {DOWNLOAD_AGAIN}"
        )
    if len(index) != meta.total_frames:
        raise DatasetContractError(
            f"{meta.root} holds {len(index)} frames on disk, {meta.total_frames} by its {INFO}; {DOWNLOAD_AGAIN}"
        )
    if not np.array_equal(index, np.arange(len(index))) or (np.diff(episode) < 0).any():
        raise DatasetContractError(
            f"the columns index and episode_index of {meta.root / 'data'} must count up from 0, each index once; "
            f"{DOWNLOAD_AGAIN}, or convert it again"
        )
    first = np.searchsorted(episode, listed)
    moved = listed[first != np.asarray(meta.episodes["dataset_from_index"])].tolist()
    if moved:
        raise DatasetContractError(
            f"{meta.root / EPISODES} says that episodes {some(moved)} begin elsewhere than in data/; {DOWNLOAD_AGAIN}, "
            "or convert it again"
        )


def some(numbers: list) -> str:
    """The first ten of a list, in words."""
    return ", ".join(str(n) for n in numbers[:10]) + (f" and {len(numbers) - 10} more" if len(numbers) > 10 else "")


def check_videos(meta: "LeRobotDatasetMetadata", cameras: list[str]) -> None:
    """Refuse videos that are missing, cut, or cut off before the last frame of an episode in them.

    Raises:
        BrokenFileError: naming the video and an episode in it.
    """
    for camera in cameras:
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
                check_video_end(path, end - 1.5 / float(meta.fps))


def check_video_end(path: Path, since: float) -> None:
    """Refuse a video whose packets end before a time in seconds; only its last packets are read.

    Raises:
        BrokenFileError: naming the file and the time.
    """
    with av.open(path) as container:
        if not container.streams.video:
            raise BrokenFileError(f"{path} holds no video; {DOWNLOAD_AGAIN}")
        stream = container.streams.video[0]
        container.seek(int(max(since, 0.0) / (stream.time_base or Fraction(1, 1000))), stream=stream)
        times = [float(p.pts * p.time_base) for p in container.demux(stream) if p.pts is not None and p.size]
    if not times or max(times) < since:
        raise BrokenFileError(
            f"{path} is cut off: it has no frame after {since:.2f} s, where its episodes' last ones should be; "
            f"{DOWNLOAD_AGAIN}"
        )
