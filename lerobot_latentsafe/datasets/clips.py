"""Clips for world-model training, from LeRobot batches or from a frame cache: the same windows either way."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe._compat import training_run
from lerobot_latentsafe.datasets.cameras import channels_first
from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.frame_cache import FOLDER, FrameCache, FrameCacheError
from lerobot_latentsafe.datasets.labels import FailureLabels
from lerobot_latentsafe.datasets.renaming import rename_command
from lerobot_latentsafe.latent import Recorded
from lerobot_latentsafe.pictures import check_proportions
from lerobot_latentsafe.units import Units


@dataclass
class Clip:
    """A batch of aligned windows of episodes, what a world model trains on.

    Attributes:
        percepts: what `WorldModel.perceive` makes of each frame's images: name -> (B, T, ...).
        state: (B, T, S) proprioception.
        action: (B, T, A), the motions that led to each frame since the one before, side by side, as the world model
            hears them; none where is_first.
        is_first: bool (B, T), frames with no past.
        valid: bool (B, T), False for padding.
        failure: (B, T), 1 failing, by then or since the frame before, 0 safe, -1 unlabelled.
        terminal: (B, T), 1 where the episode is over, 0 where it goes on, -1 unknown.
    """

    percepts: dict[str, Tensor]
    state: Tensor
    action: Tensor
    is_first: Tensor
    valid: Tensor
    failure: Tensor
    terminal: Tensor

    def rows(self, some: slice) -> "Clip":
        """Some of the clips."""
        cut = {name: values[some] for name, values in self.percepts.items()}
        return Clip(cut, *(getattr(self, field.name)[some] for field in fields(self)[1:]))


class Eyes(Protocol):
    """What turns pictures into percepts: a world model, as far as reading clips is concerned."""

    image_keys: list[str]

    @property
    def percept_names(self) -> list[str]:
        """Keys of what `perceive` returns."""

    def perceive(self, images: dict[str, Tensor]) -> dict[str, Tensor]:
        """Camera key -> (B, C, H, W) in [0, 1] to name -> (B, ...)."""

    def from_cache(self, cached: dict[str, Tensor]) -> dict[str, Tensor]:
        """Percepts of what a frame cache holds of frames: name -> (..., ...)."""


class Seeing(Protocol):
    """What reads the pictures of a batch: a safety model."""

    @property
    def world_model(self) -> Eyes:
        """What makes percepts of them."""

    def images(self, images: Tensor) -> Tensor:
        """Pictures (..., 3, H, W) as the world model takes them."""


class WorldModelSizes(Protocol):
    """What of a world model's configuration says which clips it is trained on."""

    clip_length: int
    frame_skip: int


