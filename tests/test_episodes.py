"""Frames of episodes in pieces: the very frames that LeRobot gives, in memory that does not grow with an episode."""

import tracemalloc

import numpy as np
import pytest
import tiny
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.video_utils import FrameTimestampError, decode_video_frames

from lerobot_latentsafe.datasets.episodes import AT_ONCE, DatasetFrames
from lerobot_latentsafe.datasets.video_frames import video_frames

CAMERA, FPS = "observation.images.front", 10


def record(root, lengths, dtype="video", group=2, size=(48, 64)):
    """Episodes whose pictures all differ; `group`: pictures from one that can be decoded alone to the next."""
    features = {
        key: {"dtype": "float32", "shape": (2,), "names": ["x", "y"]} for key in ("observation.state", "action")
    }
    features[CAMERA] = {"dtype": dtype, "shape": (*size, 3), "names": ["height", "width", "channels"]}
    video = {"rgb_encoder": RGBEncoderConfig(vcodec="h264", g=group)} if dtype == "video" else {}
    data = LeRobotDataset.create(tiny.REPO_ID, FPS, features, root=root, use_videos=dtype == "video", **video)
    for e, length in enumerate(lengths):
        for t in range(length):
            image = np.full((*size, 3), 20 * e, np.uint8)
            image[:, : 1 + (7 * t) % size[1]] = 250 - t
            data.add_frame({CAMERA: image, "observation.state": np.full(2, t, "f4"), "action": np.full(2, e, "f4"),
                            "task": "look"})  # fmt: skip
        data.save_episode()
    data.finalize()
    return root


@pytest.fixture(scope="module", params=[("video", 2), ("video", 250), ("image", 2)], ids=lambda p: f"{p[0]}, {p[1]}")
def frames(request, tmp_path_factory):
    dtype, group = request.param
    return DatasetFrames(tiny.metadata(record(tmp_path_factory.mktemp("long") / "d", (5, 40, 12), dtype, group)))


def expected(frames, episode):
    """What LeRobot's own dataset gives."""
    data = LeRobotDataset(tiny.REPO_ID, root=frames.root, video_backend="pyav", return_uint8=True)
    row = frames.meta.episodes[episode]
    rows = range(row["dataset_from_index"], row["dataset_to_index"])
    images = np.stack([data[i][CAMERA].numpy().transpose(1, 2, 0) for i in rows])
    return images if images.dtype == np.uint8 else (images * 255).round().astype(np.uint8)


def test_frames_are_those_of_lerobot(frames):
    for episode in (0, 1, 2):
        whole = expected(frames, episode)
        assert np.array_equal(frames.images(CAMERA, episode), whole)
        for numbers in ([0], [len(whole) - 1], [1, 2, len(whole) - 2], range(0, len(whole), 3)):
            assert np.array_equal(np.stack([*frames.stream(CAMERA, episode, numbers)]), whole[list(numbers)])


def test_pieces_hold_few_frames_and_all_cameras(frames):
    pieces = [piece[CAMERA] for piece in frames.pieces([CAMERA], 1)]
    assert [len(piece) for piece in pieces] == [AT_ONCE] * 5
    together = np.concatenate([piece.permute(0, 2, 3, 1).numpy() for piece in pieces])
    assert np.array_equal(together, frames.images(CAMERA, 1))


@pytest.mark.parametrize("off", [0.0, 0.3, 0.49, 0.51, -0.49, -0.51])
def test_a_time_between_frames_is_judged_as_lerobot_judges_it(tmp_path, off):
    frames = DatasetFrames(tiny.metadata(record(tmp_path / "d", (6,))))
    path, times = frames.root / frames.meta.get_video_file_path(0, CAMERA), [(t + off) / FPS for t in (1, 2, 3)]
    try:
        theirs = decode_video_frames(path, times, 0.5 / FPS, backend="pyav", return_uint8=True)
    except FrameTimestampError:
        theirs = None
    if theirs is None:
        with pytest.raises(FrameTimestampError, match="has no frame within"):
            list(video_frames(path, times, 0.5 / FPS))
    else:
        assert np.array_equal(np.stack([*video_frames(path, times, 0.5 / FPS)]), theirs.permute(0, 2, 3, 1).numpy())


def test_a_video_that_ends_too_soon_is_a_message(frames):
    if CAMERA in frames.meta.video_keys:
        path = frames.root / frames.meta.get_video_file_path(0, CAMERA)
        with pytest.raises(FrameTimestampError, match="is the file whole"):
            list(video_frames(path, [100.0], 0.05))


def test_memory_does_not_grow_with_the_episode(tmp_path):
    frames = DatasetFrames(tiny.metadata(record(tmp_path / "d", (40, 200), size=(240, 320))))
    uses = {"pieces": lambda e: all(True for _ in frames.pieces([CAMERA], e)),
            "picked": lambda e: list(frames.stream(CAMERA, e, [0, 20, 39]))}  # fmt: skip
    for use in uses.values():
        peaks = []
        for episode in (0, 0, 1):  # once to load what is loaded once
            tracemalloc.start()
            use(episode)
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        assert peaks[2] < 1.2 * peaks[1]
