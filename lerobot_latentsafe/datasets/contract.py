"""What a dataset says of its robot, settled in one place before any work: everybody else asks here.

Datasets in the world differ in how they name their numbers, order a picture's axes, store depth, and in what they lack.
A `Contract` is what remains when that is settled; a dataset that has none is refused with a remedy.
"""

import functools
import logging
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_latentsafe.datasets.cameras import settled_cameras, stored_picture
from lerobot_latentsafe.datasets.labels import read_frames
from lerobot_latentsafe.datasets.layout import INFO
from lerobot_latentsafe.datasets.names import settled_names
from lerobot_latentsafe.datasets.reading import DatasetContractError, some
from lerobot_latentsafe.datasets.renaming import rename_command, renames_of
from lerobot_latentsafe.datasets.wholeness import check_order, check_videos, require_size

if TYPE_CHECKING:  # the package imports this module, and LeRobot's datasets are heavy
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

logger = logging.getLogger(__name__)

ACTION, STATE = "action", "observation.state"
MOST_APART = 0.25
"""Frames by which a time may differ from a frame's place: LeRobot shows the picture of that time."""


@dataclass(frozen=True)
class Contract:
    """What a dataset says of its robot.

    Attributes:
        repo_id, root: of the dataset.
        robot_type: LeRobot's name of the robot, if it is known.
        fps: frames a second; 29.97 stays 29.97.
        state_names, action_names: one distinct name a number; of the state none if there is no `observation.state`.
        cameras: key -> (C, H, W) of those that are used, whatever order the file names.
        left_out: feature -> why it is not used.
        episode: int64 (N,), of the frames in the order of the index.
        state, action: float32 (N, S) and (N, A), all finite.
        seconds_apart: by how much times and frames differ at most, seconds.
        broken: episode -> which of its numbers is not finite, of those that were left out; see `read_sound`.
    """

    repo_id: str
    root: Path
    robot_type: str | None
    fps: float
    state_names: list[str]
    action_names: list[str]
    cameras: dict[str, tuple[int, int, int]]
    left_out: dict[str, str]
    episode: np.ndarray = field(repr=False)
    state: np.ndarray = field(repr=False)
    action: np.ndarray = field(repr=False)
    seconds_apart: float = 0.0
    broken: dict[int, str] = field(default_factory=dict)

    @classmethod
    def read(cls, meta: "LeRobotDatasetMetadata") -> "Contract":
        """Read a dataset's numbers and check it as far as that takes no decoding.

        What is left out is said once.

        Raises:
            DatasetContractError: what file or feature is wrong, what was expected, and the remedy.
        """
        contract = cls._read(meta)
        contract._check_finite()
        return contract

    @classmethod
    def read_sound(cls, meta: "LeRobotDatasetMetadata") -> "Contract":
        """The same, without the frames of episodes that hold NaN or infinity: for those who look at each alone.

        Raises:
            DatasetContractError: as `read`, or no episode is sound.
        """
        contract = cls._read(meta)
        broken: dict[int, str] = {}
        for key, row, column in contract._not_finite():
            for episode, at in zip(*np.unique(contract.episode[row], return_index=True)):
                broken.setdefault(int(episode), contract._first(key, row[at:], column[at:]))
        sound = ~np.isin(contract.episode, [*broken])
        if not sound.any():
            contract._check_finite()
        return replace(
            contract, broken=broken,
            episode=contract.episode[sound], state=contract.state[sound], action=contract.action[sound],
        )  # fmt: skip

    @classmethod
    def _read(cls, meta: "LeRobotDatasetMetadata") -> "Contract":
        check_features(meta)
        frames = read_frames(meta.root, [ACTION, STATE, "timestamp", "frame_index"])
        episode = frames["episode_index"].astype(np.int64)
        check_order(meta, frames["index"], episode)
        cameras, left_out = settled_cameras(meta)
        videos = {key: shape for key, shape in cameras.items() if key in meta.video_keys}
        check_videos(meta, videos)
        for key in {*cameras} - {*videos}:
            require_size(key, stored_picture(meta, key).size[::-1], cameras[key][1:])
        apart = _seconds_apart(meta, frames, list(videos))
        state, action = (_numbers(meta, frames, key) for key in (STATE, ACTION))
        state_names, action_names = settled_names(
            _names(meta, STATE), _names(meta, ACTION), state.shape[1], action.shape[1]
        )
        for key, why in left_out.items():
            _say_once(f"{meta.repo_id}: {key} is left out: {why}")
        return cls(
            meta.repo_id, Path(meta.root), meta.info.robot_type, meta.fps, state_names, action_names, cameras, left_out,
            episode, state, action, apart,
        )  # fmt: skip

    def _not_finite(self) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
        """Of each feature that holds NaN or infinity: rows and columns of these numbers."""
        for key, values in ((STATE, self.state), (ACTION, self.action)):
            row, column = np.nonzero(~np.isfinite(values))
            if len(row):
                yield key, row, column

    def _first(self, key: str, row: np.ndarray, column: np.ndarray) -> str:
        values, names = (self.state, self.state_names) if key == STATE else (self.action, self.action_names)
        episode = self.episode[row[0]]
        frame = row[0] - np.searchsorted(self.episode, episode)
        return f"{names[column[0]]} is {values[row[0], column[0]]} in frame {frame} of episode {episode}"

    def _check_finite(self) -> None:
        """Refuse NaN and infinity, which would make every loss NaN."""
        for key, row, column in self._not_finite():
            affected = np.unique(self.episode[row]).tolist()
            raise DatasetContractError(
                f"{key} of {self.repo_id} is not finite in {len(np.unique(row))} of {len(self.episode)} frames, in "
                f"episodes {some(affected)}: {self._first(key, row, column)}. Make a copy without those episodes: "
                f"lerobot-edit-dataset --repo_id={self.repo_id} --root={self.root} --new_repo_id={self.repo_id}_whole "
                f"--new_root={self.root}_whole --operation.type=delete_episodes "
                f"--operation.episode_indices='{affected}'"
            )

    def only(self, episodes: list[int] | None) -> "Contract":
        """The same of these episodes alone; None: all."""
        kept = np.isin(self.episode, self.episode if episodes is None else episodes)
        return replace(self, episode=self.episode[kept], state=self.state[kept], action=self.action[kept])

    @property
    def statistics(self) -> dict[str, dict[str, np.ndarray]]:
        """Feature -> min, max, mean, std and count of its numbers, as LeRobot's `meta/stats.json` has them."""
        features = {ACTION: self.action, STATE: self.state}
        return {key: _statistics(values) for key, values in features.items() if values.shape[1]}

    @property
    def lengths(self) -> np.ndarray:
        """int64 (E,), frames of each episode."""
        return np.unique(self.episode, return_counts=True)[1]


