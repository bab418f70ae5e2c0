"""Environment configurations for `lerobot-eval` and our own evaluation."""

from dataclasses import dataclass, field

import gymnasium as gym
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGE, OBS_IMAGES, OBS_STATE

from lerobot_latentsafe.franka.actions import ACTION_NAMES, STATE_NAMES
from lerobot_latentsafe.franka.scenes import SCENES, check_scene
from lerobot_latentsafe.so101 import actions as so101


@dataclass
class LatentSafeEnv(EnvConfig):
    """An environment of this package, made from its variant, episode length and image size."""

    @property
    def package_name(self) -> str:
        """Of the gymnasium ids."""
        return "lerobot_latentsafe"

    @property
    def gym_kwargs(self) -> dict:
        """What the environment is made with."""
        return {
            "variant": self.variant,
            "episode_length": self.episode_length,
            "image_size": self.image_size,
        }


@EnvConfig.register_subclass("latentsafe_dubins")
@dataclass
class LatentSafeDubinsEnv(LatentSafeEnv):
    """The paper's Dubins car (see `envs/dubins_env.py`).

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


@dataclass
class FrankaEnv(LatentSafeEnv):
    """A scene of the simulated Franka, with the features its robot records.

    Attributes:
        variant: of the scene, see `franka/scenes.py`; None takes the default.
        episode_length: control steps; None takes the scene's.
        image_size: side of both cameras' images; None takes the scene's.
    """

    variant: str | None = None
    episode_length: int | None = None
    image_size: int | None = None
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(len(ACTION_NAMES),)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(len(STATE_NAMES),)),
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "pixels/front": f"{OBS_IMAGES}.front",
            "pixels/wrist": f"{OBS_IMAGES}.wrist",
        }
    )

    def __post_init__(self) -> None:
        info = check_scene(self.scene, self.variant, self.image_size)
        self.variant = self.variant or info.variants[0]
        self.image_size = self.image_size or info.image_size
        self.episode_length = self.episode_length or round(info.episode_seconds * info.fps)
        for camera in ("front", "wrist"):
            shape = (self.image_size, self.image_size, 3)
            self.features[f"pixels/{camera}"] = PolicyFeature(type=FeatureType.VISUAL, shape=shape)

    @property
    def scene(self) -> str:
        """Name of the scene, from the type: latentsafe_<scene>."""
        return self.type.removeprefix("latentsafe_")


@EnvConfig.register_subclass("latentsafe_bag")
@dataclass
class LatentSafeBagEnv(FrankaEnv):
    """Lift an open bag without spilling candy (see `franka/bag.py`)."""

    task: str | None = "Bag-v0"
    fps: int = SCENES["bag"].fps


@EnvConfig.register_subclass("latentsafe_blocks")
@dataclass
class LatentSafeBlocksEnv(FrankaEnv):
    """Pluck a block from between two others (see `franka/blocks.py`)."""

    task: str | None = "Blocks-v0"
    fps: int = SCENES["blocks"].fps


@EnvConfig.register_subclass("latentsafe_so101")
@dataclass
class LatentSafeSO101Env(EnvConfig):
    """Push a cube to a mark with an SO-101, and not over the table's edge (see `so101/scene.py`).

    Attributes:
        episode_length: control steps.
        image_size: side of both cameras' pictures.
    """

    task: str | None = "SO101-v0"
    fps: int = so101.FPS
    episode_length: int = round(so101.EPISODE_SECONDS * so101.FPS)
    image_size: int = so101.IMAGE_SIZE
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(len(so101.NAMES),)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(len(so101.NAMES),)),
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            **{f"pixels/{camera}": f"{OBS_IMAGES}.{camera}" for camera in so101.CAMERAS},
        }
    )

    def __post_init__(self) -> None:
        so101.check_image_size(self.image_size)
        for camera in so101.CAMERAS:
            shape = (self.image_size, self.image_size, 3)
            self.features[f"pixels/{camera}"] = PolicyFeature(type=FeatureType.VISUAL, shape=shape)

    @property
    def package_name(self) -> str:
        """Of the gymnasium ids."""
        return "lerobot_latentsafe"

    @property
    def gym_kwargs(self) -> dict:
        """What the environment is made with."""
        return {"episode_length": self.episode_length, "image_size": self.image_size}


def _register(gym_id: str, entry_point: str) -> None:
    if gym_id not in gym.registry:
        gym.register(gym_id, entry_point=entry_point, disable_env_checker=True)


_register("lerobot_latentsafe/Dubins-v0", "lerobot_latentsafe.envs.dubins_env:DubinsEnv")
_register("lerobot_latentsafe/Bag-v0", "lerobot_latentsafe.envs.franka_env:BagEnv")
_register("lerobot_latentsafe/Blocks-v0", "lerobot_latentsafe.envs.franka_env:BlocksEnv")
_register("lerobot_latentsafe/SO101-v0", "lerobot_latentsafe.envs.so101_env:SO101Env")
