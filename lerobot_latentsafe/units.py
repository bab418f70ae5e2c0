"""Units and ranges: what a dataset tells a filter of its robot, and how numbers go in and out of the models.

Robot units at the border; inside, motions in about [-1, 1] by what the data show, and states in standard deviations.
A motion is a command that is zero, or as it was, where nothing moves: a delta, a velocity, a switch, and of a target
its displacement, the target minus the present state. So targets are converted where the state is known: here.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor, nn

from lerobot_latentsafe.looks import Look
from lerobot_latentsafe.meanings import Command, parse

STAGES = ("untrained", "guard", "world_model", "critic")
LOUDEST = 4.0
"""Inside, a displacement of the 99th percentile is 1; the rare larger ones are heard as this at most."""


@dataclass
class Monitored:
    """What the monitor of the unknown was fitted on; its numbers lie in a file beside the weights.

    Attributes:
        alpha: the chance of any alarm in a healthy episode.
        episodes, rank: of so many healthy episodes, sorted by their strangest moments, number `rank` is the threshold.
        fitted_on: episodes that the rest was learned from.
        cameras: those that it looks through, in order.
        image_size: pixels a side of the pictures that it looked at.
        dynamics: whether it also compares what was foretold with what came.
        world_model: hash of the world model that foretold.
        statistics: hash of the numbers.
    """

    alpha: float = 0.05
    episodes: int = 0
    rank: int = 0
    fitted_on: int = 0
    cameras: list[str] = field(default_factory=list)
    image_size: int = 0
    dynamics: bool = False
    world_model: str = ""
    statistics: str = ""


@dataclass
class TrainedOn:
    """What the weights were trained on, and how far; filled in by the training commands, in robot units.

    Attributes:
        stage: how far training has come: untrained, guard (ranges alone), world_model, critic.
        target: what the critic was trained for: `reachability` (Eq. 5) or `risk` (SQRL).
        task: what the world model was trained to imagine, in words, where a policy of the same task must share it.
        cameras: the image features the filter reads, by default all of the dataset's.
        robot_type: LeRobot's name of the robot that recorded the dataset.
        fps: frames a second.
        state_names, action_names: of the numbers of `observation.state` and `action`, in order.
        meanings: command -> target, delta, velocity or other (see `meanings.py`). Training fills in what names and data
            tell; give those that they do not tell. Filters of versions before 0.3 have none, and no targets.
        action_low, action_high: least and largest command of the data.
        action_varies: False for commands that the data never vary; the filter keeps those and knows nothing else of
            them.
        action_step, action_jerk: by how much each command changes from tick to tick at most, and by how much that
            change does. Filters of versions before 0.4 do not know.
        displacement_low, displacement_high: least and largest displacement of each target, its 99th percentile in
            size is displacement_scale; 0, 0 and 1 for commands that are no targets.
        state_low, state_high, state_mean, state_std: of the data.
        state_step: by how much each number of the state changes from frame to frame at most.
        unanswered: how far each command goes at most while the state stays as it is; see `looks.Response`.
        looks: camera key -> what its pictures have in common.
        episodes: fingerprints of the episodes trained on, 8 hex digits each; None: unknown. See `episode_marks`.
        monitor: what the monitor of the unknown was fitted on; None: there is none.
    """

    stage: str = "untrained"
    target: str = "reachability"
    task: str | None = None
    cameras: list[str] | None = None
    robot_type: str | None = None
    fps: float | None = None
    state_names: list[str] | None = None
    action_names: list[str] | None = None
    meanings: dict[str, str] | None = None
    action_low: list[float] | None = None
    action_high: list[float] | None = None
    action_varies: list[bool] | None = None
    action_step: list[float] | None = None
    action_jerk: list[float] | None = None
    displacement_low: list[float] | None = None
    displacement_high: list[float] | None = None
    displacement_scale: list[float] | None = None
    state_low: list[float] | None = None
    state_high: list[float] | None = None
    state_step: list[float] | None = None
    state_mean: list[float] | None = None
    state_std: list[float] | None = None
    unanswered: list[float] | None = None
    looks: dict[str, Look] | None = None
    episodes: str | None = None
    monitor: Monitored | None = None

    def __post_init__(self) -> None:
        if self.stage not in STAGES:
            raise ValueError(f"stage is {self.stage!r}; expected one of {', '.join(STAGES)}")
        if self.fps is not None and not 0 < self.fps < math.inf:
            raise ValueError(f"fps is {self.fps!r}; expected frames a second, more than 0")
        if self.fps is not None and self.fps == round(self.fps):
            self.fps = round(self.fps)  # 15, not 15.0, wherever people read it

    def has_reached(self, stage: str) -> bool:
        """Whether training has come at least this far."""
        return STAGES.index(self.stage) >= STAGES.index(stage)

    @property
    def commands(self) -> list[Command]:
        """Each command with its meaning; filters of versions before 0.3 call all of them deltas."""
        given, states = self.meanings or {}, self.state_names or []
        return [parse(name, given.get(name, "delta"), states) for name in self.action_names or []]

    def perhaps_targets(self, frozen_commands: list[str]) -> list[str]:
        """Commands of filters of versions before 0.3 whose name the state has, too, so that they may be targets."""
        if self.meanings is not None:
            return []
        varied = [name for name, varies in zip(self.action_names or [], self.action_varies or []) if varies]
        return [name for name in varied if name in (self.state_names or []) and name not in frozen_commands]

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Command -> least and largest value in the data; empty before training."""
        return dict(zip(self.action_names or [], zip(self.action_low or [], self.action_high or [])))

    @property
    def motion_ranges(self) -> dict[str, tuple[float, float]]:
        """Command -> least and largest motion in the data: of a target, its displacement."""
        if self.displacement_low is None:
            return self.ranges
        moves = dict(zip(self.action_names, zip(self.displacement_low, self.displacement_high)))
        return self.ranges | {c.name: moves[c.name] for c in self.commands if c.meaning == "target"}


