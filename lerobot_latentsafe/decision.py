"""Filter laws: given a value, decide whether a proposed action passes. Pure and batched."""

import math
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum

import numpy as np
import torch
from torch import Tensor

LAWS = ("reachability", "nearest", "risk", "plan", "margin", "guard")
CRITICS = {"reachability": "reachability", "nearest": "reachability", "risk": "risk"}
"""Laws that read a critic -> what that must have been trained for."""
MODES = ("filter", "monitor")
ENGINES = ("torch", "onnx")
ANSWERS = ("warn", "slow", "hold", "hand_over")
"""What may be done about what is unknown."""
SLOW = 0.5
"""Share of a motion that remains of it where things are unknown and the law says `slow`."""
LONG_AGO_MS = 1000.0
"""What was seen so long ago says nothing of a robot that moves."""
RECENT = 10
"""Steps whose overrides count for `retreat_after`."""
ADJUSTED_AT_MOST = 3
"""Of these steps, by the law `nearest` where a retreat is known: V is the same for waiting at a doubtful place as for
leaving it, so whoever only ever takes the nearest action that passes stays there."""


class Reason(IntEnum):
    """Why a decision fell as it did; anything but PASSED means the proposed action was not found safe."""

    PASSED = 0
    UNSAFE_VALUE = 1
    VALUE_NOT_FINITE = 2
    OBSERVATION_NOT_FINITE = 3
    OBSERVATION_MISSING = 4
    OBSERVATION_STALE = 5
    ACTION_NOT_FINITE = 6
    ACTION_OUT_OF_RANGE = 7
    DEADLINE_MISSED = 8
    BASE_POLICY_FAILED = 9
    NO_BASE_POLICY = 10
    WRONG_RATE = 11
    OBSERVATION_OUT_OF_RANGE = 12
    OBSERVATION_MALFORMED = 13
    OBSERVATION_UNFAMILIAR = 14
    ACTION_JUMPS = 15
    FILTER_FAILED = 16
    UNKNOWN_APPEARANCE = 17
    UNKNOWN_DYNAMICS = 18


@dataclass
class LawOptions:
    """Changes of a filter's law; what is not given stays as it is. See `LawConfig`."""

    name: str | None = None
    """reachability, nearest, risk, plan, margin or guard."""
    epsilon: float | None = None
    """The fallback acts where V is at or below this threshold."""
    resume_above: float | None = None
    """Once the fallback acts, the base policy acts again where V is above this."""
    proposal_steps: int | None = None
    """Imagined steps for which the proposed action is held before V is read."""
    lookahead: int | None = None
    """Imagined steps after those, before the critic's value is read; 0: the critic alone."""
    samples: int | None = None
    """Futures that a stochastic world model draws, of which the worst counts; 0: its mean or mode."""
    history_frames: int | None = None
    """Frames that the filter remembers at most; 0: the whole episode."""
    retreat: dict[str, float] | None = None
    """Command -> robot units a step, such as {delta_z.pos: -0.006}: a motion that leads back to safety."""
    retreat_after: int | None = None
    """Overrides in the last ten steps after which the next override is the retreat's."""
    min_retreat_steps: int | None = None
    """Steps for which a retreat goes on at least."""
    max_retreat_steps: int | None = None
    """Steps for which a retreat goes on at most, before the critic's action has its turn; 0: till something passes."""
    kappa: float | None = None
    """Law nearest: V of what is executed is at most so far below V of the safest candidate."""
    replan_above: float | None = None
    """Law nearest: the base policy plans anew after a larger change, in standardised units."""
    deadline_ms: float | None = None
    """A decision that took longer than this is not trusted, be the observation fresh or not."""
    slack_ms: float | None = None
    """By so much an observation may be older than a period when the action leaves."""
    mode: str | None = None
    """filter, or monitor, which never acts and reports what it would have done."""
    engine: str | None = None
    """What computes: torch, or graphs of ONNX Runtime, which take half the time or less (for one robot on the CPU)."""
    unknown: str | None = None
    """What is done where the monitor of the unknown alarms: warn, slow, hold or hand_over."""


