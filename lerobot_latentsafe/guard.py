"""The guard: what is wrong with what robots show, and with what they are to do, by the data they were trained on.

It needs no world model. Each rule has its place here: shape and scale, finite, in range, seen, in time; and where the
answer is to stay, what that is. A shield is a guard with a world model. Pictures are tensors, as the model takes them;
all other numbers are NumPy's, on the host.
"""

import copy
import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_latentsafe.decision import Reason, first_of, or_else
from lerobot_latentsafe.host import all_of, any_of, on_host
from lerobot_latentsafe.limits import Limits, differs
from lerobot_latentsafe.looks import SIDE, Cameras, Response
from lerobot_latentsafe.pictures import check_proportions, extremes, surely_colours
from lerobot_latentsafe.safety_model import SafetyModel

logger = logging.getLogger(__name__)

PAUSE_S = 1.0
"""After a pause between two decisions longer than this, what was seen before says nothing: the history starts anew."""
COLOUR_TOLERANCE = 1e-3
"""By so much the numbers of a picture may leave [0, 1], for float errors."""

UNSEEN = (
    Reason.OBSERVATION_MALFORMED, Reason.OBSERVATION_NOT_FINITE, Reason.OBSERVATION_MISSING, Reason.OBSERVATION_STALE,
    Reason.OBSERVATION_OUT_OF_RANGE, Reason.OBSERVATION_UNFAMILIAR, Reason.FILTER_FAILED, Reason.UNKNOWN_APPEARANCE,
)  # fmt: skip
"""What is wrong with observations that a world model must not see."""


class UnknownPoseError(RuntimeError):
    """Nobody knows where the robot is, and it takes positions: there is no command that is known to be harmless."""


# -- in time ---


def standing_still() -> float:
    """The clock of a simulation that waits for whoever acts: nothing is ever late."""
    return 0.0


class Pace:
    """When decisions come, and how old what they are made on may be when the action leaves.

    Attributes:
        period: seconds between two frames of the data.
        strict: whether a loop of another rate than the data's is no ground to decide on, as with every real robot.
        slack_s: seconds by which an observation may be older than a period, beyond what the law allows.
        paused: whether the present decision comes after a pause, so that what was seen before says nothing.
    """

    def __init__(self, fps: float):
        self.period, self.strict, self.slack_s = 1.0 / fps, False, 0.0
        self.forget()

    def forget(self) -> None:
        """Start an episode."""
        self.times: deque[float] = deque(maxlen=3)
        self.paused = False

    def oldest(self, slack_ms: float, n: int = 1) -> float:
        """Seconds that an observation may be old at most: a period for each of n robots that one call decides for."""
        return n * self.period + self.slack_s + slack_ms / 1e3

    def tick(self, now: float, slack_ms: float) -> Reason:
        """Note that a decision begins at `now`, seconds, and tell whether they come at the rate of the data."""
        gap = now - self.times[-1] if self.times else 0.0
        self.paused = not -1e-9 <= gap <= PAUSE_S  # a clock that went back, or is no number, tells no pause either
        if self.paused:
            self.times.clear()
        self.times.append(now)
        if not self.strict:
            return Reason.PASSED
        late = gap > 2 * self.period + self.slack_s + slack_ms / 1e3
        hasty = 0 < gap < self.period / 10 or (len(self.times) == 3 and now - self.times[0] < self.period)
        return Reason.WRONG_RATE if self.paused or late or hasty else Reason.PASSED


# -- seen, and told ---


@dataclass(frozen=True)
class Seen:
    """What remains of an observation.

    Attributes:
        images: key -> (B, 3, H, W), as the model takes them.
        state: (B, S) in robot units; numbers that are not usable are NaN.
        fault: (B,), the first thing that is wrong, a `Reason`.
    """

    images: dict[str, Tensor]
    state: np.ndarray
    fault: np.ndarray