@dataclass
class FilterData:
    """What of a dataset a filter is trained on.

    Attributes:
        contract: what the dataset says of its robot.
        labels: of failures.
        cache: its frames, if they are cached.
        frame_cache: the cache's folder.
        cameras: key -> (C, H, W) of those that the filter reads.
    """

    contract: Contract
    labels: FailureLabels
    cache: FrameCache | None
    frame_cache: str | None
    cameras: dict[str, tuple[int, int, int]]

    @classmethod
    def open(
        cls, meta: Any, specification: str, frame_cache: str | None, image_size: int, cameras: list[str] | None = None
    ) -> "FilterData":
        """Check a dataset, and open its labels and, where there is one, its cache.

        Args:
            meta: LeRobotDatasetMetadata.
            specification: name of the failure labels.
            frame_cache: folder of the cache; None takes the one in the dataset's folder, if there is one.
            image_size: side of the pictures that the world model reads.
            cameras: those that the filter reads; None: all.

        Raises:
            DatasetContractError: a dataset that cannot be used as it is.
            UnlabelledDatasetError: no failure labels.
            FrameCacheError: a torn cache, one of another dataset, of another image size or of tokens of more cameras.
            ValueError: no camera at all, or none of that name.
        """
        contract = Contract.read(meta)
        labels = FailureLabels.load(meta.root, specification, meta.repo_id)
        if frame_cache is None and (Path(meta.root) / FOLDER).exists():
            frame_cache = str(meta.root)
        cache, shapes = None, contract.cameras
        if frame_cache is not None:
            cache = FrameCache.open(frame_cache, meta)
            cache.require_image_size(image_size)
            refuse_transforms(frame_cache)
            shapes = {key: channels_first(key, {"shape": shape}) for key, shape in cache.manifest["cameras"].items()}
        chosen = cameras or sorted(shapes)
        missing = [key for key in chosen if key not in shapes]
        if missing or not chosen:
            raise ValueError(_lacks(contract, missing, list(shapes)))
        if cache is not None and "encoder_hash" in cache.manifest and set(shapes) != set(chosen):
            raise FrameCacheError(
                f"cache {frame_cache} holds the tokens of {', '.join(shapes)} side by side, the filter sees "
                f"{', '.join(chosen)} alone; cache a copy of the dataset with these cameras only"
            )
        return cls(contract, labels, cache, frame_cache, {key: shapes[key] for key in chosen})

    def check_cameras(self, trained: dict[str, tuple[int, int, int]]) -> None:
        """Refuse cameras of other proportions than trained on, key -> (C, H, W).

        Raises:
            ValueError: naming both shapes.
        """
        for key, shape in trained.items():
            check_proportions(key, self.cameras[key], shape)

    def reader(self, world_model: WorldModelSizes, units: Units) -> "ClipReader":
        """Clips for a world model of these sizes, in these units.

        Raises:
            ValueError: no episode is as long as a step of the world model.
        """
        numbers, sizes = self.cache or self.contract, world_model
        longest = int(np.unique(self.labels.episode, return_counts=True)[1].max())
        if longest <= sizes.frame_skip:
            raise ValueError(
                f"world_model.frame_skip is {sizes.frame_skip}, and the longest episode has {longest} frames: none "
                "holds a step of the world model. Give a smaller frame_skip, or record longer episodes"
            )
        return ClipReader(
            self.labels, self.cache, sizes.clip_length, units, sizes.frame_skip, numbers.state, numbers.action
        )


def _lacks(contract: Contract, missing: list[str], cameras: list[str]) -> str:
    """What is said of a dataset without the cameras that a filter reads."""
    renames = {key: missing[0] for key in list(contract.cameras)[:1] if missing}
    remedy = (
        "Name the cameras to use with --policy.trained_on.cameras, or, if it is the same camera by another name, "
        f"rename it: {rename_command(contract.root, renames)}"
        if renames
        else "Record one, or download the whole dataset"
    )
    left_out = "".join(f"; {key} is left out: {why}" for key, why in contract.left_out.items())
    return (
        f"{contract.repo_id} lacks the camera {', '.join(missing) or 'images'}: it has "
        f"{', '.join(cameras) or 'none'}{left_out}. {remedy}"
    )


def refuse_transforms(frame_cache: str) -> None:
    """Refuse LeRobot's image transforms on frames that are cached, which they would leave as they are, unsaid.

    Raises:
        ValueError: with the remedy.
    """
    run = training_run()
    if run is not None and run.dataset.image_transforms.enable:
        raise ValueError(
            f"--dataset.image_transforms.enable=true has no effect on the cached frames in {frame_cache}: pictures are "
            "transformed when they are decoded. Leave the option out, or train on the dataset with pictures"
        )


