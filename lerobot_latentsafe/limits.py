"""Limits of a robot, by the data: what it can show, what it may be told, and what it is to stay.

In NumPy, on the host: a guard asks at every tick. What goes in and out of the models has `Units`.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch

from lerobot_latentsafe.host import QUIET, any_of, on_host
from lerobot_latentsafe.units import TrainedOn, Units

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
NOISE = 1e-5
"""Numbers that differ by a smaller share differ by float noise."""


class Limits:
    """What a robot like that of the data can show, and may be told.

    Args:
        trained_on: limits and ranges.
        units: of the same data.

    Attributes:
        action_names, state_names: of the numbers of `action` and `observation.state`.
        action_low, action_high: (A,), least and largest command of the data.
        is_target, adds_up: bool (A,), commands that are places, and those of which each adds to the ones before.
        frozen, stays: bool (A,), commands that a fallback leaves as they were; and those for which that is to hold.
        rest: (S,), by how much each number of the state may change while it does not move.
    """

    def __init__(self, trained_on: TrainedOn, units: Units):
        self.action_names, self.state_names = units.action_names, units.state_names
        self.action_low, self.action_high = on_host(units.action_low), on_host(units.action_high)
        self.is_target, self.frozen = on_host(units.is_target, torch.bool), on_host(units.frozen, torch.bool)
        self.adds_up = np.array([c.meaning in ("delta", "velocity") for c in trained_on.commands], bool)
        self.stays = self.frozen & (trained_on.meanings is not None)
        self.has_targets = bool(self.is_target.any())
        self._place = on_host(units.shown_by, torch.long)
        self._motionless = on_host(units.motionless)
        self._mean, self._std = on_host(units.state_mean), on_host(units.state_std)
        self._bound_commands(trained_on, units)
        self._bound_state(trained_on)

    def _bound_commands(self, trained_on: TrainedOn, units: Units) -> None:
        """What follows from the ranges of commands alone."""
        n, width = len(self.action_low), self.action_high - self.action_low
        step, unanswered = (_known(getattr(trained_on, name), n, np.inf) for name in ("action_step", "unanswered"))
        self._largest_step = (1 + LEAP_TOLERANCE) * step
        self._largest_jerk = (1 + LEAP_TOLERANCE) * _known(trained_on.action_jerk, n, np.inf)
        margin = np.where(self.is_target, TARGET_TOLERANCE, RANGE_TOLERANCE).astype(np.float32) * width
        self._least_action, self._most_action = self.action_low - margin, self.action_high + margin
        self._nearest = _known(trained_on.displacement_low, n, 0.0)
        self._furthest = _known(trained_on.displacement_high, n, 0.0)
        self._beyond = TARGET_TOLERANCE * (self._furthest - self._nearest)
        self._largest_displacement = np.maximum(-self._nearest, self._furthest)
        self._usual_displacement = _known(trained_on.displacement_scale, n, 1.0)
        motion = np.maximum(np.abs(on_host(units.motion_low)), np.abs(on_host(units.motion_high)))
        moves = on_host(units.action_varies, torch.bool) & ~self.frozen
        self.furthest_unanswered = np.where(moves, 2 * unanswered + np.where(self.is_target, step, motion), np.inf)

    def _bound_state(self, trained_on: TrainedOn) -> None:
        """What follows from the ranges of the state alone."""
        n = len(self._mean)
        low, high = _known(trained_on.state_low, n, -np.inf), _known(trained_on.state_high, n, np.inf)
        step = _known(trained_on.state_step, n, np.inf)
        widest = (high - low).max(initial=0.0)
        width = np.maximum(high - low, 0.1 * widest)
        self._least_state, self._most_state = low - STATE_TOLERANCE * width, high + STATE_TOLERANCE * width
        self._is_targets = np.isin(np.arange(n), self._place[self.is_target])
        leap = STEP_TOLERANCE * np.maximum(step, 0.01 * widest)
        self._largest_leap = np.where(self._is_targets, leap, np.maximum(leap, LEAP_SHARE * width))
        self.rest = AT_REST * step
        self._turn = _turns(low, high)
        self._turns = bool(np.isfinite(self._turn).any())

    # -- what it may be told ---

    def unknown(self, n: int) -> np.ndarray:
        """Actions of which nothing is known, NaN: (n, A)."""
        return np.full((n, len(self.action_low)), np.nan, np.float32)

    def clip(self, action: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """An action in the data's range, in robot units (B, A), and which rows left it by more than the tolerance (B,).

        A target also keeps to the displacements that the data show: a larger one is a jump.
        """
        far, low, high = self.beyond(action), self.action_low, self.action_high
        if self.has_targets:
            pose = self.seen(state)
            nearest, furthest = pose + self._nearest, pose + self._furthest
            far |= self.is_target & ((action < nearest - self._beyond) | (action > furthest + self._beyond))
            # A robot that stands beyond the range of the targets may stay there.
            low = np.where(self.is_target, np.maximum(np.minimum(low, pose), nearest), low)
            high = np.where(self.is_target, np.minimum(np.maximum(high, pose), furthest), high)
        return np.minimum(np.maximum(action, low), high), any_of(far)

    def beyond(self, action: np.ndarray) -> np.ndarray:
        """Which commands (..., A) leave the data's range by more than the tolerance, wherever the robot is."""
        return (action < self._least_action) | (action > self._most_action)

    @QUIET
    def leaps(self, action: np.ndarray, before: Sequence[np.ndarray]) -> np.ndarray:
        """Whether commands (..., A) change faster than the data show, or change how they change: bool (...,).

        Args:
            before: the last actions, at most two, the latest last.
        """
        far = np.zeros(action.shape, bool)
        if len(before):
            far |= np.abs(action - before[-1]) > self._largest_step
        if len(before) > 1:
            far |= np.abs(action - 2 * before[-1] + before[-2]) > self._largest_jerk
        return any_of(far)

    def slowed(self, action: np.ndarray, hold: np.ndarray, share: float) -> np.ndarray:
        """This share of the way from what would be to stay to actions, both (B, A); frozen commands pass."""
        return np.where(self.frozen, action, hold + np.float32(share) * (action - hold))

    def hold(self, state: np.ndarray, told: np.ndarray | None = None, settled: np.ndarray | None = None) -> np.ndarray:
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
        told = np.full_like(seen, np.nan) if told is None else told
        kept = np.where(np.isfinite(told), told, seen).clip(self.action_low, self.action_high)
        stays = np.where(self.frozen & np.isfinite(kept), kept, self._motionless)
        if not self.has_targets:
            return stays
        leap, largest = seen - told, self._largest_displacement
        far = np.abs(leap) > self._usual_displacement
        if settled is not None:
            far |= ~settled & np.isfinite(seen) & ~self.frozen
        # Whichever of the two is wrong, what is told or what is seen, the step is none that the data lack.
        wide = (np.abs(leap) > largest) & (np.abs(leap) <= 2 * largest)
        between = np.where(wide, told + leap.clip(-largest, largest), seen)
        pose = np.where(np.isnan(told) | far, between, told)
        return np.where(self.is_target, pose, stays)

    # -- what it can show ---

    def seen(self, state: np.ndarray) -> np.ndarray:
        """What the state (..., S), in robot units, shows of each command: (..., A); NaN where it shows nothing."""
        if not self.state_names:
            return np.full((*state.shape[:-1], len(self._place)), np.nan, np.float32)
        return np.where(self._place >= 0, state[..., self._place], np.nan)

    def moves(self, state: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Whether what each target is of moved from one state (B, S) to the next: bool (B, A)."""
        return self.seen((np.abs(state - before) > self.rest).astype(np.float32)) > 0

    def deviations(self, state: np.ndarray) -> np.ndarray:
        """Robot units -> standard deviations from the mean: (..., S)."""
        return (state - self._mean) / self._std

    def wrapped(self, state: np.ndarray, pose: np.ndarray) -> np.ndarray | float:
        """By how much angles of a believed state (B, S) leapt from `pose` as they wrapped around; zero of all else."""
        if not self._turns:
            return 0.0
        leap = state - pose
        far = np.abs(leap) > self._largest_leap
        return np.where(far, leap, 0.0) if far.any() else 0.0

    @QUIET
    def believable(self, state: np.ndarray, pose: np.ndarray, missed: np.ndarray) -> np.ndarray:
        """Numbers of a state (B, S) that a robot like that of the data can show, after what it showed before.

        Args:
            pose: (B, S), each number as it was read last; NaN before that.
            missed: (B, S), ticks since then in which it could not be read.

        Returns:
            bool (B, S): finite, not absurdly far from the data, and not absurdly far from `pose`. Angles wrap around;
            where one does, what else describes the orientation may leap with it.
        """
        near = np.isfinite(state) & (state >= self._least_state) & (state <= self._most_state)
        leap = np.abs(state - pose)
        largest = self._largest_leap * (1 + np.minimum(missed, MISSED_TICKS))
        far = leap > largest
        if not self._turns or not far.any():  # what wraps around leaps by less
            return near & ~far
        wrapped = leap > self._turn / 2
        leap = np.where(wrapped, np.abs(self._turn - leap), leap)
        return near & ~((leap > largest) & (self._is_targets | ~wrapped.any(-1, keepdims=True)))


def differs(numbers: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Where numbers are others than those wanted, by more than float noise: bool, of their shape."""
    return np.abs(numbers - wanted) > NOISE * np.maximum(np.abs(wanted), 1)


def _known(numbers: list[float] | None, n: int, otherwise: float) -> np.ndarray:
    return np.full(n, otherwise, np.float32) if numbers is None else np.array(numbers, np.float32)


def _turns(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """A full turn of each number that is an angle which wraps around, infinite of others: (S,)."""
    turn = np.full_like(low, np.inf)
    for full in FULL_TURNS:
        width, signed = high - low, (low >= -1.01 * full / 2) & (high <= 1.01 * full / 2)
        unsigned = (low >= -0.01 * full) & (high <= 1.01 * full)
        turn = np.where((width > TURNED * full) & (signed | unsigned), full, turn)
    return turn
