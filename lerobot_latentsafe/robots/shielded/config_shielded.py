"""Options of a shielded robot."""

import math
from dataclasses import dataclass, field
from pathlib import Path

import draccus
from lerobot.robots.config import RobotConfig

from lerobot_latentsafe.decision import LawOptions

NAME = "latentsafe_shielded"


@dataclass
class InnerRobotConfig(draccus.ChoiceRegistry):
    """Any registered robot but the shielded one: a registry must not nest itself, draccus would recurse."""

    @classmethod
    def get_known_choices(cls) -> dict[str, type]:
        """Name -> options class of each robot that may be shielded."""
        return {name: kind for name, kind in RobotConfig.get_known_choices().items() if name != NAME}

    @classmethod
    def get_choice_class(cls, name: str) -> type:
        """The options class of a robot."""
        return cls.get_known_choices()[name]

    @classmethod
    def get_choice_name(cls, subcls: type) -> str:
        """The name of a robot."""
        return RobotConfig.get_choice_name(subcls)


@RobotConfig.register_subclass(NAME)
@dataclass(kw_only=True)
class LatentSafeShieldedConfig(RobotConfig):
    """Any robot behind a latent safety filter: `--robot.inner.type=... --robot.filter=...`.

    Attributes:
        inner: the robot that moves.
        filter: a trained filter: a folder, a Hub id or the name of a committed one.
        law: changes of the filter's law, such as `--robot.law.epsilon=0.3` or `--robot.law.mode=monitor`.
        device: where the filter runs; None takes the filter's.
        fps: rate of the loop that drives it, if known beforehand: it must be the filter's.
        unfiltered_moves: let pass what moves the robot between episodes (LeRobot's return of an arm to its start, a
            person's resets), and commands of which the filter knows nothing, such as joint moves. Otherwise the first
            are filtered like any other, and at the others the robot holds still. Where commands are joint targets,
            what moves the robot between episodes passes anyway, but no joint goes further at once than in the data.
        slack_s: seconds by which an observation may be older than a period when the action leaves, counted from before
            it was taken. None: what the inner robot declares as its `slack_s`, else 0.
        journal: a parquet file for every decision, for LeRobot's own loops. `latentsafe record` writes one of its own.
    """

    inner: InnerRobotConfig | None = None
    filter: str | None = None
    law: LawOptions = field(default_factory=LawOptions)
    device: str | None = None
    fps: int | None = None
    unfiltered_moves: bool = False
    slack_s: float | None = None
    journal: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.inner is None:
            raise ValueError("no robot to shield: give --robot.inner.type=<any LeRobot robot>")
        if self.filter is None:
            raise ValueError("no filter: give --robot.filter=<folder, Hub id or committed name>")
        if isinstance(self.inner, LatentSafeShieldedConfig):
            raise ValueError("--robot.inner is itself latentsafe_shielded; shields do not nest, give the bare robot")
        if self.slack_s is not None and not 0 <= self.slack_s < math.inf:
            raise ValueError(f"--robot.slack_s is {self.slack_s}; expected seconds, 0 or more")