@dataclass
class LawConfig:
    """When the filter acts, and what it does then. A user may change all of it.

    Attributes:
        name: what V is, and what is done where it is too low. `reachability` falls back. `nearest` has the same V, and
            executes the nearest action to the proposal that passes, if it finds one. The others are baselines: `risk`,
            which needs a critic trained for it, `plan`, which imagines holding each action, and `margin`, which reads l
            alone and stands still. `guard` has no V: it checks ranges, cameras and times alone, and stays where
            something is wrong.
        epsilon: the fallback acts where V of the predicted next latent is at or below this threshold. A risk critic's V
            is -risk, so SQRL's threshold of 0.1 is an epsilon of -0.1.
        resume_above: once the fallback has acted, the base policy acts again only where V is above this, if that is
            more than epsilon. A policy that is stopped at every second step shakes what the fallback holds.
        proposal_steps: ticks for which the proposed action is imagined held before V is read. 1 is the paper's law;
            more leave time for what the world model gets wrong, which a saturated margin cannot.
        lookahead: ticks of imagination before the critic's value is read, 0 to 25: V and the fallback are the best of
            the critic's policy and of holding each action. 0 is the critic alone, and the cheapest.
        samples: next latents drawn from a stochastic world model, of which the worst counts; 0 imagines its mean or
            mode. If any, the critic is trained on drawn latents, too.
        history_frames: frames that the filter remembers at most, and at least half as many; 0: the whole episode. A
            recurrent world model may make anything of more frames than a clip of its training has.
        retreat: a motion that is known to lead back to safety, command -> robot units a step, such as
            {delta_z.pos: -0.006}; it acts where the critic's action did not help. V, the worst of all times, is the
            same for waiting at a doubtful place as for leaving it, so the critic may wait.
        retreat_after: overrides in the last ten steps after which the next override is the retreat's.
        min_retreat_steps: steps for which a retreat goes on at least: a single step leads nowhere.
        max_retreat_steps: steps after which a retreat has failed, such as that of a hand that stands on the table; then
            the critic's action has its turn until an action passes. 0: it goes on as long as nothing passes.
        kappa: of the law `nearest`: among candidates that pass, those whose V is more than this below the safest one's
            are not taken. 0 takes the safest; 2, the width of all values, asks no more than to pass.
        replan_above: of the law `nearest`: a change of the proposal by more than this makes the base policy plan anew,
            as an override does. In standardised units: half the range that the data show of a command is 1.
        deadline_ms: if set, a decision that took longer is not trusted, be the observation fresh or not.
        slack_ms: by so much an observation may be older than a period of the data's rate when the action leaves.
            Beyond that nothing passes.
        mode: `filter` overrides unsafe actions; `monitor` only reports what it would have done.
        engine: what computes a decision: `torch`; or `onnx`, graphs that ONNX Runtime runs in half the time or less,
            for one robot on the CPU. They are made when the filter is loaded, in seconds, and are compared with torch,
            which decides wherever there is none. V is the same to four digits.
        unknown: what is done where the monitor of the unknown alarms, of a filter that has one. `hold` takes it for a
            fault: the robot stays, or the fallback acts where staying is not found safe. `hand_over` does the same, and
            the decision asks for a person. `slow` lets half of each motion pass, `warn` all of it. Each of them warns.
    """

    name: str = "reachability"
    epsilon: float = 0.0
    resume_above: float = -1.0
    proposal_steps: int = 1
    lookahead: int = 15
    samples: int = 0
    history_frames: int = 0
    retreat: dict[str, float] = field(default_factory=dict)
    retreat_after: int = 0
    min_retreat_steps: int = 1
    max_retreat_steps: int = 0
    kappa: float = 0.2
    replan_above: float = 0.25
    deadline_ms: float | None = None
    slack_ms: float = 0.0
    mode: str = "filter"
    engine: str = "torch"
    unknown: str = "hold"

    def __post_init__(self) -> None:
        expected = {
            "name": (self.name in LAWS, f"one of {', '.join(LAWS)}"),
            "mode": (self.mode in MODES, f"one of {', '.join(MODES)}"),
            "engine": (self.engine in ENGINES, f"one of {', '.join(ENGINES)}"),
            "unknown": (self.unknown in ANSWERS, f"one of {', '.join(ANSWERS)}"),
            "lookahead": (0 <= self.lookahead <= 25, "0 (critic alone) to 25 imagined ticks"),
            "proposal_steps": (1 <= self.proposal_steps <= 25, "1 (the paper's law) to 25 steps"),
            "retreat_after": (0 <= self.retreat_after <= RECENT, f"0 (retreat at once) to {RECENT} overrides"),
            "min_retreat_steps": (self.min_retreat_steps >= 1, "at least 1 step"),
            "max_retreat_steps": (
                self.max_retreat_steps == 0 or self.max_retreat_steps >= self.min_retreat_steps,
                f"0 (no end), or at least the {self.min_retreat_steps} of min_retreat_steps",
            ),
            "kappa": (0 <= self.kappa <= 2, "0 (the safest candidate) to 2 (any that passes)"),
            "replan_above": (0 <= self.replan_above < math.inf, "a distance in standardised units, 0 or more"),
            "history_frames": (self.history_frames == 0 or self.history_frames >= 2, "0 (all) or at least 2 frames"),
            "resume_above": (self.resume_above < 1, "less than 1, which V never exceeds"),
            "samples": (self.samples >= 0, "0 (mean or mode) or a number of draws"),
            "epsilon": (not math.isnan(self.epsilon), "a number; V is between -1 and 1"),
            "deadline_ms": (self.deadline_ms is None or self.deadline_ms > 0, "milliseconds, or none"),
            "slack_ms": (0 <= self.slack_ms < math.inf, "milliseconds, 0 or more"),
        }  # fmt: skip
        for name, (fits, what) in expected.items():
            if not fits:
                raise ValueError(f"--policy.law.{name} is {getattr(self, name)!r}; expected {what}")
        if self.name == "risk" and self.lookahead:
            raise ValueError(
                f"--policy.law.lookahead is {self.lookahead}; a risk is read at the next latent: expected 0 with "
                "law 'risk'"
            )

    def changed(self, options: LawOptions) -> "LawConfig":
        """This law with those of these options that are given.

        Raises:
            ValueError: what results is no law.
        """
        given = {f.name: value for f in fields(options) if (value := getattr(options, f.name)) is not None}
        return replace(self, **given)

    @property
    def critic(self) -> str | None:
        """What a critic that this law reads must have been trained for; None if it reads none."""
        return CRITICS.get(self.name)

    @property
    def stops_at_the_unknown(self) -> bool:
        """Whether nothing passes where things are unknown."""
        return self.unknown in ("hold", "hand_over")

    @property
    def disarmed(self) -> str | None:
        """In words, if what the filter does has nothing to do with what it sees, by these settings."""
        if self.mode == "monitor":
            return "it is a monitor, which reports and never acts"
        if self.name != "guard" and self.epsilon <= -1:
            return f"epsilon is {self.epsilon:g}, and V is never that low: no value makes it act"
        if self.name != "guard" and self.epsilon >= 1:
            return f"epsilon is {self.epsilon:g}, and V is never above that: it always acts"
        if self.slack_ms >= LONG_AGO_MS:
            return f"slack_ms is {self.slack_ms:g}: an observation of long ago counts as fresh"
        return None

    def passes_nothing_more_than(self, other: "LawConfig") -> bool:
        """Whether every action that passes under this law passes under the other, too, which decides on the same V.

        What the law `nearest` puts in place of a proposal has passed as one.
        """
        ordered = ("epsilon", "resume_above", "min_retreat_steps")
        stricter = all(getattr(self, name) >= getattr(other, name) for name in ordered)
        in_time = other.deadline_ms is None or (self.deadline_ms is not None and self.deadline_ms <= other.deadline_ms)
        in_time &= self.slack_ms <= other.slack_ms
        free = [*ordered, "deadline_ms", "slack_ms", "mode", "engine", "kappa", "replan_above"]
        free += ["name"] if self.critic is not None and self.critic == other.critic else []
        alike = replace(self, **{name: getattr(other, name) for name in free}) == other
        return self.mode == "filter" and alike and stricter and in_time


