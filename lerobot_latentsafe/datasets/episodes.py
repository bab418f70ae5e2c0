"""Whole episodes of a dataset, camera by camera: what the page, the filter and automatic labellers look at."""

from collections.abc import Iterator, Sequence
from itertools import batched
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_latentsafe.datasets.paths import check_paths, stored_picture_bytes
from lerobot_latentsafe.datasets.video_frames import video_frames

MAX_HEIGHT = 480
"""Rows of a frame sent to the page."""
AT_ONCE = 8
"""Frames of each camera that are held together while an episode runs through."""


class DatasetFrames:
    """Reads episodes from a dataset's own files, video or images, without decoding anything else.

    Args:
        meta: of the dataset.
        episodes: those that are meant; None: all.

    Attributes:
        episodes: their numbers, in order.

    Raises:
        ValueError: the dataset has no camera, or names files outside of its folder.
        FileNotFoundError: a file of an episode is missing.
    """

    def __init__(self, meta: LeRobotDatasetMetadata, episodes: list[int] | None = None):
        self.meta, self.root = meta, Path(meta.root)
        self.episodes = sorted({*range(meta.total_episodes)} if episodes is None else {*episodes})
        self.cameras = [k for k in meta.camera_keys if k not in meta.depth_keys]
        if not self.cameras:
            raise ValueError(
                f"{meta.repo_id} has no video and no images to look at; its features are {', '.join(meta.features)}. "
                "A copy made by latentsafe cache has none: label the dataset it was made from, then cache again"
            )
        paths = {"data_path": meta.data_path, "video_path": meta.video_path, "features": meta.features}
        check_paths(self.root, paths)
        self._check_files()

    def _check_files(self) -> None:
        files: dict[Path, int] = {}
        for episode in self.episodes:
            files.setdefault(self.root / self.meta.get_data_file_path(episode), episode)
            for camera in set(self.cameras) & set(self.meta.video_keys):
                files.setdefault(self.root / self.meta.get_video_file_path(episode, camera), episode)
        for file, episode in files.items():
            if not file.exists():
                raise FileNotFoundError(
                    f"{file} is missing, which holds episode {episode} of {self.meta.repo_id}; download or copy the "
                    "whole dataset. Nothing was changed"
                )

    def columns(self, episode: int, names: list[str]) -> dict[str, np.ndarray]:
        """Numbers of an episode: name -> (T,) or (T, D)."""
        table = self._table(episode, names)
        return {name: np.array(table[name].to_pylist()) for name in names}

    def length(self, episode: int) -> int:
        """How many frames an episode has."""
        return self.meta.episodes[episode]["length"]

    def stream(self, camera: str, episode: int, numbers: Sequence[int] | None = None) -> Iterator[np.ndarray]:
        """Frames of an episode one after the other, uint8 (H, W, 3), RGB: a long one needs no more memory than a short.

        Args:
            numbers: those that are wanted, ascending from 0; None: all.

        Raises:
            FrameTimestampError: the video has no frame at the time of one.
        """
        numbers = range(self.length(episode)) if numbers is None else numbers
        if camera in self.meta.video_keys:
            return self._video(camera, episode, numbers)
        return map(_decode, self._stored_images(camera, episode, numbers))

    def pieces(
        self, cameras: Sequence[str], episode: int, numbers: Sequence[int] | None = None
    ) -> Iterator[dict[str, Tensor]]:
        """The same of several cameras, AT_ONCE frames after AT_ONCE: camera -> uint8 (n, 3, H, W)."""
        side_by_side = zip(*(self.stream(camera, episode, numbers) for camera in cameras), strict=True)
        for part in batched(side_by_side, AT_ONCE):
            stacks = (torch.from_numpy(np.stack(images)) for images in zip(*part))
            yield {camera: stack.permute(0, 3, 1, 2) for camera, stack in zip(cameras, stacks)}

    def images(self, camera: str, episode: int) -> np.ndarray:
        """All frames of an episode at once, uint8 (T, H, W, 3), RGB; `stream` does without so much memory."""
        frames = self.stream(camera, episode)
        first = next(frames)
        whole = np.empty((self.length(episode), *first.shape), np.uint8)
        whole[0] = first
        for t, image in enumerate(frames, 1):
            whole[t] = image
        return whole

    def encoded(self, camera: str, episode: int, numbers: Sequence[int] | None = None) -> list[bytes]:
        """A PNG or JPEG a frame, at most MAX_HEIGHT rows high; of those that are wanted, as in `stream`."""
        height = self.meta.features[camera]["shape"][0]
        if camera not in self.meta.video_keys and height <= MAX_HEIGHT:
            wanted = range(self.length(episode)) if numbers is None else numbers
            return list(self._stored_images(camera, episode, wanted))
        return [_jpeg(image) for image in self.stream(camera, episode, numbers)]

    def _table(self, episode: int, names: list[str]):
        row = self.meta.episodes[episode]
        inside = [("index", ">=", row["dataset_from_index"]), ("index", "<", row["dataset_to_index"])]
        file = self.root / self.meta.get_data_file_path(episode)
        return pq.read_table(file, columns=[*names, "index"], filters=inside).sort_by("index")

    def _stored_images(self, camera: str, episode: int, numbers: Sequence[int]) -> Iterator[bytes]:
        path = self.root / self.meta.get_data_file_path(episode)
        start = self.meta.episodes[episode]["dataset_from_index"]
        wanted = iter([start + number for number in numbers])
        file, awaited = pq.ParquetFile(path), next(wanted, None)
        end, every = start + self.length(episode), range(file.num_row_groups)
        groups = [group for group in every if _may_hold(file.metadata.row_group(group), start, end)]
        for batch in file.iter_batches(AT_ONCE, row_groups=groups, columns=["index", camera]):
            for place, index in enumerate(batch["index"].to_pylist()):
                if index == awaited:
                    image, awaited = batch[camera][place].as_py(), next(wanted, None)
                    yield stored_picture_bytes(self.root, image)
        if awaited is not None:
            raise ValueError(
                f"{path} lacks frame {awaited} of {self.meta.repo_id}, or holds its frames in another order than that "
                "of their index; download or convert the dataset again"
            )

    def _video(self, camera: str, episode: int, numbers: Sequence[int]) -> Iterator[np.ndarray]:
        row, fps = self.meta.episodes[episode], self.meta.fps
        times = row[f"videos/{camera}/from_timestamp"] + np.asarray(numbers) / fps
        return video_frames(self.root / self.meta.get_video_file_path(episode, camera), times.tolist(), 0.5 / fps)


def _may_hold(group: pq.RowGroupMetaData, start: int, end: int) -> bool:
    """Whether a row group may hold frames of an episode, as far as is written in it."""
    columns = (group.column(i) for i in range(group.num_columns))
    known = next(column.statistics for column in columns if column.path_in_schema == "index")
    return known is None or not known.has_min_max or (known.min < end and known.max >= start)


def _decode(blob: bytes) -> np.ndarray:
    return cv2.cvtColor(cv2.imdecode(np.frombuffer(blob, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def shrunk(image: np.ndarray, rows: int) -> np.ndarray:
    """A picture (H, W, 3) with at most so many rows, in the same proportions."""
    height, width = image.shape[:2]
    if height <= rows:
        return image
    return cv2.resize(image, (round(width * rows / height), rows), interpolation=cv2.INTER_AREA)


def _jpeg(image: np.ndarray) -> bytes:
    image = shrunk(image, MAX_HEIGHT)
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes()
