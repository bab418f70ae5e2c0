"""Options of the scripted leader arm."""

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig

BEHAVIORS = {
    "careful": "pushes the cube to the mark",
    "reckless": "pushes the cube 5.5 cm past the mark, which is over the edge where the mark is near it",
    "dally": "pushes by fits and starts, to anywhere",
    "wander": "moves at random behind the cube and around it",
}


@TeleoperatorConfig.register_subclass("latentsafe_so101_leader")
@dataclass(kw_only=True)
class LatentSafeSO101LeaderConfig(TeleoperatorConfig):
    """An operator with a leader arm who plays a behaviour with the simulated SO-101, again in each episode.

    Attributes:
        behavior: one of BEHAVIORS.
        interrupted: whether somebody holds the arm, or takes it back, now and then, as a filter does.
        seed: of the operator's own choices; the scene's come from the robot's.
    """

    behavior: str
    interrupted: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if self.behavior not in BEHAVIORS:
            raise ValueError(f"behavior is {self.behavior!r}; expected one of {', '.join(BEHAVIORS)}")