class ClipReader:
    """Turns the frame indices of a batch into a Clip, with numbers and labels looked up beside the dataset.

    A clip holds frames t, t + K .. t + (T - 1) K of one episode. Its first frame has no past (`is_first`); the actions
    that led to another are those that LeRobot stores with the K frames before it; what runs past the episode's end is
    not `valid`.

    Args:
        labels: of all frames of the dataset.
        cache: of its frames, or None.
        length: T, of a training clip.
        units: of the filter; clips are made on their device.
        skip: K.
        state, action: (N, S) and (N, A) of all frames, in robot units; by default the cache's.
    """

    def __init__(
        self, labels: FailureLabels, cache: FrameCache | None, length: int, units: Units, skip: int = 1,
        state: np.ndarray | None = None, action: np.ndarray | None = None,
    ):  # fmt: skip
        self.labels, self.cache, self.length, self.units, self.skip = labels, cache, length, units, skip
        self.state = cache.state if state is None else state
        self.action = cache.action if action is None else action

    def read(self, batch: dict[str, Tensor], model: Seeing) -> Clip:
        """The clips of a LeRobot training batch."""
        index = batch["index"].reshape(-1).cpu().numpy()
        if self.cache is not None:
            return self.cut(index, model.world_model)
        eyes = model.world_model
        window, valid = self._window(index, self.length)
        images = {k: model.images(batch[k]).flatten(0, 1) for k in eyes.image_keys}
        percepts = {k: v.unflatten(0, valid.shape) for k, v in eyes.perceive(images).items()}
        return self._assemble(window, valid, percepts)

    def require_cache(self) -> None:
        """Raise ValueError unless the dataset is cached: only training decodes videos."""
        if self.cache is None:
            raise ValueError("this reads cached frames: run latentsafe cache and give its folder as --dataset.root")

    def cut(self, start: np.ndarray, eyes: Eyes | None = None, length: int | None = None) -> Clip:
        """Clips from the frame cache that start at the given frame indices (B,); by default of the training length.

        Args:
            eyes: the world model that sees them; None: nobody does, and there are no percepts.
        """
        self.require_cache()
        window, valid = self._window(start, length or self.length)
        cached, _ = self.cache.frames(window, eyes.percept_names if eyes else [])
        cached = {key: value.to(self.units.device) for key, value in cached.items()}
        return self._assemble(window, valid, eyes.from_cache(cached) if eyes else {})

    def recorded(self) -> Recorded:
        """What was done after each frame of the dataset; after an episode's last frame, the same again."""
        _, of, counts = np.unique(self.labels.episode, return_inverse=True, return_counts=True)
        frame, last = np.arange(len(of)), (np.cumsum(counts) - 1)[of]
        ticks = np.minimum(frame[:, None] + np.arange(self.skip), last[:, None])
        action, state = (torch.from_numpy(column[ticks]).float() for column in (self.action, self.state))
        device, after = self.units.device, frame + self.skip
        return Recorded(
            action=self.units.heard_action(action.to(device), state.to(device)).flatten(-2),
            following=torch.from_numpy(np.where(after <= last, after, frame)).to(device),
        )

    def _window(self, start: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
        """Frame indices (B, T) from each start on, and whether they are of its episode; if not, they stay at the last
        that is."""
        episode = self.labels.episode
        window = start[:, None] + self.skip * np.arange(length)
        inside = np.minimum(window, len(episode) - 1)
        valid = (window == inside) & (episode[inside] == episode[start][:, None])
        last = start + self.skip * (valid.sum(1) - 1)
        return np.minimum(window, last[:, None]), valid

    def _since(self, window: np.ndarray) -> np.ndarray:
        """The K frames before each (B, T, K): like LeRobot, which clamps to the episode, whose first frame stands for
        those before it."""
        since, episode = window[..., None] - np.arange(self.skip, 0, -1), self.labels.episode
        while (outside := (since < 0) | (episode[since] != episode[window][..., None])).any():
            since = since + outside
        return since

    def _assemble(self, window: np.ndarray, valid: np.ndarray, percepts: dict[str, Tensor]) -> Clip:
        units, device, since = self.units, self.units.device, self._since(window)
        is_first = torch.zeros(window.shape, dtype=torch.bool, device=device)
        is_first[:, 0] = True
        tensor = lambda numbers: torch.from_numpy(np.ascontiguousarray(numbers)).float().to(device)  # noqa: E731
        action = units.heard_action(tensor(self.action[since]), tensor(self.state[since])).flatten(-2)
        labels = (self.labels.failure, self.labels.terminal)
        failure, terminal = (self._by_then(label, window, since) for label in labels)
        return Clip(
            percepts=percepts,
            state=units.normalise_state(tensor(self.state[window])),
            action=torch.where(is_first[..., None], units.first_action(action), action),
            is_first=is_first,
            valid=torch.from_numpy(valid).to(device),
            failure=failure.to(device),
            terminal=terminal.to(device),
        )

    @staticmethod
    def _by_then(label: np.ndarray, window: np.ndarray, since: np.ndarray) -> Tensor:
        """Labels of frames (B, T): 1 also where it was 1 since the frame before."""
        found = label[window]
        between = (label[since[:, 1:, 1:]] == 1).any(-1)  # the frame before and the window's first count by themselves
        found[:, 1:] = np.maximum(found[:, 1:], between)
        return torch.from_numpy(found).long()
