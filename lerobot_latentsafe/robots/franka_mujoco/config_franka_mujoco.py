"""Options of the simulated Franka."""

from dataclasses import dataclass

from lerobot.robots.config import RobotConfig

from lerobot_latentsafe.franka.scenes import check_scene


@RobotConfig.register_subclass("latentsafe_franka_mujoco")
@dataclass(kw_only=True)
class LatentSafeFrankaMujocoConfig(RobotConfig):
    """A Franka in MuJoCo, with the same features as the real one (`latentsafe_franka`).

    Attributes:
        scene: bag or blocks.
        variant: of the scene, see `envs/scenes.py`; None takes the default.
        seed: of the first episode; the n-th episode of a recording starts from seed + n.
        image_size: side of both cameras' images; None takes the scene's.
    """

    scene: str = "bag"
    variant: str | None = None
    seed: int = 0
    image_size: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_scene(self.scene, self.variant, self.image_size)
