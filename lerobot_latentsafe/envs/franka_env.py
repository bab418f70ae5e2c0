"""The Franka's scenes as gymnasium environments, for `lerobot-eval`."""

from typing import ClassVar

from lerobot_latentsafe.envs.scene_env import SceneEnv
from lerobot_latentsafe.franka.actions import ACTION_NAMES, STATE_NAMES, action_limits
from lerobot_latentsafe.franka.scene import CAMERAS
from lerobot_latentsafe.franka.scenes import SCENES, make_scene


class FrankaEnv(SceneEnv):
    """A scene with the actions and observations of the robot `latentsafe_franka_mujoco`; see `scene_env.py`."""

    scene_name: ClassVar[str]
    cameras, state_names, action_names = CAMERAS, STATE_NAMES, ACTION_NAMES

    def __init__(self, variant: str | None = None, episode_length: int | None = None, image_size: int | None = None,
                 render_mode: str = "rgb_array"):  # fmt: skip
        info = SCENES[self.scene_name]
        scene = make_scene(self.scene_name, variant, image_size)
        seconds = info.episode_seconds
        super().__init__(scene, episode_length or round(seconds * info.fps), action_limits(info.fps), render_mode)


class BagEnv(FrankaEnv):
    """Lift an open bag without spilling candy."""

    scene_name = "bag"


class BlocksEnv(FrankaEnv):
    """Pluck a block from between two others."""

    scene_name = "blocks"