@dataclass
class FilterDecision:
    """One decision for each row of a batch; actions in robot units.

    Attributes:
        action: (B, A), what to execute: the proposal, clipped into the data's range; or the nearest action to it that
            passes; or the fallback.
        proposed: (B, A), what the base policy wanted.
        value: (B,), V of the latent predicted under the proposed action.
        margin: (B,), l of the current latent; negative means it looks like a failure already.
        unsafe: bool (B,), the law's verdict on the proposed action.
        intervened: bool (B,), whether the filter acts, so that `action` is not the policy's; never in monitor mode.
        reason: int64 (B,), a `Reason`.
        adjusted: bool (B,), whether `action` is the nearest one to the proposal that passes, by the law `nearest`.
            Where the filter acts and this is false, the fallback acts.
        heard: (B, A), the action that was judged, as the world model heard it; of faulty rows that is to stay. None
            where there is none that hears, by the law of a guard.
        unknown: (B,), how strange things are, as a share of the monitor's threshold: above 1 it alarms. None without a
            monitor.
        hand_over: bool (B,), whether a person is asked to take over; None without a monitor.
        drift: (B,), the evidence E that this session's episodes are not as those that the monitor was fitted on; None
            without a monitor.
    """

    action: Tensor
    proposed: Tensor
    value: Tensor
    margin: Tensor
    unsafe: Tensor
    intervened: Tensor
    reason: Tensor
    adjusted: Tensor
    heard: Tensor | None = None
    unknown: Tensor | None = None
    hand_over: Tensor | None = None
    drift: Tensor | None = None

    @property
    def falls_back(self) -> Tensor:
        """Where the fallback acts: bool (B,)."""
        return self.intervened & ~self.adjusted

    def to(self, device: torch.device) -> "FilterDecision":
        """The same, on a device."""
        if self.action.device == device:
            return self
        numbers = {name: None if value is None else value.to(device) for name, value in vars(self).items()}
        return FilterDecision(**numbers)


