"""The shield: what stands between any base policy and a robot. A guard, and a world model that looks ahead.

The policy wrapper and every other adapter share this one core. Its rule: nothing that is not finite, fresh, in time,
in range and familiar ever counts as safe; and whatever fails, there is a decision.
"""

import logging
import math
import statistics
import threading
import time
import weakref
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.configuration_latentsafe import SEALED
from lerobot_latentsafe.decision import (
    SLOW,
    FilterDecision,
    Overrides,
    Reason,
    adjusting,
    by_checks_alone,
    first_of,
    heeding,
    least_restrictive,
    or_else,
)
from lerobot_latentsafe.guard import UNSEEN, Guard, Pace, Seen
from lerobot_latentsafe.host import on_host
from lerobot_latentsafe.latent import Belief, Latent, is_sound, map_latent, select
from lerobot_latentsafe.nearest import Asked, Found, Nearest
from lerobot_latentsafe.runtime.malloc import keep_freed_memory
from lerobot_latentsafe.runtime.time_limit import TimeLimit
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.tick import Frame, Thought, together
from lerobot_latentsafe.unknown.dynamics import Foretold, ages
from lerobot_latentsafe.unknown.monitor import UnknownMonitor

logger = logging.getLogger(__name__)

TRIALS, USUAL = 5, 0.7
"""Decisions that are timed before the first one, and the share of a tick that they may take: some take half more."""


class Judgement(NamedTuple):
    """What the world model says of an action.

    Attributes:
        belief: of the episode, with what is seen now.
        value, margin: (B,), V of the action and l now; NaN where nothing can be known.
        fallback: (B, A) in robot units.
        retreats: bool (B,), whether the fallback would be the retreat.
        nearest: the nearest action that passes, of robots whose proposal does not, by the law `nearest`.
        foretold: of the next frame that this belief will see.
        differences: (B, H, D), what was foretold minus what is believed now; None without a monitor that foretells.
    """

    belief: Belief
    value: np.ndarray
    margin: np.ndarray
    fallback: np.ndarray
    retreats: np.ndarray
    nearest: Found
    foretold: Foretold = Foretold()
    differences: np.ndarray | None = None


