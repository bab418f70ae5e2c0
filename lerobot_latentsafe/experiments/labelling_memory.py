"""What the labelling page and `latentsafe cache` take in memory, on a short and on a long episode."""

import multiprocessing
import resource
import sys
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path

import cv2
import numpy as np
import psutil
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.datasets.build_cache import build_frame_cache
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.labeling.app import PIECE

REPO_ID, CAMERA = "bench/long", "observation.images.front"


def film_one(root: Path, seconds: float, height: int, width: int, fps: int, seed: int = 0) -> None:
    """Record one episode of one camera, with as much detail as a picture of a room."""
    names = ["x.pos", "y.pos"]
    features = {key: {"dtype": "float32", "shape": (2,), "names": names} for key in ("observation.state", "action")}
    features[CAMERA] = {"dtype": "video", "shape": (height, width, 3), "names": ["height", "width", "channels"]}
    dataset = LeRobotDataset.create(
        REPO_ID, fps, features, root=root, streaming_encoding=True, encoder_queue_maxsize=round(seconds * fps),
        rgb_encoder=RGBEncoderConfig(vcodec="h264", preset="ultrafast"),
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    room = cv2.GaussianBlur(rng.integers(0, 256, (height, width, 3), np.uint8), (0, 0), 2)
    room = cv2.normalize(room, None, 0, 255, cv2.NORM_MINMAX)
    for t in range(round(seconds * fps)):
        place = np.array([t, -t], np.float32)
        image = np.roll(room, (t, 2 * t), (0, 1))
        dataset.add_frame({CAMERA: image, "observation.state": place, "action": place, "task": "look around"})
    dataset.save_episode()
    dataset.finalize()


def look_through(root: Path) -> None:
    """Ask for all frames as the page does, piece after piece."""
    frames = DatasetFrames(LeRobotDatasetMetadata(REPO_ID, root=root))
    length = frames.length(0)
    for first in range(0, length, PIECE):
        frames.encoded(CAMERA, 0, range(first, min(first + PIECE, length)))


def cache(root: Path) -> None:
    """Build a cache of pictures."""
    with tempfile.TemporaryDirectory() as folder:
        build_frame_cache(LeRobotDataset(REPO_ID, root=root), Path(folder) / "cache", 128)


USES = {"page": look_through, "cache": cache}


def grown(use: str, root: Path) -> dict[str, float]:
    """What a use takes in a fresh process: megabytes above what the imports took, and seconds."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_measure, args=(use, root, sender))
    process.start()
    sender.close()
    found = receiver.recv()
    process.join()
    return found


def _measure(use: str, root: Path, sender: Connection) -> None:
    before, started = psutil.Process().memory_info().rss, time.perf_counter()
    USES[use](root)
    unit = 1 if sys.platform == "darwin" else 1024
    peak = unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    sender.send({"mb": round((peak - before) / 1e6, 1), "seconds": round(time.perf_counter() - started, 2)})
