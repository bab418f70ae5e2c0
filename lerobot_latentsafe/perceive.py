"""A frozen encoder's view of the cameras as `observation.environment_state`, for any LeRobot policy.

A LeRobot policy that reads images trains a network of its own on them. On a small machine it can instead be trained on
what a filter's encoder sees: `with_views` adds that to a cached dataset, and the step below does the same to live
observations, so that the trained policy runs wherever there are cameras.
"""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.processor import DeviceProcessorStep, ObservationProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_ENV_STATE
from torch import Tensor, nn

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

VIEWS = "views.safetensors"
"""The principal components, beside the dataset that was given its views."""
SAMPLED_FRAMES = 4000
"""From which principal components are found."""


@ProcessorStepRegistry.register("latentsafe_perceive")
class PerceiveStep(ObservationProcessorStep):
    """Adds each camera's view, the principal components of its tokens, to an observation whose images are tensors.

    The components are those of the policy's own demonstrations, camera by camera: what moves in one picture does not
    crowd out what moves in the other.

    Args:
        encoder, encoder_hash: see `PerceptionConfig`.
        components: of each camera.
        image_size: side to which images (B, 3, H, W) in [0, 1] are area-averaged.
        cameras: their keys in the observation.
    """

    def __init__(self, encoder: str, encoder_hash: str, components: int, image_size: int, cameras: list[str]):
        from lerobot_latentsafe.world_models.perception import Perception, PerceptionConfig

        self.config = PerceptionConfig(encoder=encoder, encoder_hash=encoder_hash, components=components)
        self.perception = Perception(self.config, cameras, image_size)
        self.views = camera_views(len(cameras), self.perception.n_patches, self.perception.token_dim, components)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        from lerobot_latentsafe.datasets.frame_cache import to_model_images

        perception = self.perception
        missing = [key for key in perception.image_keys if key not in observation]
        if missing:
            raise KeyError(
                f"observation lacks {', '.join(missing)}, which this policy sees by; got {', '.join(observation)}"
            )
        images = {key: to_model_images(observation[key], perception.image_size) for key in perception.image_keys}
        tokens = perception.tokens(images)
        return {**observation, OBS_ENV_STATE: see(self.views.to(tokens.device), tokens)}

    def get_config(self) -> dict[str, Any]:
        config, perception = self.config, self.perception
        return {
            "encoder": config.encoder,
            "encoder_hash": config.encoder_hash,
            "components": config.components,
            "image_size": perception.image_size,
            "cameras": perception.image_keys,
        }

    def state_dict(self) -> dict[str, Tensor]:
        # In 16 bits: half of a small policy would be these.
        state = self.views.state_dict()
        return {name: t.half() if t.is_floating_point() else t.clone() for name, t in state.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.views.load_state_dict(state)

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        seen = PolicyFeature(FeatureType.ENV, (self.config.components * len(self.views),))
        observed = {**features.get(PipelineFeatureType.OBSERVATION, {}), OBS_ENV_STATE: seen}
        return {**features, PipelineFeatureType.OBSERVATION: observed}


def camera_views(n_cameras: int, n_patches: int, token_dim: int, components: int) -> nn.ModuleList:
    """A basis for each camera's share of tokens (N, n_patches, token_dim)."""
    from lerobot_latentsafe.world_models.perception import FrameBasis

    return nn.ModuleList([FrameBasis(n_patches * token_dim // n_cameras, components) for _ in range(n_cameras)])


@torch.no_grad()
def see(views: nn.ModuleList, tokens: Tensor) -> Tensor:
    """Tokens (N, P, C) of all cameras -> their views side by side (N, n_cameras x components)."""
    return torch.cat([view(part) for view, part in zip(views, tokens.float().chunk(len(views), -1))], -1)


def with_views(cache_root: str | Path, repo_id: str, output_dir: str | Path, components: int = 64) -> "LeRobotDataset":
    """Copy a token-cached dataset with what each camera's view of a frame is as a column that policies read.

    Args:
        components: of each camera.

    Raises:
        FrameCacheError: the cache holds no tokens.
    """
    from lerobot.datasets.dataset_tools import add_features
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from safetensors.torch import save_file

    from lerobot_latentsafe.datasets.frame_cache import FrameCache
    from lerobot_latentsafe.world_models.perception import PerceptionConfig

    cache = FrameCache.open(cache_root)
    PerceptionConfig().adopt_cache(cache.manifest)
    tokens = lambda rows: cache.frames(rows, ["tokens"])[0]["tokens"]  # noqa: E731
    n = cache.manifest["n_frames"]
    sample = tokens(np.sort(np.random.default_rng(0).permutation(n)[:SAMPLED_FRAMES]))
    views = camera_views(len(cache.manifest["cameras"]), *sample.shape[1:], components)
    torch.manual_seed(0)
    for view, part in zip(views, sample.chunk(len(views), -1)):
        view.fit(part)
    seen = torch.cat([see(views, tokens(rows)) for rows in np.array_split(np.arange(n), max(1, n // 512))])
    feature = {"dtype": "float32", "shape": (seen.shape[1],), "names": None}
    dataset = LeRobotDataset(repo_id, root=cache_root)
    copy = add_features(
        dataset, {OBS_ENV_STATE: (seen.numpy(), feature)}, output_dir=output_dir, repo_id=f"{repo_id}_seen"
    )
    save_file(views.state_dict(), Path(output_dir) / VIEWS)
    return copy


def let_see(checkpoint: str | Path, cache_root: str | Path, views: str | Path, output_dir: str | Path) -> None:
    """Write a policy that was trained on such a column so that it makes the column itself, from its cameras.

    Args:
        views: the dataset that `with_views` made of the cache.

    Raises:
        FileExistsError: output_dir exists.
    """
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors
    from safetensors.torch import load_file

    from lerobot_latentsafe.datasets.frame_cache import FrameCache

    checkpoint, output_dir = Path(checkpoint), Path(output_dir)
    if output_dir.exists():
        raise FileExistsError(f"{output_dir} exists; choose another folder or delete it")
    manifest = FrameCache.open(cache_root).manifest
    config, cameras = PreTrainedConfig.from_pretrained(checkpoint), sorted(manifest["cameras"])
    step = PerceiveStep(
        manifest["encoder"], manifest["encoder_hash"], config.env_state_feature.shape[0] // len(cameras),
        manifest["image_size"], cameras,
    )  # fmt: skip
    step.load_state_dict(load_file(Path(views) / VIEWS))
    pre, post = make_pre_post_processors(config, pretrained_path=checkpoint)
    # After images are batched and on the device, before anything is normalised.
    at = next(i for i, s in enumerate(pre.steps) if isinstance(s, DeviceProcessorStep)) + 1
    pre.steps.insert(at, step)
    output_dir.mkdir(parents=True)
    for name in ("config.json", "model.safetensors"):
        shutil.copyfile(checkpoint / name, output_dir / name)
    for pipeline in (pre, post):
        pipeline.save_pretrained(output_dir)