class Shield:
    """Filters one action a tick for a batch of robots, remembering what they saw and did.

    Whatever is wrong, the robots stay (see `Limits.hold`) where that is found safe; else the fallback acts.

    Args:
        model: a trained safety model, and by its configuration the law.
        clock: seconds, monotonic. Any but the machine's is a simulation's, which waits for whoever decides;
            `standing_still` is one to which nothing is late.

    Attributes:
        guard: checks what is seen and told.
        monitor: of the unknown; None where the filter has none. It remembers the session's episodes.
        nearest: looks for the nearest action that passes, by the law `nearest`.
        pace: of the decisions.
        beliefs: of the episode, by the frames that the world model has seen: where its step is several ticks, every so
            many frames, beginning with one, with the next, and so on. The first is the one that sees the next frame.
        observed: what the last decision was made on.
        took_s: seconds that the last decision took.
        failures: what failed -> how often.
    """

    def __init__(self, model: SafetyModel, clock: Callable[[], float] = time.perf_counter):
        self.model, self.clock, self.guard = model, clock, Guard(model)
        self.monitor = monitor_of(model)
        self.nearest = Nearest(model)
        self.pace = Pace(model.config.trained_on.fps)
        self.failures: Counter[str] = Counter()
        self.took_s, self._warm, self._knows_its_pace = 0.0, False, False
        self._in_time = TimeLimit(model.device.type)
        self._lock = threading.RLock()
        self._same_weights: weakref.WeakKeyDictionary[Shield, bool] = weakref.WeakKeyDictionary()
        keep_freed_memory()
        self.reset()

    def __getstate__(self) -> dict[str, Any]:
        """A copy, or one that was pickled, compares its weights with others' anew."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_same_weights", "_lock")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _same_weights=weakref.WeakKeyDictionary(), _lock=threading.RLock())

    def reset(self) -> None:
        """Forget the history: call at the start of every episode."""
        with self._lock:
            self.pace.forget()
            self._forget()

    def _forget(self) -> None:
        self.guard.reset()
        if self.monitor is not None:
            self.monitor.reset()
        skip = self.model.config.world_model.frame_skip
        self.beliefs = deque([Belief()] * skip, maxlen=skip)
        self.foretold = deque([Foretold()] * skip, maxlen=skip)
        self._in_sight: np.ndarray | None = None
        self._told: deque[Tensor] = deque(maxlen=skip)
        self.observed: dict[str, Tensor] | None = None
        self.decision: FilterDecision | None = None
        self.overrides: Overrides | None = None
        self._accepted: np.ndarray | None = None
        self._has_acted = False

    @torch.no_grad()
    def warm_up(self) -> None:
        """Between episodes: compile what the law wants compiled, and judge nothing once, so that no tick is slow."""
        if not self.model.is_trained_for_law():
            return
        drawn_elsewhere = torch.random.fork_rng([self.model.device] if self.model.device.type == "cuda" else [])
        with self._lock, self.model.single_precision(), drawn_elsewhere:
            self.nearest.thinking.prepare(self._grey(0.0))
            if not self._warm:
                self._rehearse(0.0)
                self._warm = True
            if self.pace.strict and not self._knows_its_pace and self.patience() is not None:
                self._say_if_late(statistics.median(self._rehearse((i + 1) / TRIALS) for i in range(TRIALS)))
                self._knows_its_pace = True

    def _grey(self, shade: float) -> dict[str, Tensor]:
        """Pictures for the world model, for one robot, of one shade in [0, 1]."""
        size = self.model.config.world_model.image_size
        return {key: torch.full((1, 3, size, size), shade, device=self.model.device) for key in self.guard.cameras.keys}

    def _rehearse(self, shade: float) -> float:
        """Judge nothing, seeing one shade of grey, and forget it. Returns seconds that it took."""
        model, fault = self.model, np.zeros(1, np.int64)
        self.guard.pose = on_host(model.units.state_mean[None])
        hold, images = np.nan_to_num(model.limits.hold(self.guard.pose), nan=0.0), self._grey(shade)
        self.overrides = Overrides(1)
        # In the thread that decides later on, as what is made at first use is made for each thread.
        seconds = None if self.patience() is None else math.inf
        ahead = self._hear_ahead(self._hear(hold, self.guard.pose), fault)
        began = time.perf_counter()
        self._judge(Seen(images, self.guard.pose, fault), fault, hold, ahead, hold, seconds)
        took = time.perf_counter() - began
        self._forget()
        return took

    def _say_if_late(self, took: float) -> None:
        """Warn of a machine that is too slow for the robot's rate, before it moves.

        Args:
            took: seconds of what is most of a tick.
        """
        limit = min(self.patience(), (self.model.config.law.deadline_ms or math.inf) / 1e3)
        if took > USUAL * limit:
            logger.warning(
                "THIS ROBOT WILL BE LATE: to see and to imagine takes %.0f ms here, and a whole tick may take %.0f. "
                "Nothing passes in a tick that is late. Give law.engine=onnx, a smaller law.lookahead, or a faster "
                "machine; latentsafe bench --policy.path=... says which part takes how long", 1e3 * took, 1e3 * limit,
            )  # fmt: skip

    @torch.no_grad()
    def __call__(
        self,
        observation: dict[str, Any],
        proposed: Tensor | None,
        age_s: float = 0.0,
        missing_reason: Reason = Reason.BASE_POLICY_FAILED,
        fault: Reason = Reason.PASSED,
        planned: Tensor | None = None,
        coming: Tensor | None = None,
    ) -> FilterDecision:
        """Decide on one proposed action.

        Args:
            observation: LeRobot batch: images (B, C, H, W) in [0, 1], observation.state (B, S) in robot units.
            proposed: (B, A) in robot units, or None if there is none.
            age_s: seconds since before the observation was taken.
            missing_reason: the reason to give where there is no proposal.
            fault: what the caller has found wrong, if anything.
            planned: (B, N, A) in robot units, what is to come after `proposed`, if it was just planned.
            coming: the same, whenever it was planned: a step of the world model hears it in place of `proposed` held.

        Returns:
            The decision, also kept as `self.decision`; use the one that is returned, others may decide meanwhile.

        Raises:
            UntrainedFilterError: training has not come far enough for the law.
            KeyError, ValueError: the very first observation is none of this robot, or the number of robots changed.
            UnknownPoseError: a robot whose commands are targets has shown no usable state, and was told nothing yet.
        """
        self.model.require_trained_for_law()
        self._say_if_disarmed()
        with self._lock:
            started, law = self.clock(), self.model.config.law
            rate = self.pace.tick(started, law.slack_ms)
            if self.pace.paused:
                logger.info("the filter starts anew after a pause")
                self._forget()
            seen = self.guard.observe(observation)
            faults = self._late(seen.fault, age_s, Reason.OBSERVATION_STALE)
            hold = self.guard.hold(seen.state)
            faults, wanted, clipped = self.guard.check_action(proposed, faults, hold, missing_reason, planned)
            faults = or_else(faults, fault or rate)
            alarms = self._look_for_the_unknown(seen, faults)
            faults = or_else(faults, alarms) if law.stops_at_the_unknown else faults
            self.overrides = self.overrides or Overrides(len(hold))
            # What is wrong is not judged: in its place stands what would be done instead, to stay.
            judged = np.where((faults != Reason.PASSED)[:, None], hold, clipped)
            heard = None if law.name == "guard" else self._hear(judged, self.guard.pose)
            ahead = None if heard is None else self._hear_ahead(heard, faults, coming)
            judgement, faults = self._judge(seen, faults, judged, ahead, hold, self.patience(len(hold)))
            if judgement.differences is not None:
                alarms = self.monitor.foresee(judgement.differences)
                faults = or_else(faults, alarms) if law.stops_at_the_unknown else faults
            self.took_s = self.clock() - started
            faults = self._late(faults, age_s + self.took_s, Reason.DEADLINE_MISSED, len(hold), self.took_s)
            decision = self._decide(judgement, seen, faults, hold, wanted, clipped)
            if self.monitor is not None:
                decision = self._with_the_unknown(decision, alarms, hold)
            self._remember(judgement, decision, observation)
            decision = replace(decision, heard=heard).to(self.model.device)
            self.decision = replace(decision, action=decision.action.clone())  # what is returned is the caller's
            return decision

    def _look_for_the_unknown(self, seen: Seen, faults: np.ndarray) -> np.ndarray:
        """What the monitor of the unknown says of what is seen, a `Reason` each (B,); faulty pictures say nothing."""
        if self.monitor is None:
            return np.zeros_like(faults)
        return self.monitor.look(seen.images, ~np.isin(faults, UNSEEN))

    def _with_the_unknown(self, decision: FilterDecision, alarms: np.ndarray, hold: np.ndarray) -> FilterDecision:
        """The decision with what the monitor found, and with what the law does about it beside stopping."""
        law, monitor = self.model.config.law, self.monitor
        slowed = self.model.limits.slowed(decision.action.numpy(), hold, SLOW)
        decision = heeding(decision, alarms, law, slowed)
        return replace(
            decision,
            unknown=torch.from_numpy(monitor.share),
            hand_over=torch.from_numpy((alarms != Reason.PASSED) & (law.unknown == "hand_over")),
            drift=torch.full((len(alarms),), monitor.evidence),
        )

    def _say_if_disarmed(self) -> None:
        """Warn once of each law that does not heed what is seen."""
        disarmed = self.model.config.law.disarmed
        if disarmed is not None:
            self.guard.say_once("THIS FILTER DOES NOT ACT BY WHAT IT SEES", disarmed)

    def patience(self, n: int = 1) -> float | None:
        """Seconds that a tick for n robots waits for whoever may hang: a period each; None where a simulation waits."""
        return self.pace.oldest(self.model.config.law.slack_ms, n) if self.clock is time.perf_counter else None

    def time_left(self, age_s: float, n: int = 1) -> float | None:
        """Seconds that a base policy may take, so that the decision after it is still in time; None: any."""
        patience = self.patience(n)
        return None if patience is None else patience - age_s - self.took_s

    def _late(self, faults: np.ndarray, age_s: float, reason: Reason, n: int = 1, took_s: float = 0.0) -> np.ndarray:
        """Mark all as late where an observation is too old, or a decision took too long; a time that is no number is.

        Args:
            n: robots that one call decides for; each has a period.
        """
        law = self.model.config.law
        in_time = 0 <= age_s <= self.pace.oldest(law.slack_ms, n)
        in_time &= took_s >= 0 and (law.deadline_ms is None or took_s * 1e3 <= law.deadline_ms)
        return faults if in_time else or_else(faults, reason)

    def _judge(
        self, seen: Seen, faults: np.ndarray, judged: np.ndarray, ahead: Tensor | None, hold: np.ndarray,
        seconds: float | None,
    ) -> tuple[Judgement, np.ndarray]:  # fmt: skip
        """What the world model says of actions (B, A), and the faults with its own.

        Args:
            ahead: the actions of a step of the world model, of which these are the first, as it hears them: (B, K, A).

        A world model that has not answered after so many seconds, or that failed, has missed a frame. So it remembers
        nothing, and the next tick begins with what it sees.
        """
        nothing = np.full(len(hold), np.nan, np.float32)
        unknown = Judgement(Belief(), nothing, nothing, hold, np.zeros(len(hold), bool), Found.nothing(*hold.shape))
        if self.model.config.law.name == "guard":
            return unknown, faults
        try:
            return self._in_time(lambda: self._imagine(seen, faults, judged, ahead, hold), seconds)
        except TimeoutError as e:
            self.note_failure("the filter was late", e)
            reason = Reason.DEADLINE_MISSED
        except Exception as e:
            self.note_failure("the filter failed", e)
            reason = Reason.FILTER_FAILED
        return unknown, or_else(faults, reason)

    def _imagine(
        self, seen: Seen, faults: np.ndarray, judged: np.ndarray, ahead: Tensor, hold: np.ndarray
    ) -> tuple[Judgement, np.ndarray]:
        """Take in what is seen, and look ahead; changes nothing here, as it may be late."""
        percepts = self._perceive(seen)
        unsound = ~is_sound(percepts)
        blind = self.model.tensor(np.isin(faults, UNSEEN)) | (self.model.tensor(faults == Reason.PASSED) & unsound)
        led = self._what_led_here(ahead[:, 0])
        belief, thought = self._think(percepts, seen.state, led, ahead, blind)
        foretold, differences = self._foretell(belief.latent, led, blind)
        value, margin = on_host(thought.value), on_host(thought.margin)
        fallback, retreats = self._fall_back(thought, hold)
        faults = or_else(faults, first_of({Reason.FILTER_FAILED: on_host(unsound, torch.bool)}))
        nearest = self._find_nearest(belief.latent, value, faults, judged, fallback, hold)
        return Judgement(belief, value, margin, fallback, retreats, nearest, foretold, differences), faults

    def _perceive(self, seen: Seen) -> dict[str, Tensor]:
        return self.model.world_model.perceive(seen.images)

    def _foretell(self, latent: Latent, before: Tensor, blind: Tensor) -> tuple[Foretold, np.ndarray | None]:
        """What is foretold of this frame, in place of what was of the last one, and how it differs from the belief.

        What began or ends where nothing was seen says nothing of the world.
        """
        if self.monitor is None or not self.monitor.foretells:
            return Foretold(), None
        model, of_ages = self.model.world_model, ages(self.model.config.world_model.frame_skip)
        began, foretold = self.beliefs[0].latent, Foretold()
        if began is not None:
            foretold = self.foretold[0].after(began, model.step, before, of_ages[-1])
        differences = foretold.differences(model.features, latent, of_ages)
        in_sight = np.zeros(len(differences)) if self._in_sight is None else self._in_sight
        old = np.array(of_ages) * self.model.config.world_model.frame_skip
        differences[(in_sight[:, None] < old) | on_host(blind, torch.bool)[:, None]] = np.nan
        return foretold, differences

    def _think(
        self, percepts: Latent, state: np.ndarray, led: Tensor, ahead: Tensor, blind: Tensor
    ) -> tuple[Belief, Thought]:
        """What is believed of the episode, and what the models say; robots that are blind (B,) only imagine."""
        model, before = self.model, self.beliefs[0]
        shown = model.units.normalise_state(model.tensor(state)).nan_to_num(0.0)
        memories = before.led_on(model.config.world_model.steps(model.config.law.history_frames))
        latent, begins = together(memories, model.world_model.initial(len(state)))
        frame = Frame(percepts, shown, led, ahead)
        thought = self.nearest.thinking.think(latent, begins, frame, blind if blind.any() else None)
        parts = [map_latent(thought.latent, lambda t: t[i : i + len(state)]) for i in range(0, len(begins), len(state))]  # noqa: B023
        own, younger = (*parts, None)[:2]
        return Belief(own, younger, before.n_frames + 1), thought

    def _fall_back(self, thought: Thought, hold: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The fallback (B, A) in robot units, and whether an override would be the retreat's: (B,)."""
        retreats, known = self.overrides.retreats(self.model.config.law), np.isfinite(on_host(thought.here))
        moves = retreats & known  # where nothing is known, nothing moves
        fallback = np.where(moves[:, None], self._retreat(hold), self._usable(thought.action, known, hold))
        return fallback, retreats

    def _find_nearest(
        self, latent: Latent, value: np.ndarray, faults: np.ndarray, proposed: np.ndarray, fallback: np.ndarray,
        hold: np.ndarray,
    ) -> Found:  # fmt: skip
        """Of robots whose proposal has no fault but V, the nearest action that passes, if the law asks for one."""
        law, found = self.model.config.law, Found.nothing(*hold.shape)
        if law.name != "nearest" or law.mode == "monitor":
            return found
        threshold = self.overrides.threshold(law)
        unsafe = (faults == Reason.PASSED) & np.isfinite(value) & ~(value > threshold) & np.isfinite(threshold)
        rows = np.flatnonzero(unsafe & self.overrides.may_adjust(law))
        if not len(rows):
            return found
        accepted = found.candidate if self._accepted is None else self._accepted
        at = select(latent, self.model.tensor(rows))
        before = [earlier[rows] for earlier in self.guard.proposed_before]
        robots, judged = (proposed, fallback, hold, self.guard.pose), (value, threshold, accepted)
        (wanted, back, stay, pose), (v, limit, last) = ([numbers[rows] for numbers in of] for of in (robots, judged))
        nearest = self.nearest.find(Asked(at, wanted, back, stay, pose, before, v, limit, last))
        found.action[rows], found.candidate[rows] = nearest
        return found

    def _decide(
        self,
        judgement: Judgement,
        seen: Seen,
        faults: np.ndarray,
        hold: np.ndarray,
        proposed: np.ndarray,
        clipped: np.ndarray,
    ) -> FilterDecision:
        """The law's decision, once all that can be known is known."""
        law, value = self.model.config.law, judgement.value
        monitors = law.mode == "monitor"
        if law.name == "guard":
            return by_checks_alone(proposed, hold, faults, monitors, clipped)
        threshold = self.overrides.threshold(law)
        fallback = np.where(self._stays(faults, value, threshold, seen.state), hold, judgement.fallback)
        decision = least_restrictive(proposed, fallback, value, judgement.margin, threshold, faults, monitors, clipped)
        return adjusting(decision, judgement.nearest.action)

    def _remember(self, judgement: Judgement, decision: FilterDecision, observation: dict[str, Any]) -> None:
        adjusted = decision.adjusted.numpy()
        acts, law = decision.falls_back.numpy(), self.model.config.law
        self.overrides = self.overrides.after(law, acts, judgement.retreats, adjusted)
        self._accepted = np.where(adjusted, judgement.nearest.candidate, -1)
        self.beliefs.append(judgement.belief)  # in place of the one that it grew out of
        self.foretold.append(judgement.foretold)
        blind = np.isin(decision.reason.numpy(), UNSEEN)
        in_sight = np.zeros(len(blind)) if self._in_sight is None else self._in_sight
        self._in_sight = np.where(blind, 0, in_sight + 1)  # ticks
        if self.monitor is not None:
            self.monitor.end_tick()
        self.observed = {key: observation[key] for key in self.guard.inputs if key in observation}
        self._was_told(decision.action.numpy().copy())
        self._tell(decision)

    @property
    def latent(self) -> Latent | None:
        """The posterior that the last decision was made on."""
        return self.beliefs[-1].latent

    @property
    def executed(self) -> list[Tensor]:
        """What the robots were told in the last ticks, as the world model hears it: (B, A) each, the latest last, at
        most as many as a step of the world model takes."""
        return list(self._told)

    def was_executed(self, action: Tensor) -> None:
        """Remember (B, A) in robot units as what was done, where something else was than was decided."""
        if self._told:
            self._told.pop()
        self._was_told(on_host(action).copy())

    def _was_told(self, action: np.ndarray) -> None:
        self.guard.was_told(action)
        if self.model.config.law.name != "guard":  # nobody hears it there
            self._told.append(self._hear(action, self.guard.pose))

    def _hear(self, action: np.ndarray, pose: np.ndarray) -> Tensor:
        """An action (B, A) at a pose (B, S) as the world model hears it; what is not known does not move."""
        model = self.model
        at = model.tensor(pose) if model.units.has_targets else None
        return model.units.heard_action(model.tensor(action), at).nan_to_num(0.0)

    def _hear_ahead(self, heard: Tensor, faults: np.ndarray, coming: Tensor | None = None) -> Tensor:
        """The actions of a step of the world model (B, K, A): one that is judged (B, A), and after it what is to come.

        It is held where nothing is known to come (B, N, A), where something is wrong, and of targets, which mean
        nothing without the states to come.
        """
        model = self.model
        ahead = heard[:, None].repeat(1, model.config.world_model.frame_skip, 1)
        if coming is None or model.limits.has_targets or not self.guard.is_plan(coming, heard):
            return ahead
        then = model.units.heard_action(model.place(coming[:, : ahead.shape[1] - 1]).float())
        follows = then.isfinite().all(-1).cumprod(1).bool() & model.tensor(faults == Reason.PASSED)[:, None]
        for t in range(then.shape[1]):
            ahead[:, t + 1 :] = torch.where(follows[:, t, None], then[:, t], ahead[:, t])[:, None]
        return ahead

    def note_failure(self, what: str, error: BaseException) -> None:
        """Count a failure that a decision survived; its trace is logged the first time."""
        self.failures[what] += 1
        trace = error if self.failures[what] == 1 else None
        logger.error("%s (%s: %s); nothing passes for that", what, type(error).__name__, error, exc_info=trace)

    def _stays(self, fault: np.ndarray, value: np.ndarray, threshold: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Commands (B, A) that stay as they were, instead of the fallback's.

        A fault does not move a robot for which staying is safe, as far as is known; and a target moves nowhere from a
        place that is not known.
        """
        limits, broken = self.model.limits, (fault != Reason.PASSED) & (fault != Reason.NO_BASE_POLICY)
        stays = (broken & (value > threshold)) | ~np.isfinite(value)
        return stays[:, None] | (limits.is_target & np.isnan(limits.seen(state)))

    def _retreat(self, hold: np.ndarray) -> np.ndarray:
        """The motion of `law.retreat`, with all other commands as they were: (B, A) in robot units."""
        action, limits = hold.copy(), self.model.limits
        for name, motion in self.model.config.law.retreat.items():
            i = limits.action_names.index(name)
            action[:, i] = motion + (hold[:, i] if limits.is_target[i] else 0.0)
        return action

    def _tell(self, decision: FilterDecision) -> None:
        """Log the first override of an episode."""
        if self._has_acted or not decision.unsafe.any():
            return
        self._has_acted = True
        given = decision.reason[decision.unsafe].unique().tolist()
        reasons = ", ".join(Reason(number).name.lower().replace("_", " ") for number in given)
        acts = "acts" if decision.intervened.any() else "would act"
        logger.info("the filter %s for the first time in this episode: %s", acts, reasons)

    def offer(self) -> None:
        """Let a shielded robot of this process take over what this shield decides: a policy's, not a robot's."""
        _offered.add(self)

    def adopt(self, observation: dict[str, Tensor], action: Tensor, age_s: float = 0.0) -> FilterDecision | None:
        """The decision, with the memory, of a policy's shield that just let this action through, if there is one.

        It must be the same filter, under a law no laxer than ours, and have seen the very same: deciding again would
        only repeat it.

        Args:
            observation: what we see.
            action: (1, A) in robot units.
            age_s: seconds since before the observation was taken.
        """
        if not 0 <= age_s <= self.pace.oldest(self.model.config.law.slack_ms):
            return None
        for other in _offered - {self}:
            with self._lock, other._lock:
                if not (other._decided(observation, action) and self._accepts(other)):
                    continue
                self.beliefs, self._told = other.beliefs.copy(), other._told.copy()
                self.foretold = other.foretold.copy()
                for name in ("observed", "decision", "overrides", "_accepted", "_in_sight"):
                    setattr(self, name, getattr(other, name))
                self.guard.adopt(other.guard)
                if self.monitor is not None and other.monitor is not None:
                    self.monitor.adopt(other.monitor)
                return self.decision
        return None

    def _decided(self, observation: dict[str, Tensor], action: Tensor) -> bool:
        """Whether our last decision was to do this (1, A) after seeing this."""
        if self.decision is None or self.observed is None:
            return False
        return torch.equal(self.decision.action.cpu(), action.cpu()) and _same(observation, self.observed)

    def _accepts(self, other: "Shield") -> bool:
        """Whether the other has our weights, and lets nothing pass that we would not."""
        own, theirs = self.model.config, other.model.config
        if any(getattr(own, group) != getattr(theirs, group) for group in (*SEALED, "likeness", "constraints")):
            return False
        if not theirs.law.passes_nothing_more_than(own.law):
            return False
        if other not in self._same_weights:  # weights are compared once
            ours, its = self.model.state_dict(), other.model.state_dict()
            self._same_weights[other] = ours.keys() == its.keys() and all(
                ours[key].device == its[key].device and torch.equal(ours[key], its[key]) for key in ours
            )
        return self._same_weights[other]

    def _what_led_here(self, heard: Tensor) -> Tensor:
        """What was executed since the frame that the belief saw last (B, K A); before the first, as is heard (B, A)."""
        executed = self.executed
        # Where so many ticks have not been, the belief is a fresh one, and only what counts as first is read of this.
        n_unknown = self.beliefs.maxlen - len(executed)
        return torch.cat([*[executed[0] if executed else heard] * n_unknown, *executed], 1)

    def _usable(self, action: Tensor, known: np.ndarray, hold: np.ndarray) -> np.ndarray:
        """The safety policy's action in robot units; where it is not finite, or its value is not known, hold."""
        limits, pose = self.model.limits, self.guard.pose
        robots = on_host(self.model.units.denormalise_action(action, self.model.tensor(pose)))
        clipped, far = limits.clip(robots, pose)  # a fallback is checked like any other action
        sound = (np.isfinite(robots).all(-1) & known & ~far)[:, None]
        # A target that does not move stays as it was told, so that an arm does not sink, and a grip does not open.
        sound = sound & ~(limits.stays | (limits.is_target & (on_host(action) == 0)))
        return np.where(sound, clipped, hold)


def monitor_of(model: SafetyModel) -> UnknownMonitor | None:
    """The monitor of the unknown that a filter was saved with, if any."""
    trained_on, familiar = model.config.trained_on, model.familiar
    if familiar is None:
        return None
    record = trained_on.monitor
    return UnknownMonitor(familiar, record.cameras, record.alpha, record.rank, trained_on.fps)


def _same(observation: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two observations hold the same numbers."""
    return observation.keys() >= other.keys() and all(
        isinstance(value, Tensor) and torch.equal(value.cpu(), observation[key].cpu()) for key, value in other.items()
    )


_offered: "weakref.WeakSet[Shield]" = weakref.WeakSet()
