"""Latent safety filters for LeRobot.

Importing this package registers the policy, environments and world-model configurations with LeRobot's
registries, and loads nothing heavy: models and simulators are imported when they are used.
"""

from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.envs.configuration_envs import LatentSafeDubinsEnv

__all__ = ["LatentSafeConfig", "LatentSafeDubinsEnv"]
__version__ = "0.1.0"
