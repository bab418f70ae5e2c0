"""Options of the scripted operators."""

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig

BEHAVIORS = {
    "open_end": "lift the bag by its open end, which is safe",
    "middle": "lift the bag by its middle, with care",
    "closed_end": "yank the bag up by its closed end, so that candies spill",
    "nearer": "lift the bag by its closed end if that is the nearer end, else by its middle",
    "regrasp": "from a bag that is being lowered: put it down, let go, and lift it by its middle",
    "side_to_side": "hold the bag by its closed end and swing it; --teleop.speed decides what happens",
    "branch": "from a bag already grasped: lift, lift and lower, up and down, sideways, Gaussian, or hold",
    "climb": "from a bag already grasped: up in steps, with pauses and steps back",
    "dither": "the same, as by a policy that is not sure: moves are off, closed fingers open for a moment",
    "clumsy": "grasps the bag somewhere, not well, and lifts it like that",
    "rise": "from a bag already grasped: the same lift always",
    "random": "Gaussian actions, around the bag from a random grasp, around the blocks from above",
    "pluck_careful": "pull the green block straight up",
    "pluck_careless": "pull the green block up and sideways, so that a red one falls",
    "fetch": "pull the green block straight to the tray, which fells a red one from some starts",
}


@TeleoperatorConfig.register_subclass("latentsafe_scripted")
@dataclass(kw_only=True)
class LatentSafeScriptedConfig(TeleoperatorConfig):
    """An operator that plays a behaviour in a simulated scene, again in each episode.

    Attributes:
        behavior: one of BEHAVIORS.
        speed: of the motion that matters, m/s; None draws one a behaviour is known for, anew each episode.
        seed: of the operator's own choices; the scene's come from the robot's.
    """

    behavior: str
    speed: float | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.behavior not in BEHAVIORS:
            raise ValueError(f"behavior is {self.behavior!r}; expected one of {', '.join(BEHAVIORS)}")
        if self.speed is not None and not 0 < self.speed <= 1:
            raise ValueError(f"speed is {self.speed}; expected more than 0 and at most 1 m/s")
