"""Clips for world-model training, from LeRobot batches or from a frame cache: the same windows either way."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from torch import Tensor

from lerobot_latentsafe.datasets.frame_cache import FOLDER, FrameCache, FrameCacheError, check_proportions
from lerobot_latentsafe.datasets.labels import FailureLabels
from lerobot_latentsafe.world_models.base import Clip

if TYPE_CHECKING:
    from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy


class ClipReader:
    """Turns the frame indices of a batch into a Clip, with labels looked up beside the dataset.

    A clip holds frames t .. t + T - 1 of one episode. Its first frame has no past (`is_first`), the action before
    frame t + k is the one LeRobot stores with frame t + k - 1, and what runs past the episode's end is not `valid`.
    """

    def __init__(self, labels: FailureLabels, cache: FrameCache | None, length: int):
        self.labels, self.cache, self.length = labels, cache, length

    @classmethod
    def of_dataset(cls, config: "LatentSafeConfig", meta) -> "ClipReader":
        """Labels and, where there is one, the cache of a dataset; settles which cameras the filter reads.

        Raises:
            UnlabelledDatasetError: no failure labels.
            FrameCacheError: a torn cache, one of another dataset, of another image size or of tokens of more cameras.
            ValueError: no camera at all, none of that name, or one of other proportions than those trained on.
        """
        labels = FailureLabels.load(meta.root, config.failure_specification)
        if len(labels.failure) != meta.total_frames:
            raise ValueError(f"{meta.root} holds {len(labels.failure)} frames on disk, {meta.total_frames} by its info")
        folder = config.frame_cache
        if folder is None and (Path(meta.root) / FOLDER).exists():
            folder = config.frame_cache = str(meta.root)
        cache = None
        cameras = {k: list(meta.features[k]["shape"]) for k in meta.camera_keys}
        if folder is not None:
            cache = FrameCache.open(folder, meta)
            cameras = cache.manifest["cameras"]
            if cache.image_size != config.world_model.image_size:
                raise FrameCacheError(
                    f"cache {folder} holds {cache.image_size}-pixel frames, the world model reads "
                    f"{config.world_model.image_size}; build it with latentsafe cache --image_size="
                    f"{config.world_model.image_size}"
                )
            config.world_model.adopt_cache(cache.manifest)
        if config.cameras is None:
            config.cameras = sorted(cameras)
        missing = [key for key in config.cameras if key not in cameras]
        if missing or not config.cameras:
            raise ValueError(
                f"{meta.repo_id} lacks the camera {', '.join(missing) or 'images'}: it has "
                f"{', '.join(cameras) or 'none'}. Record it, or name the cameras to use with --policy.cameras"
            )
        if cache is not None and "encoder_hash" in cache.manifest and set(cameras) != set(config.cameras):
            raise FrameCacheError(
                f"cache {folder} holds the tokens of {', '.join(cameras)} side by side, the filter sees "
                f"{', '.join(config.cameras)} alone; cache a copy of the dataset with these cameras only"
            )
        for key in config.cameras:
            height, width, channels = cameras[key]
            if key in config.input_features:
                check_proportions(key, (channels, height, width), config.input_features[key].shape)
            config.input_features[key] = PolicyFeature(FeatureType.VISUAL, (channels, height, width))
        return cls(labels, cache, config.world_model.clip_length)

    def read(self, batch: dict[str, Tensor], policy: "LatentSafePolicy") -> Clip:
        """The clips of a LeRobot training batch."""
        index = batch["index"].reshape(-1).cpu().numpy()
        if self.cache is not None:
            return self.cut(index, policy)
        valid = ~batch["observation.state_is_pad"]
        images = {k: policy.model_images(batch[k]).flatten(0, 1) for k in policy.world_model.image_keys}
        percepts = {k: v.unflatten(0, valid.shape) for k, v in policy.world_model.perceive(images).items()}
        # LeRobot drops the last axis of features of a single number.
        state, action = (batch[k].reshape(*valid.shape, -1) for k in ("observation.state", "action"))
        window = np.minimum(index[:, None] + np.arange(self.length), len(self.labels.failure) - 1)
        return self._assemble(window, percepts, state, action, valid, policy)

    def require_cache(self) -> None:
        """Raise ValueError unless the dataset is cached: only training decodes videos."""
        if self.cache is None:
            raise ValueError("this reads cached frames: run latentsafe cache and give its folder as --dataset.root")

    def cut(self, start: np.ndarray, policy: "LatentSafePolicy", length: int | None = None) -> Clip:
        """Clips from the frame cache that start at the given frame indices (B,); by default of the training length."""
        self.require_cache()
        window = start[:, None] + np.arange(length or self.length)
        inside = np.minimum(window, len(self.labels.episode) - 1)
        valid = (window == inside) & (self.labels.episode[inside] == self.labels.episode[start][:, None])
        last = start + valid.sum(1) - 1
        window = np.minimum(window, last[:, None])
        percepts, state = self.cache.frames(window, policy.world_model.percept_names)
        percepts = {key: value.to(policy.device) for key, value in percepts.items()}
        # Like LeRobot, which clamps to the episode: before its first frame stands the action after it.
        before = np.maximum(window - 1, 0)
        before = np.where(self.labels.episode[before] == self.labels.episode[window], before, window)
        action = torch.from_numpy(self.cache.action[before])
        return self._assemble(window, percepts, state, action, torch.from_numpy(valid), policy)

    def _assemble(
        self, window: np.ndarray, percepts: dict[str, Tensor], state: Tensor, action: Tensor, valid: Tensor,
        policy: "LatentSafePolicy",
    ) -> Clip:  # fmt: skip
        device = policy.device
        is_first = torch.zeros(window.shape, dtype=torch.bool, device=device)
        is_first[:, 0] = True
        action = policy.normalise_action(action.to(device).float()).clamp(-1, 1)
        return Clip(
            percepts=percepts,
            state=policy.normalise_state(state.to(device)),
            action=torch.where(is_first[..., None], policy.first_action(action), action),
            is_first=is_first,
            valid=valid.to(device),
            failure=torch.from_numpy(self.labels.failure[window]).long().to(device),
            terminal=torch.from_numpy(self.labels.terminal[window]).long().to(device),
        )
