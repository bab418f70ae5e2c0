"""Latent safety filters for LeRobot.

Importing this package registers the policies, environments, robots, teleoperators, processors and world models with
LeRobot's registries, and loads nothing heavy. What a notebook needs is imported when it is asked for; see `api.py`.
"""

import importlib
from typing import TYPE_CHECKING, Any

from lerobot_latentsafe.chunk_guard import ChunkGuardStep
from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.envs.configuration_envs import (
    LatentSafeBagEnv,
    LatentSafeBlocksEnv,
    LatentSafeDubinsEnv,
    LatentSafeSO101Env,
)
from lerobot_latentsafe.policies.dreamer.configuration_dreamer import LatentSafeDreamerConfig
from lerobot_latentsafe.policies.grasp_prediction import GraspPredictionStep
from lerobot_latentsafe.processor_latentsafe import NoProprioceptionStep
from lerobot_latentsafe.robots.franka.config_franka import LatentSafeFrankaConfig
from lerobot_latentsafe.robots.franka_mujoco.config_franka_mujoco import LatentSafeFrankaMujocoConfig
from lerobot_latentsafe.robots.shielded.config_shielded import LatentSafeShieldedConfig
from lerobot_latentsafe.robots.so101_mujoco.config_so101_mujoco import LatentSafeSO101MujocoConfig
from lerobot_latentsafe.runtime.policy_server import serve_types
from lerobot_latentsafe.teleoperators.end_effector.config_end_effector import LatentSafeEndEffectorConfig
from lerobot_latentsafe.teleoperators.scripted.config_scripted import LatentSafeScriptedConfig
from lerobot_latentsafe.teleoperators.so101_leader.config_so101_leader import LatentSafeSO101LeaderConfig

if TYPE_CHECKING:
    from lerobot_latentsafe.api import (
        EpisodeValues,
        FilterDecision,
        LatentSafePolicy,
        decide,
        evaluate_filter,
        load_filter,
        shield_policy,
        train_filter,
        values_along,
    )

__all__ = [
    "ChunkGuardStep",
    "EpisodeValues",
    "FilterDecision",
    "GraspPredictionStep",
    "LatentSafeBagEnv",
    "LatentSafeBlocksEnv",
    "LatentSafeConfig",
    "LatentSafeDreamerConfig",
    "LatentSafeDubinsEnv",
    "LatentSafeEndEffectorConfig",
    "LatentSafeFrankaConfig",
    "LatentSafeFrankaMujocoConfig",
    "LatentSafePolicy",
    "LatentSafeSO101Env",
    "LatentSafeSO101LeaderConfig",
    "LatentSafeSO101MujocoConfig",
    "LatentSafeScriptedConfig",
    "LatentSafeShieldedConfig",
    "LawOptions",
    "NoProprioceptionStep",
    "decide",
    "evaluate_filter",
    "load_filter",
    "shield_policy",
    "train_filter",
    "values_along",
]
__version__ = "0.2.0"

serve_types(["latentsafe", "latentsafe_dreamer"])


def __getattr__(name: str) -> Any:
    """What `api.py` offers, imported at first use."""
    if name not in __all__:
        raise AttributeError(f"module 'lerobot_latentsafe' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(importlib.import_module("lerobot_latentsafe.api"), name)
