"""The SO-101 that pushes a cube as a gymnasium environment, for `lerobot-eval`."""

from lerobot_latentsafe.envs.scene_env import SceneEnv
from lerobot_latentsafe.so101.actions import CAMERAS, EPISODE_SECONDS, FPS, HIGH, IMAGE_SIZE, LOW, NAMES
from lerobot_latentsafe.so101.scene import PushScene


class SO101Env(SceneEnv):
    """The scene with the actions and observations of the robot `latentsafe_so101_mujoco`; see `scene_env.py`."""

    cameras, state_names, action_names = CAMERAS, NAMES, NAMES

    def __init__(
        self,
        episode_length: int = round(EPISODE_SECONDS * FPS),
        image_size: int = IMAGE_SIZE,
        render_mode: str = "rgb_array",
    ):
        super().__init__(PushScene(image_size), episode_length, (LOW, HIGH), render_mode)
