"""Latent safety filters for LeRobot.

Importing this package registers the policy, environments, robots, teleoperators and world models with LeRobot's
registries, and loads nothing heavy: models and simulators are imported when they are used.
"""

from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.envs.configuration_envs import LatentSafeBagEnv, LatentSafeBlocksEnv, LatentSafeDubinsEnv
from lerobot_latentsafe.policies.dreamer.configuration_dreamer import LatentSafeDreamerConfig
from lerobot_latentsafe.policies.grasp_prediction import GraspPredictionStep
from lerobot_latentsafe.robots.franka.config_franka import LatentSafeFrankaConfig
from lerobot_latentsafe.robots.franka_mujoco.config_franka_mujoco import LatentSafeFrankaMujocoConfig
from lerobot_latentsafe.robots.shielded.config_shielded import LatentSafeShieldedConfig
from lerobot_latentsafe.teleoperators.end_effector.config_end_effector import LatentSafeEndEffectorConfig
from lerobot_latentsafe.teleoperators.scripted.config_scripted import LatentSafeScriptedConfig

__all__ = [
    "GraspPredictionStep",
    "LatentSafeBagEnv",
    "LatentSafeBlocksEnv",
    "LatentSafeConfig",
    "LatentSafeDreamerConfig",
    "LatentSafeDubinsEnv",
    "LatentSafeEndEffectorConfig",
    "LatentSafeFrankaConfig",
    "LatentSafeFrankaMujocoConfig",
    "LatentSafeScriptedConfig",
    "LatentSafeShieldedConfig",
]
__version__ = "0.1.0"
