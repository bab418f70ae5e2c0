"""Clips for world-model training, from LeRobot batches or from a frame cache: the same windows either way."""

from dataclasses import dataclass
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
from lerobot_latentsafe.pictures import check_proportions
from lerobot_latentsafe.units import Units


@dataclass
class Clip:
    """A batch of aligned windows of episodes, what a world model trains on.

    Attributes:
        percepts: what `WorldModel.perceive` makes of each frame's images: name -> (B, T, ...).
        state: (B, T, S) proprioception.
        action: (B, T, A), the motion that led to each frame, as the world model hears it; none where is_first.
        is_first: bool (B, T), frames with no past.
        valid: bool (B, T), False for padding.
        failure: (B, T), 1 failing, 0 safe, -1 unlabelled.
        terminal: (B, T), 1 where the episode is over, 0 where it goes on, -1 unknown.
    """

    percepts: dict[str, Tensor]
    state: Tensor
    action: Tensor
    is_first: Tensor
    valid: Tensor
    failure: Tensor
    terminal: Tensor


class Eyes(Protocol):
    """What turns pictures into percepts: a world model, as far as reading clips is concerned."""

    image_keys: list[str]

    @property
    def percept_names(self) -> list[str]:
        """Keys of what `perceive` returns."""

    def perceive(self, images: dict[str, Tensor]) -> dict[str, Tensor]:
        """Camera key -> (B, C, H, W) in [0, 1] to name -> (B, ...)."""


class Seeing(Protocol):
    """What reads the pictures of a batch: a safety model."""

    @property
    def world_model(self) -> Eyes:
        """What makes percepts of them."""

    def images(self, images: Tensor) -> Tensor:
        """Pictures (..., 3, H, W) as the world model takes them."""


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

    def reader(self, length: int, units: Units) -> "ClipReader":
        """Clips of so many frames in these units."""
        return ClipReader(self.labels, self.cache, length, units)


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
    """Turns the frame indices of a batch into a Clip, with labels looked up beside the dataset.

    A clip holds frames t .. t + T - 1 of one episode. Its first frame has no past (`is_first`), the action before
    frame t + k is the one LeRobot stores with frame t + k - 1, and what runs past the episode's end is not `valid`.

    Args:
        labels: of all frames of the dataset.
        cache: of its frames, or None.
        length: T, of a training clip.
        units: of the filter; clips are made on their device.
    """

    def __init__(self, labels: FailureLabels, cache: FrameCache | None, length: int, units: Units):
        self.labels, self.cache, self.length, self.units = labels, cache, length, units

    def read(self, batch: dict[str, Tensor], model: Seeing) -> Clip:
        """The clips of a LeRobot training batch."""
        index = batch["index"].reshape(-1).cpu().numpy()
        if self.cache is not None:
            return self.cut(index, model.world_model.percept_names)
        eyes = model.world_model
        valid = ~batch[f"{eyes.image_keys[0]}_is_pad"]
        images = {k: model.images(batch[k]).flatten(0, 1) for k in eyes.image_keys}
        percepts = {k: v.unflatten(0, valid.shape) for k, v in eyes.perceive(images).items()}
        # LeRobot drops the last axis of features of a single number.
        action = batch["action"].reshape(*valid.shape, -1)
        state = action[..., :0]
        if "observation.state" in batch:
            state = batch["observation.state"].reshape(*valid.shape, -1)
        window = np.minimum(index[:, None] + np.arange(self.length), len(self.labels.failure) - 1)
        return self._assemble(window, percepts, state, action, valid)

    def require_cache(self) -> None:
        """Raise ValueError unless the dataset is cached: only training decodes videos."""
        if self.cache is None:
            raise ValueError("this reads cached frames: run latentsafe cache and give its folder as --dataset.root")

    def cut(self, start: np.ndarray, percept_names: list[str], length: int | None = None) -> Clip:
        """Clips from the frame cache that start at the given frame indices (B,); by default of the training length."""
        self.require_cache()
        window = start[:, None] + np.arange(length or self.length)
        inside = np.minimum(window, len(self.labels.episode) - 1)
        valid = (window == inside) & (self.labels.episode[inside] == self.labels.episode[start][:, None])
        last = start + valid.sum(1) - 1
        window = np.minimum(window, last[:, None])
        percepts, state = self.cache.frames(window, percept_names)
        percepts = {key: value.to(self.units.device) for key, value in percepts.items()}
        # Like LeRobot, which clamps to the episode: before its first frame stands the action after it.
        before = np.maximum(window - 1, 0)
        before = np.where(self.labels.episode[before] == self.labels.episode[window], before, window)
        action = torch.from_numpy(self.cache.action[before])
        return self._assemble(window, percepts, state, action, torch.from_numpy(valid))

    def _assemble(
        self, window: np.ndarray, percepts: dict[str, Tensor], state: Tensor, action: Tensor, valid: Tensor
    ) -> Clip:
        units, device = self.units, self.units.device
        is_first = torch.zeros(window.shape, dtype=torch.bool, device=device)
        is_first[:, 0] = True
        state = state.to(device).float()
        before = torch.cat([state[:, :1], state[:, :-1]], 1)  # the state at which each action was chosen
        action = units.heard_action(action.to(device).float(), before)
        return Clip(
            percepts=percepts,
            state=units.normalise_state(state),
            action=torch.where(is_first[..., None], units.first_action(action), action),
            is_first=is_first,
            valid=valid.to(device),
            failure=torch.from_numpy(self.labels.failure[window]).long().to(device),
            terminal=torch.from_numpy(self.labels.terminal[window]).long().to(device),
        )
