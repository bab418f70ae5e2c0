"""Whole episodes of a dataset, camera by camera: what the page, the filter and automatic labellers look at."""

from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.video_utils import decode_video_frames

MAX_HEIGHT = 480
"""Rows of a frame sent to the page."""


class DatasetFrames:
    """Reads episodes from a dataset's own files, video or images, without decoding anything else.

    Args:
        meta: of the dataset.
        episodes: those that are meant; None: all.

    Attributes:
        episodes: their numbers, in order.

    Raises:
        ValueError: the dataset has no camera.
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

    def images(self, camera: str, episode: int) -> np.ndarray:
        """uint8 (T, H, W, 3), RGB."""
        if camera in self.meta.video_keys:
            return self._decode_video(camera, episode)
        return np.stack([_decode(blob) for blob in self._stored_images(camera, episode)])

    def encoded(self, camera: str, episode: int) -> list[bytes]:
        """A PNG or JPEG a frame, at most MAX_HEIGHT rows high."""
        height = self.meta.features[camera]["shape"][0]
        if camera not in self.meta.video_keys and height <= MAX_HEIGHT:
            return self._stored_images(camera, episode)
        return [_jpeg(image) for image in self.images(camera, episode)]

    def _table(self, episode: int, names: list[str]):
        row = self.meta.episodes[episode]
        inside = [("index", ">=", row["dataset_from_index"]), ("index", "<", row["dataset_to_index"])]
        file = self.root / self.meta.get_data_file_path(episode)
        return pq.read_table(file, columns=[*names, "index"], filters=inside).sort_by("index")

    def _stored_images(self, camera: str, episode: int) -> list[bytes]:
        stored = self._table(episode, [camera])[camera].to_pylist()
        return [image["bytes"] or (self.root / image["path"]).read_bytes() for image in stored]

    def _decode_video(self, camera: str, episode: int) -> np.ndarray:
        row, fps = self.meta.episodes[episode], self.meta.fps
        times = row[f"videos/{camera}/from_timestamp"] + np.arange(row["length"]) / fps
        path = self.root / self.meta.get_video_file_path(episode, camera)
        frames = decode_video_frames(path, times.tolist(), 0.5 / fps, backend="pyav", return_uint8=True)
        return frames.permute(0, 2, 3, 1).numpy()


def _decode(blob: bytes) -> np.ndarray:
    return cv2.cvtColor(cv2.imdecode(np.frombuffer(blob, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def _jpeg(image: np.ndarray) -> bytes:
    height, width = image.shape[:2]
    if height > MAX_HEIGHT:
        size = (round(width * MAX_HEIGHT / height), MAX_HEIGHT)
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes()
