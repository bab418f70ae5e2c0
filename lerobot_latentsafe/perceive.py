"""A frozen encoder's view of the cameras as `observation.environment_state`, for any LeRobot policy.

A LeRobot policy that reads images trains a network of its own on them. On a small machine it can instead be trained on
what the filter's encoder sees: `with_vectors` adds that to a cached dataset, and the step below does the same to live
observations, so that the trained policy runs wherever there are cameras.
"""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.processor import DeviceProcessorStep, ObservationProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_ENV_STATE

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset


@ProcessorStepRegistry.register("latentsafe_perceive")
class PerceiveStep(ObservationProcessorStep):
    """Adds the principal components of a frame's tokens to an observation, after images have become tensors.

    Args:
        encoder, encoder_hash, components: see `PerceptionConfig`.
        image_size: side to which images (B, 3, H, W) in [0, 1] are area-averaged.
        cameras: their keys in the observation.
    """

    def __init__(self, encoder: str, encoder_hash: str, components: int, image_size: int, cameras: list[str]):
        from lerobot_latentsafe.world_models.perception import Perception, PerceptionConfig

        self.config = PerceptionConfig(encoder=encoder, encoder_hash=encoder_hash, components=components)
        self.perception = Perception(self.config, cameras, image_size)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        from lerobot_latentsafe.datasets.frame_cache import to_model_images

        perception = self.perception
        missing = [key for key in perception.image_keys if key not in observation]
        if missing:
            raise KeyError(
                f"observation lacks {', '.join(missing)}, which this policy sees by; got {', '.join(observation)}"
            )
        images = {key: to_model_images(observation[key], perception.image_size) for key in perception.image_keys}
        device = next(iter(images.values())).device
        return {**observation, OBS_ENV_STATE: perception.to(device)(images)["vector"]}

    def get_config(self) -> dict[str, Any]:
        config, perception = self.config, self.perception
        return {
            "encoder": config.encoder,
            "encoder_hash": config.encoder_hash,
            "components": config.components,
            "image_size": perception.image_size,
            "cameras": perception.image_keys,
        }

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {name: tensor.clone() for name, tensor in self.perception.basis.state_dict().items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        self.perception.basis.load_state_dict(state)

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        seen = PolicyFeature(FeatureType.ENV, (self.config.components,))
        observed = {**features.get(PipelineFeatureType.OBSERVATION, {}), OBS_ENV_STATE: seen}
        return {**features, PipelineFeatureType.OBSERVATION: observed}


def with_vectors(cache_root: str | Path, repo_id: str, output_dir: str | Path) -> "LeRobotDataset":
    """Copy a token-cached dataset with each frame's vector as a column that policies read."""
    from lerobot.datasets.dataset_tools import add_features
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_latentsafe.datasets.frame_cache import FrameCache

    vector = FrameCache.open(cache_root).percepts["vector"]
    feature = {"dtype": "float32", "shape": (vector.shape[1],), "names": None}
    dataset = LeRobotDataset(repo_id, root=cache_root)
    return add_features(
        dataset, {OBS_ENV_STATE: (vector[:], feature)}, output_dir=output_dir, repo_id=f"{repo_id}_seen"
    )


def let_see(checkpoint: str | Path, cache_root: str | Path, output_dir: str | Path) -> None:
    """Write a policy that was trained on such a column so that it makes the column itself, from its cameras.

    Raises:
        FileExistsError: output_dir exists.
    """
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors

    from lerobot_latentsafe.datasets.frame_cache import FrameCache

    checkpoint, output_dir = Path(checkpoint), Path(output_dir)
    if output_dir.exists():
        raise FileExistsError(f"{output_dir} exists; choose another folder or delete it")
    manifest = FrameCache.open(cache_root).manifest
    config = PreTrainedConfig.from_pretrained(checkpoint)
    step = PerceiveStep(
        manifest["encoder"], manifest["encoder_hash"], config.env_state_feature.shape[0], manifest["image_size"],
        sorted(manifest["cameras"]),
    )  # fmt: skip
    step.perception.load_basis(Path(cache_root))
    pre, post = make_pre_post_processors(config, pretrained_path=checkpoint)
    # After images are batched and on the device, before anything is normalised.
    at = next(i for i, s in enumerate(pre.steps) if isinstance(s, DeviceProcessorStep)) + 1
    pre.steps.insert(at, step)
    output_dir.mkdir(parents=True)
    for name in ("config.json", "model.safetensors"):
        shutil.copyfile(checkpoint / name, output_dir / name)
    for pipeline in (pre, post):
        pipeline.save_pretrained(output_dir)
