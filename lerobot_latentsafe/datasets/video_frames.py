"""Frames of a video one after the other, in constant memory: those that LeRobot's `decode_video_frames` would give."""

from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import av
import numpy as np
from lerobot.datasets.video_utils import FrameTimestampError


def video_frames(path: str | Path, times: Sequence[float], tolerance_s: float) -> Iterator[np.ndarray]:
    """The frames nearest to some times, uint8 (H, W, 3), RGB.

    Args:
        times: seconds, ascending.
        tolerance_s: how far off a frame may be.

    Raises:
        FrameTimestampError: no frame is so near to one of the times.
    """
    with av.open(str(path)) as container, closing(_Reader(container)) as reader:
        for time in times:
            frame = reader.nearest(time)
            # Rounded as LeRobot rounds, so that the same frames are near enough.
            if frame is None or not abs(np.float32(time) - np.float32(frame.time)) < np.float32(tolerance_s):
                raise FrameTimestampError(
                    f"{path} has no frame within {tolerance_s:.4f} s of {time:.4f} s, the nearest is "
                    f"{'not there' if frame is None else f'at {frame.time:.4f} s'}; is the file whole, and are its "
                    "frames as far apart as the dataset's rate says?"
                )
            yield frame.to_ndarray(format="rgb24")


class _Reader:
    """Goes through a video, and skips what no time asks for where whole groups of pictures lie between."""

    def __init__(self, container: av.container.InputContainer):
        self.container, self.stream = container, container.streams.video[0]
        self.group = np.inf  # seconds between frames that can be decoded alone, as far as seen
        self.key: float | None = None
        self.before: av.VideoFrame | None = None
        self.after: av.VideoFrame | None = None
        self.frames: Iterator[av.VideoFrame] | None = None

    def nearest(self, time: float) -> av.VideoFrame | None:
        """Of the frames at and around a time; None after the end."""
        if self.frames is None or time - self.after.time > 2 * self.group:
            self._seek(time)
        while self.after is None or self.after.time < time:
            frame = next(self.frames, None)
            if frame is None:
                break
            self.before, self.after = self.after, frame
        near = (frame for frame in (self.before, self.after) if frame is not None)
        return min(near, key=lambda frame: abs(np.float32(time) - np.float32(frame.time)), default=None)

    def _seek(self, time: float) -> None:
        ticks = round(time / self.stream.time_base) - 1
        self.container.seek(ticks, backward=True, any_frame=False, stream=self.stream)
        self.before = self.after = self.key = None
        self.frames = self._decoded()

    def close(self) -> None:
        """Let go of the frames: a reader and what it decodes hold each other, and pictures are large."""
        self.before = self.after = self.frames = None

    def _decoded(self) -> Iterator[av.VideoFrame]:
        for frame in self.container.decode(self.stream):
            if frame.pts is None:
                continue
            if frame.key_frame:
                if self.key is not None:
                    self.group = frame.time - self.key
                self.key = frame.time
            yield frame
