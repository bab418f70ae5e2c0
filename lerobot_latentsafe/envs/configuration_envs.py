"""Environment configurations for `lerobot-eval` and our own evaluation."""

from dataclasses import dataclass, field

import gymnasium as gym
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGE, OBS_STATE


@EnvConfig.register_subclass("latentsafe_dubins")
@dataclass
class LatentSafeDubinsEnv(EnvConfig):
    """The paper's Dubins car (see `envs/dubins.py`).

    Attributes:
        variant: continuous, discrete or anywhere.
        episode_length: steps of 0.05 s.
        image_size: side of the camera image.
    """

    task: str | None = "Dubins-v0"
    fps: int = 20
    variant: str = "continuous"
    episode_length: int = 80
    image_size: int = 128
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(2,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(2,)),
            "environment_state": PolicyFeature(type=FeatureType.ENV, shape=(2,)),
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "environment_state": OBS_ENV_STATE,
            "pixels": OBS_IMAGE,
        }
    )

    def __post_init__(self) -> None:
        shape = (self.image_size, self.image_size, 3)
        self.features["pixels"] = PolicyFeature(type=FeatureType.VISUAL, shape=shape)

    @property
    def package_name(self) -> str:
        return "lerobot_latentsafe"

    @property
    def gym_kwargs(self) -> dict:
        return {
            "variant": self.variant,
            "episode_length": self.episode_length,
            "image_size": self.image_size,
        }


def _register(gym_id: str, entry_point: str) -> None:
    if gym_id not in gym.registry:
        gym.register(gym_id, entry_point=entry_point, disable_env_checker=True)


_register("lerobot_latentsafe/Dubins-v0", "lerobot_latentsafe.envs.dubins:DubinsEnv")