def heeding(decision: FilterDecision, alarms: np.ndarray, law: LawConfig, slowed: np.ndarray) -> FilterDecision:
    """A decision on the host, with the alarms of a law that stops nothing because of them.

    Args:
        alarms: (B,), a `Reason` each; the rows whose proposal passes get it.
        slowed: (B, A) in robot units, what remains of the proposals by the answer `slow`.
    """
    if law.stops_at_the_unknown or not alarms.any():
        return decision
    reason = or_else(decision.reason.numpy(), alarms)
    passes = (decision.reason.numpy() == Reason.PASSED) & (alarms != Reason.PASSED)
    slows = passes[:, None] & (law.unknown == "slow") & (law.mode == "filter")
    action = torch.from_numpy(np.where(slows, slowed, decision.action.numpy()))
    return replace(
        decision, action=action, unsafe=torch.from_numpy(reason != Reason.PASSED), reason=torch.from_numpy(reason)
    )


def adjusting(decision: FilterDecision, nearest: np.ndarray) -> FilterDecision:
    """A decision on the host, with the nearest actions that pass in place of the fallback for proposals that do not.

    Whatever else is wrong with a row, the fallback acts.

    Args:
        nearest: (B, A) in robot units; NaN where there is none.
    """
    found = np.isfinite(nearest).all(-1) & (decision.reason.numpy() == Reason.UNSAFE_VALUE)
    adjusted = found & decision.intervened.numpy()
    action = np.where(adjusted[:, None], nearest, decision.action.numpy())
    return replace(decision, action=torch.from_numpy(action), adjusted=torch.from_numpy(adjusted))


class Overrides:
    """What the law's threshold and its retreat depend on: in which of the last steps the fallbacks of B robots acted.

    Attributes:
        recent: bool (B, RECENT), whether the fallback acted, the latest last.
        retreated: int64 (B,), steps of a retreat that goes on.
        failed: bool (B,), whether a retreat went on for as long as it may, and nothing has passed since.
        adjusted: bool (B, RECENT), whether the nearest action that passes was taken, the latest last.
    """

    def __init__(self, n: int):
        self.recent, self.retreated = np.zeros((n, RECENT), bool), np.zeros(n, np.int64)
        self.adjusted, self.failed = np.zeros((n, RECENT), bool), np.zeros(n, bool)

    def threshold(self, law: LawConfig) -> np.ndarray:
        """What V must exceed (B,): epsilon, and `resume_above` where the fallback acts. Infinite for the first
        `min_retreat_steps` steps of a retreat."""
        threshold = np.where(self.recent[:, -1], np.float32(max(law.epsilon, law.resume_above)), law.epsilon)
        return np.where((self.retreated > 0) & (self.retreated < law.min_retreat_steps), np.inf, threshold)

    def retreats(self, law: LawConfig) -> np.ndarray:
        """Whether an override now would be the retreat's: one goes on, or the critic's action has been tried: (B,)."""
        tried = self.recent.sum(1) >= law.retreat_after
        return ((self.retreated > 0) | tried) & ~self.failed if law.retreat else np.zeros_like(tried)

    def may_adjust(self, law: LawConfig) -> np.ndarray:
        """Whether the nearest action that passes may be taken, or it was often enough that the retreat is due: (B,)."""
        return ~((self.adjusted.sum(1) >= ADJUSTED_AT_MOST) & bool(law.retreat))

    def after(self, law: LawConfig, acts: np.ndarray, retreats: np.ndarray, adjusted: np.ndarray) -> "Overrides":
        """One step on: whether the fallback acted, whether that was the retreat's, and whether the nearest action that
        passes was taken, bool (B,) each."""
        new = Overrides(len(acts))
        new.recent[:, :-1], new.recent[:, -1] = self.recent[:, 1:], acts
        new.adjusted[:, :-1], new.adjusted[:, -1] = self.adjusted[:, 1:], adjusted
        new.retreated = (self.retreated + 1) * (acts & retreats)
        at_its_end = (new.retreated >= law.max_retreat_steps) & (law.max_retreat_steps > 0)
        new.failed = acts & (self.failed | at_its_end)
        return new