class Units(nn.Module):
    """Numbers of a robot to numbers of the models, and back.

    Args:
        trained_on: names, meanings, ranges, means and deviations.
        frozen_commands: commands that a fallback never changes, such as `gripper.pos`; switches are frozen, too.
    """

    action_low: Tensor
    action_high: Tensor
    action_varies: Tensor
    state_mean: Tensor
    state_std: Tensor
    is_target: Tensor
    frozen: Tensor
    shown_by: Tensor
    motion_low: Tensor
    motion_high: Tensor
    motionless: Tensor
    loudest: Tensor

    def __init__(self, trained_on: TrainedOn, frozen_commands: list[str]):
        super().__init__()
        self.action_names, self.state_names = trained_on.action_names or [], trained_on.state_names or []
        commands = trained_on.commands
        low, high, mean, std = (
            torch.tensor(numbers, dtype=torch.float32)
            for numbers in (trained_on.action_low, trained_on.action_high, trained_on.state_mean, trained_on.state_std)
        )
        varies, targets = (
            torch.tensor(trained_on.action_varies),
            torch.tensor([c.meaning == "target" for c in commands]),
        )
        frozen = torch.tensor([c.name in frozen_commands or c.meaning == "other" for c in commands])
        shown_by = [c.of_state or c.name for c in commands]
        places = [self.state_names.index(name) if name in self.state_names else -1 for name in shown_by]
        scale = torch.ones_like(low)
        if trained_on.displacement_scale is not None:
            scale = torch.tensor(trained_on.displacement_scale, dtype=torch.float32)
        still = torch.where(varies, torch.zeros_like(low).clamp(low, high), (low + high) / 2)
        buffers = {
            "action_low": low, "action_high": high, "action_varies": varies, "state_mean": mean, "state_std": std,
            "is_target": targets, "frozen": frozen, "shown_by": torch.tensor(places),
            # What is -1 and 1 inside, what goes nowhere, and the most that is heard.
            "motion_low": torch.where(targets, -scale, low), "motion_high": torch.where(targets, scale, high),
            "motionless": torch.where(targets, 0.0, still), "loudest": torch.where(targets, LOUDEST, 1.0),
        }  # fmt: skip
        for name, numbers in buffers.items():
            self.register_buffer(name, numbers, persistent=False)

    @property
    def device(self) -> torch.device:
        """Where the numbers lie."""
        return self.action_low.device

    @cached_property
    def has_targets(self) -> bool:
        """Whether any command is a target, so that actions mean nothing without the state."""
        return bool(self.is_target.any())

    # -- actions in and out ---

    def normalise_action(self, action: Tensor, state: Tensor | None = None) -> Tensor:
        """Robot units -> motions, about [-1, 1] by what the data show: (..., A).

        Args:
            state: (..., S) in robot units, at which the action was chosen; needed where commands are targets.
        """
        return self.normalise_motions(action - self._origin(state) if self.has_targets else action)

    def denormalise_action(self, action: Tensor, state: Tensor | None = None) -> Tensor:
        """Motions -> robot units: (..., A); the inverse of `normalise_action`."""
        motion = self.motion_low + (action + 1) / 2 * (self.motion_high - self.motion_low)
        return self._origin(state) + motion if self.has_targets else motion

    def heard_action(self, action: Tensor, state: Tensor | None = None) -> Tensor:
        """Robot units -> motions as the world model hears them: bounded (..., A)."""
        return self.normalise_action(action, state).clamp(-self.loudest, self.loudest)

    def normalise_motions(self, motion: Tensor) -> Tensor:
        """Motions in robot units, of targets displacements, -> about [-1, 1]: (..., A)."""
        low, high = self.motion_low, self.motion_high
        return 2 * (motion - low) / (high - low) - 1

    def _origin(self, state: Tensor | None) -> Tensor:
        """What motions count from: the present state of targets, zero of other commands: (..., A)."""
        if state is None:
            raise ValueError("some commands are targets, which mean nothing without the state; give state=")
        return torch.where(self.is_target, state[..., self.shown_by], 0.0)

    def first_action(self, action: Tensor) -> Tensor:
        """What counts as having led to the first frame of an episode: no motion, frozen commands as in `action`.

        Args:
            action: (..., A), or of several ticks side by side (..., K A).
        """
        return self._frozen_or(action, 0.0)

    @property
    def still(self) -> Tensor:
        """Standing still, inside: (1, A)."""
        return self.normalise_motions(self.motionless)[None]

    def still_as(self, action: Tensor) -> Tensor:
        """Standing still for as many ticks as an action (..., K A) has, inside; frozen commands as they are there."""
        return self._frozen_or(action, self.still[0])

    def _frozen_or(self, action: Tensor, other: Tensor | float) -> Tensor:
        """An action of several ticks (..., K A) with all but its frozen commands replaced, by (A,) for each tick."""
        ticks = action.unflatten(-1, (-1, len(self.frozen)))
        return torch.where(self.frozen, ticks, other).flatten(-2)

    # -- states ---

    def normalise_state(self, state: Tensor) -> Tensor:
        """Robot units -> standard deviations from the mean: (..., S)."""
        return (state.float() - self.state_mean) / self.state_std