def check_features(meta: "LeRobotDatasetMetadata") -> None:
    """Refuse features that have other names than LeRobot's.

    Raises:
        DatasetContractError: naming the features that were found, and how to rename them.
    """
    renames = renames_of(meta.features)
    if renames:
        wrong = ", ".join(f"{found} for {expected}" for found, expected in renames.items())
        raise DatasetContractError(
            f"{meta.repo_id} has features of other names than LeRobot's: {wrong}. Make a renamed copy with: "
            f"{rename_command(meta.root, renames)}"
        )
    if ACTION not in meta.features:
        raise DatasetContractError(
            f"{meta.repo_id} has no feature {ACTION!r}; its features are {', '.join(meta.features)}. Rename the one "
            f"that holds the robot's commands: {rename_command(meta.root, {'<feature>': ACTION})}"
        )


@functools.cache
def _say_once(line: str) -> None:
    logger.warning(line)


def _names(meta: "LeRobotDatasetMetadata", key: str) -> Any:
    return meta.features.get(key, {}).get("names")


def _numbers(meta: "LeRobotDatasetMetadata", frames: dict[str, np.ndarray], key: str) -> np.ndarray:
    """float32 (N, D) of a feature, whatever its shape is; (N, 0) without it."""
    n = len(frames["index"])
    if key not in meta.features:
        return np.zeros((n, 0), np.float32)
    if key not in frames:
        raise DatasetContractError(
            f"{meta.root / 'data'} lacks the column {key}, which {INFO} promises; download or convert the dataset again"
        )
    values, expected = frames[key], int(np.prod(meta.features[key]["shape"]))
    if values.dtype.kind not in "biuf":
        raise DatasetContractError(
            f"{key} of {meta.repo_id} holds values that are not numbers, or rows of several lengths ({values.dtype}); "
            f"expected {expected} numbers a frame. Convert the dataset again"
        )
    values = values.reshape(n, -1)
    if values.shape[1] != expected:
        raise DatasetContractError(
            f"{key} of {meta.repo_id} has {values.shape[1]} numbers a frame in data/, {expected} by its {INFO}; "
            "correct the shape there, or convert the dataset again"
        )
    with np.errstate(over="ignore"):  # what is too large for 32 bits is refused as infinite
        return values.astype(np.float32)


def _seconds_apart(meta: "LeRobotDatasetMetadata", frames: dict[str, np.ndarray], videos: list[str]) -> float:
    """By how much times differ from frames at most; refuses what would show other pictures than were taken then."""
    apart, fps = 0.0, float(meta.fps)
    if "timestamp" in frames and "frame_index" in frames:
        late = np.abs(frames["timestamp"].reshape(-1) - frames["frame_index"].reshape(-1) / fps)
        at = int(np.argmax(np.where(np.isfinite(late), late, np.inf)))
        apart = float(late[at])
        if videos and not apart * fps <= MOST_APART:
            raise DatasetContractError(
                f"the timestamp of frame {frames['frame_index'][at]} of episode {frames['episode_index'][at]} of "
                f"{meta.repo_id} is {apart * fps:.2f} frames from its place at {fps:g} Hz, so that its picture would "
                f"be another's; expected frame_index / fps, and at most {MOST_APART} frames off. Correct fps in {INFO} "
                "or the column timestamp in data/, or convert the dataset again"
            )
    for key in videos:
        begin = np.asarray(meta.episodes[f"videos/{key}/from_timestamp"], float) * fps
        late = np.abs(begin - begin.round())
        at = int(np.argmax(np.where(np.isfinite(late), late, np.inf)))
        if not late[at] <= MOST_APART:
            raise DatasetContractError(
                f"episode {at} of {meta.repo_id} begins {late[at]:.2f} frames beside a frame of {key}'s video; "
                f"expected a multiple of 1/{fps:g} s as from_timestamp in meta/episodes. Convert the dataset again"
            )
    return apart


def _statistics(values: np.ndarray) -> dict[str, np.ndarray]:
    exact = values.astype(np.float64)
    found = {name: getattr(exact, name)(0) for name in ("min", "max", "mean", "std")}
    return {**found, "count": np.array([len(values)])}
