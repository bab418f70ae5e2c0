"""Everything that LeRobot knows by a name: importing this registers it, and loads no model and no simulator.

LeRobot's commands import it through `lerobot_policy_latentsafe`; so does whoever asks the package for any of its names.
"""

from lerobot_latentsafe.chunk_guard import ChunkGuardStep
from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
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

__all__ = [
    "ChunkGuardStep",
    "GraspPredictionStep",
    "LatentSafeBagEnv",
    "LatentSafeBlocksEnv",
    "LatentSafeConfig",
    "LatentSafeDreamerConfig",
    "LatentSafeDubinsEnv",
    "LatentSafeEndEffectorConfig",
    "LatentSafeFrankaConfig",
    "LatentSafeFrankaMujocoConfig",
    "LatentSafeSO101Env",
    "LatentSafeSO101LeaderConfig",
    "LatentSafeSO101MujocoConfig",
    "LatentSafeScriptedConfig",
    "LatentSafeShieldedConfig",
    "NoProprioceptionStep",
]

serve_types(["latentsafe", "latentsafe_dreamer"])
