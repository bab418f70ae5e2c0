"""Options of the simulated SO-101."""

from dataclasses import dataclass

from lerobot.robots.config import RobotConfig

from lerobot_latentsafe.so101.actions import IMAGE_SIZE, check_image_size


@RobotConfig.register_subclass("latentsafe_so101_mujoco")
@dataclass(kw_only=True)
class LatentSafeSO101MujocoConfig(RobotConfig):
    """An SO-101 in MuJoCo, with the features of LeRobot's `so101_follower` and cameras `front` and `wrist`.

    Attributes:
        seed: of the first episode; the n-th episode of a recording starts from seed + n.
        image_size: side of both cameras' pictures, pixels.
    """

    seed: int = 0
    image_size: int = IMAGE_SIZE

    def __post_init__(self) -> None:
        super().__post_init__()
        check_image_size(self.image_size)