def least_restrictive(
    proposed: np.ndarray,
    fallback: np.ndarray,
    value: np.ndarray,
    margin: np.ndarray,
    epsilon: float | np.ndarray,
    fault: np.ndarray | None = None,
    monitor: bool = False,
    passing: np.ndarray | None = None,
) -> FilterDecision:
    """The paper's law: pass the proposed action if V > epsilon at its predicted next latent, else fall back.

    Args:
        proposed, fallback: (B, A) in robot units.
        value: (B,) V of the next latent; a value that is not finite is never safe.
        margin: (B,) l of the current latent.
        epsilon: threshold, or one for each row (B,).
        fault: (B,) a `Reason` for rows that must not pass whatever their value; 0 elsewhere.
        monitor: judge, but let every action through.
        passing: (B, A), what of the proposal is executed if it passes; by default all.

    Returns:
        The decision, on the host.
    """
    reason = np.where(value > epsilon, Reason.PASSED, Reason.UNSAFE_VALUE)
    reason = np.where(np.isfinite(value), reason, Reason.VALUE_NOT_FINITE)
    return _choose(
        proposed, fallback, value, margin, reason if fault is None else or_else(fault, reason), monitor, passing
    )


def by_checks_alone(
    proposed: np.ndarray,
    hold: np.ndarray,
    fault: np.ndarray,
    monitor: bool = False,
    passing: np.ndarray | None = None,
) -> FilterDecision:
    """The law of a guard: pass what has no fault, else stay. Nothing is known of V and l, which are NaN.

    Args:
        proposed, hold, passing: (B, A) in robot units, see `least_restrictive`.
        fault: (B,), a `Reason`.
    """
    unknown = np.full(len(fault), np.nan, np.float32)
    return _choose(proposed, hold, unknown, unknown, fault, monitor, passing)


def _choose(
    proposed: np.ndarray, fallback: np.ndarray, value: np.ndarray, margin: np.ndarray, reason: np.ndarray,
    monitor: bool, passing: np.ndarray | None,
) -> FilterDecision:  # fmt: skip
    """Pass what nothing is wrong with, else fall back."""
    unsafe = reason != Reason.PASSED
    intervened = np.zeros_like(unsafe) if monitor else unsafe
    passing = proposed if monitor or passing is None else passing
    action = np.where(intervened[:, None], fallback, passing)
    adjusted = np.zeros_like(unsafe)
    return FilterDecision(
        *map(torch.from_numpy, (action, proposed, value, margin, unsafe, intervened, reason, adjusted))
    )


def or_else(fault: np.ndarray, found: np.ndarray | int) -> np.ndarray:
    """The faults (B,), and of rows that have none what was found later: a `Reason` for each (B,), or for all."""
    return np.where(fault == Reason.PASSED, found, fault)


def first_of(found: dict[Reason, np.ndarray]) -> np.ndarray:
    """The first reason that holds for each row, or PASSED: int64 (B,) of bool (B,) for each reason, in order."""
    first = np.zeros(next(iter(found.values())).shape, np.int64)
    for reason in reversed(found):
        first[found[reason]] = reason
    return first
