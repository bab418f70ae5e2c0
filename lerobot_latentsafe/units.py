"""Units and ranges: what a dataset tells a filter of its robot, and how numbers go in and out of the models.

Robot units at the border; inside, motions in about [-1, 1] by what the data show, and states in standard deviations.
A motion is a command that is zero, or as it was, where nothing moves: a delta, a velocity, a switch, and of a target
its displacement, the target minus the present state. So targets are converted where the state is known: here.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor, nn

from lerobot_latentsafe.looks import Look
from lerobot_latentsafe.meanings import Command, parse

STAGES = ("untrained", "guard", "world_model", "critic")
RANGE_TOLERANCE, TARGET_TOLERANCE = 0.1, 0.5
"""Share of the data's range by which a command may leave it: it is clipped, and judged and executed as clipped. Places
that a few dozen episodes reach differ more from those of the next than motions do, and a clipped target is a place that
the data reach."""
STATE_TOLERANCE = 1.0
"""Share of the data's range by which a number of the state may leave it and still be believed."""
LEAP_TOLERANCE = 0.5
"""Share of the data's largest change of a command from tick to tick by which a change may be larger."""
STEP_TOLERANCE, MISSED_TICKS = 2.0, 1
"""A number of the state that changes by more than so many of the data's largest steps since it was read last is not
believed; if it could not be read meanwhile, so many ticks count at most."""
LEAP_SHARE = 0.4
"""A number that no target is of may also change by this share of its range: a random motion's largest step, in a few
dozen episodes, says little of that in the next."""
FULL_TURNS, TURNED = (2 * math.pi, 360.0), 0.9
"""An angle wraps around if the data show at least this share of a full turn of it, and no more."""
AT_REST = 0.1
"""A number of the state that changes by less than this share of the data's largest step does not move."""
LOUDEST = 4.0
"""Inside, a displacement of the 99th percentile is 1; the rare larger ones are heard as this at most."""


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
    action_step: Tensor
    action_jerk: Tensor
    displacement_low: Tensor
    displacement_high: Tensor
    displacement_scale: Tensor
    state_low: Tensor
    state_high: Tensor
    state_step: Tensor
    state_mean: Tensor
    state_std: Tensor
    frozen: Tensor
    stays: Tensor
    is_target: Tensor
    adds_up: Tensor
    unanswered: Tensor
    motion_low: Tensor
    motion_high: Tensor
    loudest: Tensor
    turn: Tensor
    largest_leap: Tensor
    rest: Tensor
    _least_state: Tensor
    _most_state: Tensor
    _least_action: Tensor
    _most_action: Tensor
    _largest_step: Tensor
    _largest_jerk: Tensor
    _still: Tensor
    _width: Tensor
    _shown_by: Tensor
    _is_targets: Tensor

    def __init__(self, trained_on: TrainedOn, frozen_commands: list[str]):
        super().__init__()
        self.action_names, self.state_names = trained_on.action_names or [], trained_on.state_names or []
        n_actions, n_states = len(trained_on.action_low), len(trained_on.state_mean)
        unknown = {
            "action_step": [torch.inf] * n_actions, "action_jerk": [torch.inf] * n_actions,
            "unanswered": [torch.inf] * n_actions,
            "displacement_low": [0.0] * n_actions, "displacement_high": [0.0] * n_actions,
            "displacement_scale": [1.0] * n_actions, "state_low": [-torch.inf] * n_states,
            "state_high": [torch.inf] * n_states, "state_step": [torch.inf] * n_states,
        }  # fmt: skip
        for name in ("action_low", "action_high", "state_mean", "state_std", *unknown):
            known = getattr(trained_on, name)
            number = torch.tensor(unknown[name] if known is None else known, dtype=torch.float32)
            self.register_buffer(name, number, persistent=False)
        varies = torch.tensor(trained_on.action_varies)
        commands = trained_on.commands
        self.register_buffer("action_varies", varies, persistent=False)
        self.register_buffer("is_target", torch.tensor([c.meaning == "target" for c in commands]), persistent=False)
        adds_up = torch.tensor([c.meaning in ("delta", "velocity") for c in commands])
        self.register_buffer("adds_up", adds_up, persistent=False)
        scale, targets = self.displacement_scale, self.is_target  # what is -1 and 1 inside, and the most that is heard
        self.register_buffer("motion_low", torch.where(targets, -scale, self.action_low), persistent=False)
        self.register_buffer("motion_high", torch.where(targets, scale, self.action_high), persistent=False)
        self.register_buffer("loudest", torch.where(targets, LOUDEST, 1.0), persistent=False)
        frozen = torch.tensor([c.name in frozen_commands or c.meaning == "other" for c in commands])
        self.register_buffer("frozen", frozen, persistent=False)
        self.register_buffer("stays", frozen & (trained_on.meanings is not None), persistent=False)
        shown_by = [c.of_state or c.name for c in commands]
        places = [self.state_names.index(name) if name in self.state_names else -1 for name in shown_by]
        self.register_buffer("_shown_by", torch.tensor(places), persistent=False)
        targets = {place for place, target in zip(places, self.is_target.tolist()) if target}
        of_targets = torch.tensor([i in targets for i in range(n_states)], dtype=torch.bool)
        self.register_buffer("_is_targets", of_targets, persistent=False)
        self.register_buffer("turn", _turns(self.state_low, self.state_high), persistent=False)
        width = self.state_high - self.state_low
        widest = width.amax() if n_states else width.sum()
        self.register_buffer("_width", torch.maximum(width, 0.1 * widest), persistent=False)
        step = STEP_TOLERANCE * torch.maximum(self.state_step, 0.01 * widest)
        leap = torch.where(of_targets, step, torch.maximum(step, LEAP_SHARE * self._width))
        self.register_buffer("largest_leap", leap, persistent=False)
        for name, limit in self._limits().items():
            self.register_buffer(name, limit, persistent=False)

    def _limits(self) -> dict[str, Tensor]:
        """What follows from the ranges alone, worked out once and not at every tick."""
        slack = STATE_TOLERANCE * self._width
        width = self.action_high - self.action_low
        margin = torch.where(self.is_target, TARGET_TOLERANCE, RANGE_TOLERANCE) * width
        still = torch.zeros_like(self.action_low).clamp(self.action_low, self.action_high)
        return {
            "_least_state": self.state_low - slack, "_most_state": self.state_high + slack,
            "_least_action": self.action_low - margin, "_most_action": self.action_high + margin,
            "_largest_step": (1 + LEAP_TOLERANCE) * self.action_step,
            "_largest_jerk": (1 + LEAP_TOLERANCE) * self.action_jerk,
            "_still": torch.where(self.action_varies, still, (self.action_low + self.action_high) / 2),
            "rest": AT_REST * self.state_step,
        }  # fmt: skip

    @property
    def device(self) -> torch.device:
        """Where the numbers lie."""
        return self.action_low.device

    @cached_property
    def has_targets(self) -> bool:
        """Whether any command is a target, so that actions mean nothing without the state."""
        return bool(self.is_target.any())

    @cached_property
    def turns(self) -> bool:
        """Whether any number of the state is an angle that wraps around."""
        return bool(self.turn.isfinite().any())

    # -- actions in and out ---

    def normalise_action(self, action: Tensor, state: Tensor | None = None) -> Tensor:
        """Robot units -> motions, about [-1, 1] by what the data show: (..., A).

        Args:
            state: (..., S) in robot units, at which the action was chosen; needed where commands are targets.
        """
        low, high = self.motion_low, self.motion_high
        return 2 * (action - self._origin(state) - low) / (high - low) - 1

    def denormalise_action(self, action: Tensor, state: Tensor | None = None) -> Tensor:
        """Motions -> robot units: (..., A); the inverse of `normalise_action`."""
        low, high = self.motion_low, self.motion_high
        return self._origin(state) + low + (action + 1) / 2 * (high - low)

    def heard_action(self, action: Tensor, state: Tensor | None = None) -> Tensor:
        """Robot units -> motions as the world model hears them: bounded (..., A)."""
        return self.normalise_action(action, state).clamp(-self.loudest, self.loudest)

    def normalise_motions(self, motion: Tensor) -> Tensor:
        """Motions in robot units, of targets displacements, -> about [-1, 1]: (..., A)."""
        low, high = self.motion_low, self.motion_high
        return 2 * (motion - low) / (high - low) - 1

    def _origin(self, state: Tensor | None) -> Tensor | float:
        """What motions count from: the present state of targets, zero of other commands: (..., A)."""
        if not self.has_targets:
            return 0.0
        if state is None:
            raise ValueError("some commands are targets, which mean nothing without the state; give state=")
        return torch.where(self.is_target, self.seen(state), 0.0)

    def seen(self, state: Tensor) -> Tensor:
        """What the state (..., S), in robot units, shows of each command: (..., A); NaN where it shows nothing."""
        if not len(self.state_names):
            return state.new_full((*state.shape[:-1], len(self.action_low)), torch.nan)
        return torch.where(self._shown_by >= 0, state[..., self._shown_by.clamp(min=0)], torch.nan)

    @property
    def furthest_unanswered(self) -> Tensor:
        """How far each command may go while the state stays as it is: (A,); infinite where that is never told."""
        step = torch.where(
            self.is_target, self.action_step, torch.maximum(self.motion_low.abs(), self.motion_high.abs())
        )
        return torch.where(self.action_varies & ~self.frozen, 2 * self.unanswered + step, torch.inf)

    def unknown(self, n: int) -> Tensor:
        """Actions of which nothing is known, NaN: (n, A)."""
        return torch.full((n, len(self.action_low)), torch.nan, device=self.device)

    def first_action(self, action: Tensor) -> Tensor:
        """What counts as having led to the first frame of an episode: no motion, frozen commands as in `action`.

        Args:
            action: (..., A), or of several ticks side by side (..., K A).
        """
        return self._frozen_or(action, 0.0)

    # -- in range ---

    def clip(self, action: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """An action in the data's range, in robot units (B, A), and which rows left it by more than the tolerance (B,).

        A target also keeps to the displacements that the data show: a larger one is a jump.
        """
        far, low, high = self.beyond(action), self.action_low, self.action_high
        if self.has_targets:
            pose, margin = self.seen(state), TARGET_TOLERANCE * (self.displacement_high - self.displacement_low)
            nearest, furthest = pose + self.displacement_low, pose + self.displacement_high
            far |= self.is_target & ((action < nearest - margin) | (action > furthest + margin))
            # A robot that stands beyond the range of the targets may stay there.
            low = torch.where(self.is_target, torch.maximum(torch.minimum(low, pose), nearest), low)
            high = torch.where(self.is_target, torch.minimum(torch.maximum(high, pose), furthest), high)
        return torch.minimum(torch.maximum(action, low), high), far.any(-1)

    def beyond(self, action: Tensor) -> Tensor:
        """Which commands (..., A) leave the data's range by more than the tolerance, wherever the robot is."""
        return (action < self._least_action) | (action > self._most_action)

    def leaps(self, action: Tensor, before: Sequence[Tensor]) -> Tensor:
        """Whether commands (..., A) change faster than the data show, or change how they change: bool (...,).

        Args:
            before: the last actions, at most two, the latest last.
        """
        far = torch.zeros_like(action, dtype=torch.bool)
        if len(before):
            far |= (action - before[-1]).abs() > self._largest_step
        if len(before) > 1:
            far |= (action - 2 * before[-1] + before[-2]).abs() > self._largest_jerk
        return far.any(-1)

    def hold(self, state: Tensor, told: Tensor | None = None, settled: Tensor | None = None) -> Tensor:
        """What to do when nothing can be known: stay (B, A), in robot units.

        A target stays what was commanded last, if the robot is near it and has settled, so that an arm does not sink
        under its weight and a gripper keeps its grip; else it is what is seen: an arm on its way comes after its
        targets, and would go on to them. A delta or velocity is zero, or the nearest the range allows. Frozen commands
        stay as they were, or as seen.

        Args:
            state: (B, S); numbers that are not usable are NaN.
            told: (B, A), what was commanded last.
            settled: bool (B, A), whether what a target is of stands still; by default it does.

        Returns:
            NaN for targets of which nothing is known.
        """
        seen = self.seen(state)
        told = torch.full_like(seen, torch.nan) if told is None else told
        kept = torch.where(told.isfinite(), told, seen).clamp(self.action_low, self.action_high)
        stays = torch.where(self.frozen & kept.isfinite(), kept, self._still)
        if not self.has_targets:
            return stays
        leap, largest = seen - told, torch.maximum(-self.displacement_low, self.displacement_high)
        far = leap.abs() > self.displacement_scale
        if settled is not None:
            far |= ~settled & seen.isfinite() & ~self.frozen
        # Whichever of the two is wrong, what is told or what is seen, the step is none that the data lack.
        wide = (leap.abs() > largest) & (leap.abs() <= 2 * largest)
        between = torch.where(wide, told + leap.clamp(-largest, largest), seen)
        pose = torch.where(told.isnan() | far, between, told)
        return torch.where(self.is_target, pose, stays)

    @property
    def still(self) -> Tensor:
        """Standing still, inside: (1, A)."""
        unknown = torch.full((1, len(self.state_mean)), torch.nan, device=self.device)
        return self.normalise_motions(torch.where(self.is_target, 0.0, self.hold(unknown)))

    def still_as(self, action: Tensor) -> Tensor:
        """Standing still for as many ticks as an action (..., K A) has, inside; frozen commands as they are there."""
        return self._frozen_or(action, self.still[0])

    def _frozen_or(self, action: Tensor, other: Tensor | float) -> Tensor:
        """An action of several ticks (..., K A) with all but its frozen commands replaced, by (A,) for each tick."""
        ticks = action.unflatten(-1, (-1, len(self.frozen)))
        return torch.where(self.frozen, ticks, other).flatten(-2)

    def moves(self, state: Tensor, before: Tensor) -> Tensor:
        """Whether what each target is of moved from one state (B, S) to the next: bool (B, A)."""
        return self.seen(((state - before).abs() > self.rest).float()) > 0

    # -- states ---

    def normalise_state(self, state: Tensor) -> Tensor:
        """Robot units -> standard deviations from the mean: (..., S)."""
        return (state.float() - self.state_mean) / self.state_std

    def believable(self, state: Tensor, pose: Tensor, missed: Tensor) -> Tensor:
        """Numbers of a state (B, S) that a robot like that of the data can show, after what it showed before.

        Args:
            pose: (B, S), each number as it was read last; NaN before that.
            missed: (B, S), ticks since then in which it could not be read.

        Returns:
            bool (B, S): finite, not absurdly far from the data, and not absurdly far from `pose`. Angles wrap around;
            where one does, what else describes the orientation may leap with it.
        """
        near = state.isfinite() & (state >= self._least_state) & (state <= self._most_state)
        leap = (state - pose).abs()
        largest = self.largest_leap * (1 + missed.clamp(max=MISSED_TICKS))
        if not self.turns:
            return near & ~(leap > largest)
        wrapped = leap > self.turn / 2
        leap = torch.where(wrapped, (self.turn - leap).abs(), leap)
        return near & ~((leap > largest) & (self._is_targets | ~wrapped.any(-1, keepdim=True)))


def _turns(low: Tensor, high: Tensor) -> Tensor:
    """A full turn of each number that is an angle which wraps around, infinite of others: (S,)."""
    turn = torch.full_like(low, torch.inf)
    for full in FULL_TURNS:
        width, signed = high - low, (low >= -1.01 * full / 2) & (high <= 1.01 * full / 2)
        unsigned = (low >= -0.01 * full) & (high <= 1.01 * full)
        turn = torch.where((width > TURNED * full) & (signed | unsigned), full, turn)
    return turn