def check_plan(limits: Limits, plan: np.ndarray, before: Sequence[np.ndarray] = ()) -> np.ndarray:
    """What is wrong with each of the actions that are planned, as far as that can be told before they are due.

    Args:
        plan: (B, N, A) in robot units.
        before: the last actions (B, A) before them, at most two, the latest last.

    Returns:
        (B, N), a `Reason` each.
    """
    actions = np.concatenate([*(action[:, None] for action in before), plan], 1)
    leaps = np.zeros(actions.shape[:2], bool)
    leaps[:, 1:] |= limits.leaps(actions[:, 1:], [actions[:, :-1]])
    leaps[:, 2:] |= limits.leaps(actions[:, 2:], [actions[:, :-2], actions[:, 1:-1]])
    return first_of(
        {
            Reason.ACTION_NOT_FINITE: ~all_of(np.isfinite(plan)),
            Reason.ACTION_OUT_OF_RANGE: any_of(limits.beyond(plan)),
            Reason.ACTION_JUMPS: leaps[:, len(before) :],
        }
    )


class Guard:
    """Checks what a batch of robots shows and is told, remembering what they showed and were told before.

    Attributes:
        pose: (B, S) in robot units, the last usable reading of each number of the state; NaN before there was one.
        missed: (B, S), ticks since then.
        unwound: (B, S), what takes out of the state that angles wrapped around since the episode began.
        told: (B, A) in robot units, what the robots were told last.
        moving: bool (B, A), whether what each target is of has moved since the last tick; None without targets.
        stay: (B, A) in robot units, what would have been to stay at the last tick.
        holding: bool (B, A), commands that were told to stay.
        inputs: keys of an observation that are read.
        begun: whether an observation of this robot has been seen, so that a foreign one is a fault and no mistake of
            whoever set it up.
    """

    def __init__(self, model: SafetyModel):
        self.model, self.limits, limits = model, model.limits, model.limits
        self.cameras = Cameras(model.world_model.image_keys, model.config.trained_on.looks)
        self.response = Response(limits.rest, limits.adds_up, limits.furthest_unanswered)
        # What is averaged for the model serves the cameras, too, if its size is a multiple of theirs.
        self._whole = model.config.world_model.image_size % SIDE == 0
        self.inputs, self.begun, self._rows = model.inputs, False, 1
        self._said: set[tuple[str, str]] = set()
        self.reset()

    def reset(self) -> None:
        """Forget what was seen and told: call at the start of every episode."""
        self.cameras.reset()
        self.response.reset()
        self.pose: np.ndarray | None = None
        self.missed: np.ndarray | None = None
        self.unwound: np.ndarray | None = None
        self.told: np.ndarray | None = None
        self.moving: np.ndarray | None = None
        self.stay: np.ndarray | None = None
        self.holding: np.ndarray | None = None
        self._proposals: deque[np.ndarray] = deque(maxlen=2)

    def observe(self, observation: dict[str, Any]) -> Seen:
        """Check what the robots show, and remember their state.

        Args:
            observation: LeRobot batch: images (B, C, H, W) in [0, 1], observation.state (B, S) in robot units.

        Raises:
            KeyError, ValueError: the very first observation is none of this robot, or the number of robots changed.
        """
        n, broken = self._check_shapes(observation)
        given = {key: value for key, value in observation.items() if key not in broken}
        state, finite, believed = self._see_state(given, n)
        pictures, malformed, numbers = self._see_pictures(given, n)
        images = {key: self.model.images(picture) for key, picture in pictures.items()}
        fault = first_of(
            {
                Reason.OBSERVATION_MALFORMED: malformed,
                Reason.OBSERVATION_NOT_FINITE: ~(finite & numbers),
                Reason.OBSERVATION_OUT_OF_RANGE: ~believed,
                **self._compare(pictures, images, state),
            }
        )
        for reason in reversed(broken.values()):  # of all robots
            fault = np.full_like(fault, reason)
        self.response.see(state, self.limits.unknown(n) if self.told is None else self.told)
        self.begun, self._rows = True, n
        return Seen(images, state, fault)

    def _compare(
        self, pictures: dict[str, Tensor], images: dict[str, Tensor], state: np.ndarray
    ) -> dict[Reason, np.ndarray]:
        """What is wrong beside the data's pictures, and beside what was shown and told before: bool (B,) each."""
        if not pictures:
            return {}
        sides = {key: min(picture.shape[-2:]) for key, picture in pictures.items()}
        dead, unfamiliar, thumbnails = self.cameras.check(images if self._whole else pictures, sides)
        old = self.cameras.repeats(thumbnails, self.limits.deviations(state + self.unwound))
        if (dead | unfamiliar).any():
            self.say_once("; ".join(self.cameras.wrong))
        return {
            Reason.OBSERVATION_MISSING: dead,
            Reason.OBSERVATION_UNFAMILIAR: unfamiliar,
            Reason.OBSERVATION_STALE: old,
        }

    def _see_state(self, given: dict[str, Any], n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The usable numbers of the state (B, S), whether all are finite (B,), and whether all are believed (B,)."""
        limits, size = self.limits, (n, len(self.limits.state_names))
        if OBS_STATE in given and limits.state_names:
            state = on_host(given[OBS_STATE])
            finite = all_of(np.isfinite(state))
        else:  # what is wrong is said already
            state, finite = np.full(size, np.nan, np.float32), np.ones(n, bool)
        if self.pose is None:
            self.pose = np.full_like(state, np.nan)
            self.missed, self.unwound = np.zeros_like(state), np.zeros_like(state)
        usable = limits.believable(state, self.pose, self.missed)
        state = np.where(usable, state, np.nan)
        self.unwound = self.unwound - limits.wrapped(state, self.pose)
        self.moving = limits.moves(state, self.pose) if limits.has_targets else None
        self.pose, self.missed = np.where(usable, state, self.pose), (self.missed + 1) * ~usable
        return state, finite, all_of(usable)

    def _see_pictures(self, given: dict[str, Any], n: int) -> tuple[dict[str, Tensor], np.ndarray, np.ndarray]:
        """Pictures in [0, 1], whether what any camera shows are no colours (B,), and whether all are numbers (B,)."""
        model, pictures = self.model, {}
        for key in self.cameras.keys:
            if key in given:
                pictures[key] = model.place(given[key])
            else:  # that is said already
                pictures[key] = torch.zeros(n, *model.config.input_features[key].shape, device=model.device)
        doubtful = [picture for picture in pictures.values() if not surely_colours(picture)]
        if not doubtful:
            return pictures, np.zeros(n, bool), np.ones(n, bool)
        least, most = np.stack([extremes(picture) for picture in doubtful], 1)
        numbers = np.isfinite(least) & np.isfinite(most)
        colours = (least >= -COLOUR_TOLERANCE) & (1 - most >= -COLOUR_TOLERANCE)
        if not colours.all():
            pictures = {key: picture.nan_to_num(0.0).clamp(0, 1) for key, picture in pictures.items()}
        return pictures, any_of(numbers & ~colours, 0), all_of(numbers, 0)

    def _check_shapes(self, observation: dict[str, Any]) -> tuple[int, dict[str, Reason]]:
        """The number of robots, and what is wrong with inputs that cannot be used at all."""
        missing = [key for key in self.inputs if observation.get(key) is None]
        wrong = {key: self._wrong_shape(key, observation[key]) for key in self.inputs if key not in missing}
        rows = {key: len(observation[key]) for key, why in wrong.items() if why is None}
        n = len(self.pose) if self.pose is not None else next(iter(rows.values()), self._rows)
        if not missing and all(count == n for count in rows.values()) and len(rows) == len(self.inputs):
            return n, {}
        if self.pose is not None and rows and set(rows.values()).isdisjoint({n}):
            raise ValueError(
                f"the batch went from {n} to {next(iter(rows.values()))} robots within an episode; "
                "call reset() between episodes"
            )
        for key, count in rows.items():
            if count != n:
                wrong[key] = f"{key} is of {count} robots, expected {n}"
        if missing and not self.begun:
            raise KeyError(self._lacks(missing, observation))
        explained = [why for why in wrong.values() if why]
        if explained and not self.begun:
            raise ValueError(explained[0])
        for why in [*([self._lacks(missing, observation)] if missing else []), *explained]:
            self.say_once(why)
        malformed = {key: Reason.OBSERVATION_MALFORMED for key, why in wrong.items() if why}
        return n, malformed | dict.fromkeys(missing, Reason.OBSERVATION_MISSING)

    def _wrong_shape(self, key: str, value: Any) -> str | None:
        """What is wrong with the type and shape of an input, if anything."""
        if not isinstance(value, Tensor) or not _holds_numbers(value):
            return f"{key} is {_kind(value)}, expected a tensor of numbers"
        if key == OBS_STATE:
            size = len(self.limits.state_names)
            fits = value.dim() == 2 and value.shape[1] == size
            return None if fits else f"{key} has shape {tuple(value.shape)}, expected (robots, {size})"
        if not value.is_floating_point() or value.dim() != 4 or not value.numel():
            return (
                f"{key} has shape {tuple(value.shape)} of {value.dtype}, expected (robots, channels, height, width) of "
                "floats in [0, 1]"
            )
        try:
            check_proportions(key, tuple(value.shape[1:]), self.model.config.input_features[key].shape)
        except ValueError as e:
            return str(e)
        return None

    def _lacks(self, missing: list[str], observation: dict[str, Any]) -> str:
        got = ", ".join(key for key in map(str, observation) if key.startswith("observation"))
        return (
            f"observation lacks {', '.join(missing)}; this filter was trained on {', '.join(self.inputs)}. "
            f"Got {got}. Rename the camera or state (--rename_map), or train a filter for this robot"
        )

    # -- what the robots are to do ---

    def check_action(
        self, proposed: Any, fault: np.ndarray, hold: np.ndarray, missing_reason: Reason, planned: Any = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Faults, the proposal and what of it lies in the data's range: (B,), (B, A), (B, A) in robot units.

        Args:
            proposed: a tensor (B, A) in robot units, or None.
            planned: a tensor (B, N, A) in robot units, what is to come after the proposal, if that is known.
        """
        if proposed is not None and not self._is_action(proposed, hold):
            proposed, missing_reason = None, Reason.BASE_POLICY_FAILED
        if planned is not None and not self.is_plan(planned, hold):
            proposed = planned = None
            missing_reason = Reason.BASE_POLICY_FAILED
        if proposed is None:
            fault = or_else(fault, missing_reason)
        wanted = hold if proposed is None else on_host(proposed)
        finite = all_of(np.isfinite(wanted))
        clipped, out_of_range = self.limits.clip(np.where(finite[:, None], wanted, hold), self.pose)
        mute = self.response.is_missing(clipped)
        if mute.any():
            self.say_once("the state stays as it is, whatever is sent: the robot goes no further until it changes")
        found = first_of(
            {
                Reason.ACTION_NOT_FINITE: ~finite,
                Reason.ACTION_OUT_OF_RANGE: out_of_range,
                Reason.ACTION_JUMPS: self.limits.leaps(clipped, self._proposals),
                Reason.OBSERVATION_STALE: mute,
            }
        )
        fault = or_else(fault, found)
        if planned is not None:
            fault = or_else(fault, self._check_coming(clipped, on_host(planned)))
        self._proposals.append(clipped)
        return fault, wanted, self._tell_clipped(wanted, clipped, fault)

    @property
    def proposed_before(self) -> list[np.ndarray]:
        """What was proposed before the last proposal, as far as jumps are told by it: (B, A) in robot units each."""
        return [*self._proposals][:-1]

    def _check_coming(self, clipped: np.ndarray, planned: np.ndarray) -> np.ndarray:
        """The first thing that is wrong with any action that is planned to come (B, N, A) after one (B, A): (B,)."""
        coming = check_plan(self.limits, np.concatenate([clipped[:, None], planned], 1))[:, 1:]
        order = (Reason.ACTION_NOT_FINITE, Reason.ACTION_OUT_OF_RANGE, Reason.ACTION_JUMPS)
        return first_of({reason: any_of(coming == reason) for reason in order})

    def _is_action(self, proposed: Any, hold: np.ndarray) -> bool:
        if isinstance(proposed, Tensor) and _holds_numbers(proposed) and proposed.shape == hold.shape:
            return True
        self.say_once(
            f"proposed action is {_kind(proposed)}, expected a tensor of shape {tuple(hold.shape)}: "
            f"{', '.join(self.limits.action_names)}. The base policy must be of the filter's action space"
        )
        return False

    def is_plan(self, planned: Any, hold: np.ndarray | Tensor) -> bool:
        """Whether these are actions to come (B, N, A) of robots that one action (B, A) is of; says so once if not."""
        if isinstance(planned, Tensor) and _holds_numbers(planned):
            n, size = hold.shape
            if planned.dim() == 3 and planned.shape[0] == n and planned.shape[2] == size:
                return True
        self.say_once(f"the actions planned are {_kind(planned)}, expected one of (robots, actions, {hold.shape[1]})")
        return False

    def _tell_clipped(self, wanted: np.ndarray, clipped: np.ndarray, fault: np.ndarray) -> np.ndarray:
        """What is executed of proposals that pass; says so once where that is not the proposal itself."""
        if np.array_equal(clipped, wanted):
            return wanted
        beyond = (fault == Reason.PASSED)[:, None] & differs(clipped, wanted)
        if beyond.any():
            names = ", ".join(name for name, any_row in zip(self.limits.action_names, beyond.any(0)) if any_row)
            self.say_once("the policy leaves the range of the data a little; what is executed is clipped", names)
        return np.where(beyond, clipped, wanted)  # others pass to the bit

    def hold(self, state: np.ndarray) -> np.ndarray:
        """Stay: (B, A) in robot units.

        Args:
            state: (B, S); numbers that are not usable are NaN.

        Raises:
            UnknownPoseError: commands are positions, and the robots showed no usable state and were told nothing yet.
        """
        settled = None
        if self.moving is not None:
            settled = ~self.moving if self.holding is None else ~self.moving | self.holding
        hold = self.limits.hold(state, self.told, settled)
        if not np.isfinite(hold).all() and self.model.config.law.mode != "monitor":
            raise UnknownPoseError(
                "the first observation of the episode shows no usable state, and these commands are positions: nobody "
                "knows where the robot is, so nothing is commanded. See to the robot's sensors, and start again"
            )
        self.stay = hold
        return hold

    def was_told(self, action: np.ndarray) -> None:
        """Remember (B, A) in robot units as what the robots were told."""
        self.told = action
        self.holding = None if self.stay is None else np.abs(action - self.stay) <= 1e-8 + 1e-5 * np.abs(self.stay)

    def adopt(self, other: "Guard") -> None:
        """Take over what another guard remembers of the same robots."""
        for name in ("pose", "missed", "unwound", "told", "moving", "stay", "holding", "_proposals"):
            setattr(self, name, copy.copy(getattr(other, name)))
        self.cameras.adopt(other.cameras)
        self.response = copy.copy(other.response)

    def say_once(self, what: str, which: str = "") -> None:
        """Warn of something, once."""
        if (what, which) not in self._said:
            self._said.add((what, which))
            logger.warning("%s%s", what, which and f": {which}")


def _holds_numbers(tensor: Tensor) -> bool:
    """Whether a tensor is an array of numbers: none of sparse, quantized or nested ones, nor one without data."""
    plain = tensor.layout == torch.strided and not (tensor.is_quantized or tensor.is_nested or tensor.is_meta)
    return plain and tensor.dtype != torch.bool and not tensor.is_complex()


def _kind(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"a tensor of shape {tuple(value.shape)} of {value.dtype}"
    return type(value).__name__
