"""The shield: what stands between any base policy and a robot. History, units, timing and faults live here.

The policy wrapper and every other adapter share this one core. Its rule: nothing that is not finite, fresh, in time
and in range ever counts as safe.
"""

import logging
import time
import weakref
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from lerobot_latentsafe.configuration_latentsafe import SEALED
from lerobot_latentsafe.decision import RECENT, FilterDecision, Reason, first_fault, least_restrictive
from lerobot_latentsafe.encoders.pictures import check_proportions
from lerobot_latentsafe.latent import Belief, Latent, map_latent, replace_rows
from lerobot_latentsafe.runtime.malloc import keep_freed_memory
from lerobot_latentsafe.safety_model import SafetyModel

logger = logging.getLogger(__name__)

BLIND = (
    Reason.OBSERVATION_NOT_FINITE, Reason.OBSERVATION_MISSING, Reason.OBSERVATION_STALE, Reason.OBSERVATION_OUT_OF_RANGE
)  # fmt: skip
"""What is wrong with observations that the world model must not see."""


class Shield:
    """Filters one action a tick for a batch of robots, remembering what they saw and did.

    Whatever is wrong, the robots stay (see `Units.hold`) where that is found safe; else the fallback acts.

    Args:
        model: a trained safety model, and by its configuration the law.
        clock: seconds, monotonic; replaceable in tests.

    Attributes:
        pose: (B, S) in robot units, the last usable reading of each number of the state; NaN before there was one.
        missed: (B, S), ticks since then.
        told: (B, A) in robot units, what the robots were told last.
        executed: (B, A), the same as the world model hears it.
        moving: bool (B, A), whether what each target is of has moved since the last tick.
        stay: (B, A) in robot units, what would have been to stay at the last tick.
        holding: bool (B, A), commands that were told to stay.
    """

    def __init__(self, model: SafetyModel, clock: Callable[[], float] = time.perf_counter):
        self.model, self.clock = model, clock
        keep_freed_memory()
        self._told_clipped = False
        self._same_weights: weakref.WeakKeyDictionary[Shield, bool] = weakref.WeakKeyDictionary()
        self.reset()
        _shields.add(self)

    def __getstate__(self) -> dict[str, Any]:
        """A copy, or one that was pickled, compares its weights with others' anew."""
        return {name: value for name, value in self.__dict__.items() if name != "_same_weights"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _same_weights=weakref.WeakKeyDictionary())
        _shields.add(self)

    def reset(self) -> None:
        """Forget the history: call at the start of every episode."""
        self.belief = Belief()
        self.pose: Tensor | None = None
        self.missed: Tensor | None = None
        self.told: Tensor | None = None
        self.executed: Tensor | None = None
        self.moving: Tensor | None = None
        self.stay: Tensor | None = None
        self.holding: Tensor | None = None
        self.decision: FilterDecision | None = None
        self.decided_at: float | None = None
        self.recent: Tensor | None = None
        self.retreated: Tensor | None = None
        self._told = False

    @torch.no_grad()
    def __call__(
        self,
        observation: dict[str, Tensor],
        proposed: Tensor | None,
        age_s: float = 0.0,
        missing_reason: Reason = Reason.BASE_POLICY_FAILED,
        fault: Reason = Reason.PASSED,
    ) -> FilterDecision:
        """Decide on one proposed action.

        Args:
            observation: LeRobot batch: images (B, C, H, W) in [0, 1], observation.state (B, S) in robot units.
            proposed: (B, A) in robot units, or None if there is none.
            age_s: how old the observation is, seconds; older than one period of the filter's fps is stale.
            missing_reason: the reason to give where there is no proposal.
            fault: what the caller has found wrong, if anything.

        Returns:
            The decision, also kept as `self.decision`.

        Raises:
            UnknownPoseError: a robot whose commands are targets has shown no usable state, and was told nothing yet.
        """
        started, law = self.clock(), self.model.config.law
        images, state, faults = self._check_observation(observation, age_s)
        hold = self._hold(state)
        faults, proposed, clipped = self._check_action(proposed, faults, hold, missing_reason)
        everyone = torch.ones_like(faults, dtype=torch.bool)
        faults = first_fault(faults, everyone, fault)
        if self.recent is None:
            self._forget_overrides(len(state))
        # What is wrong is not judged: in its place stands what would be done instead, to stay.
        judged = self._hear(torch.where((faults != Reason.PASSED)[:, None], hold, clipped))
        belief = self._filter_history(images, self.model.units.normalise_state(state), judged, faults)
        value, margin, retreats, fallback = self._judge(belief.latent, judged, hold)
        finished = self.clock()
        if law.deadline_ms is not None and (finished - started) * 1e3 > law.deadline_ms:
            faults = first_fault(faults, everyone, Reason.DEADLINE_MISSED)
        fallback = torch.where(self._stays(faults, value, state), hold, fallback)
        decision = least_restrictive(
            proposed, fallback, value, margin, self._threshold(), faults, law.mode == "monitor", clipped
        )
        decision = replace(decision, heard=judged)
        acts = decision.intervened
        self.recent = torch.cat([self.recent[:, 1:], acts[:, None]], 1)
        self.retreated = (self.retreated + 1) * (acts & retreats)
        self.belief, self.decision, self.decided_at = belief, decision, finished
        self.stay = hold
        self.was_executed(decision.action)
        self._tell(decision)
        return decision

    def _judge(self, latent: Latent, judged: Tensor, hold: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """V of an action and l now (B,); whether an override would be the retreat's (B,); the fallback (B, A)."""
        model = self.model
        margin = model.imagination.margin(latent)
        predicted, on_the_way = self._go_on(latent, judged)
        both = {key: torch.cat([predicted[key], latent[key]]) for key in latent}  # one pass through imagination
        sizes = [len(on_the_way), len(hold)]
        (value, here), (_, action) = (part.split(sizes) for part in model.plan(both))
        retreats = self._retreats()
        moves = retreats & torch.isfinite(here)  # where nothing is known, nothing moves
        fallback = torch.where(moves[:, None], self._retreat(hold), self._usable(action, here, hold))
        # A margin that is negative now, or on the way, is a failure whatever comes after.
        value = model.worst(on_the_way, value).view(-1, len(hold)).amin(0)
        return model.worst(margin, value), margin, retreats, fallback

    @property
    def latent(self) -> Latent | None:
        """The posterior that the last decision was made on."""
        return self.belief.latent

    def was_executed(self, action: Tensor) -> None:
        """Remember (B, A) in robot units as what was done; call it where something else was than was decided."""
        self.told, self.executed = action, self._hear(action)
        self.holding = None if self.stay is None else torch.isclose(action, self.stay)

    def _hear(self, action: Tensor) -> Tensor:
        """An action (B, A) in robot units as the world model hears it; what is not known does not move."""
        return self.model.units.heard_action(action, self.pose).nan_to_num(0.0)

    def _stays(self, fault: Tensor, value: Tensor, state: Tensor) -> Tensor:
        """Commands (B, A) that stay as they were, instead of the fallback's.

        A fault does not move a robot for which staying is safe, as far as is known; and a target moves nowhere from a
        place that is not known.
        """
        units, broken = self.model.units, (fault != Reason.PASSED) & (fault != Reason.NO_BASE_POLICY)
        stays = (broken & (value > self._threshold())) | ~value.isfinite()
        return stays[:, None] | (units.is_target & units.seen(state).isnan())

    def _forget_overrides(self, n: int) -> None:
        """For n robots: of the last steps, whether they were overridden; and the steps of a retreat that goes on."""
        self.recent = torch.zeros(n, RECENT, dtype=torch.bool, device=self.model.device)
        self.retreated = torch.zeros(n, dtype=torch.long, device=self.model.device)

    def _retreats(self) -> Tensor:
        """Whether an override now would be the retreat's: one goes on, or the critic's action has been tried: (B,)."""
        law = self.model.config.law
        tried = self.recent.sum(1) >= law.retreat_after
        return (self.retreated > 0) | tried if law.retreat else torch.zeros_like(tried)

    def _retreat(self, hold: Tensor) -> Tensor:
        """The motion of `law.retreat`, with all other commands as they were: (B, A) in robot units."""
        action, units = hold.clone(), self.model.units
        for name, motion in self.model.config.law.retreat.items():
            i = units.action_names.index(name)
            action[:, i] = motion + (hold[:, i] if units.is_target[i] else 0.0)
        return action

    def _threshold(self) -> Tensor:
        """What V must exceed: epsilon, and `resume_above` where the fallback acts. Infinite for the first
        `min_retreat_steps` steps of a retreat."""
        law, acting = self.model.config.law, self.recent[:, -1]
        threshold = torch.where(acting, max(law.epsilon, law.resume_above), law.epsilon)
        return torch.where((self.retreated > 0) & (self.retreated < law.min_retreat_steps), torch.inf, threshold)

    def _tell(self, decision: FilterDecision) -> None:
        """Log the first override of an episode."""
        if self._told or not decision.unsafe.any():
            return
        self._told = True
        given = decision.reason[decision.unsafe].unique().tolist()
        reasons = ", ".join(Reason(number).name.lower().replace("_", " ") for number in given)
        acts = "acts" if decision.intervened.any() else "would act"
        logger.info("the filter %s for the first time in this episode: %s", acts, reasons)

    def adopt(self, action: Tensor, within_s: float) -> bool:
        """Take over the decision, and the memory, of another shield of this process that just let this action through.

        It must be the same filter under a law no laxer than ours: deciding again would only repeat it.

        Args:
            action: (1, A) in robot units.
            within_s: how long ago that decision may be, seconds.
        """
        for other in _shields - {self}:
            fresh = other.decided_at is not None and 0 <= self.clock() - other.decided_at <= within_s
            if fresh and torch.equal(other.decision.action.cpu(), action) and self._accepts(other):
                self.belief, self.pose, self.missed = other.belief, other.pose, other.missed
                self.told, self.executed = other.told, other.executed
                self.moving, self.holding = other.moving, other.holding
                self.decision, self.decided_at = other.decision, other.decided_at
                self.recent, self.retreated = other.recent, other.retreated
                return True
        return False

    def _accepts(self, other: "Shield") -> bool:
        """Whether the other has our weights, and lets nothing pass that we would not."""
        own, theirs = self.model.config, other.model.config
        if any(getattr(own, group) != getattr(theirs, group) for group in SEALED):
            return False
        if not theirs.law.passes_nothing_more_than(own.law):
            return False
        if other not in self._same_weights:  # weights are compared once
            ours, its = self.model.state_dict(), other.model.state_dict()
            self._same_weights[other] = ours.keys() == its.keys() and all(
                ours[key].device == its[key].device and torch.equal(ours[key], its[key]) for key in ours
            )
        return self._same_weights[other]

    def _check_observation(
        self, observation: dict[str, Tensor], age_s: float
    ) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """Images as the model takes them, the state (B, S) in robot units, the first fault of each row.

        Numbers of the state that are not usable are NaN; `pose` holds what was read of them before.
        """
        model, cameras = self.model, self.model.world_model.image_keys
        missing = [key for key in model.inputs if key not in observation]
        if missing:
            raise KeyError(
                f"observation lacks {', '.join(missing)}; this filter was trained on "
                f"{', '.join(model.inputs)}. Got "
                f"{', '.join(k for k in observation if k.startswith('observation'))}. Rename the camera or state "
                "(--rename_map), or train a filter for this robot"
            )
        state = model.state(observation)
        if self.executed is not None and len(self.executed) != len(state):
            raise ValueError(
                f"the batch went from {len(self.executed)} to {len(state)} robots within an episode; "
                "call reset() between episodes"
            )
        fault = torch.zeros(len(state), dtype=torch.long, device=model.device)
        images = {}
        finite = torch.isfinite(state).all(-1)
        if self.pose is None:
            self.pose, self.missed = torch.full_like(state, torch.nan), torch.zeros_like(state)
        usable = model.units.believable(state, self.pose, self.missed)
        state = torch.where(usable, state, torch.nan)
        self.moving = model.units.moves(state, self.pose)
        self.pose, self.missed = torch.where(usable, state, self.pose), (self.missed + 1) * ~usable
        for key in cameras:
            image = model.place(observation[key])
            check_proportions(key, tuple(image.shape[1:]), model.config.input_features[key].shape)
            low, high = image.amin((1, 2, 3)), image.amax((1, 2, 3))  # NaN if anything is; aminmax is five times slower
            colours = torch.isfinite(low) & torch.isfinite(high) & (low >= -1e-3) & (high <= 1 + 1e-3)
            finite &= colours
            images[key] = model.images(image if colours.all() else image.nan_to_num(0.0).clamp(0, 1)).clamp(0, 1)
            # A camera that delivers one flat colour is covered or dead.
            fault = first_fault(fault, high - low < 1e-3, Reason.OBSERVATION_MISSING)
        fault = first_fault(fault, ~finite, Reason.OBSERVATION_NOT_FINITE)
        fault = first_fault(fault, ~usable.all(-1), Reason.OBSERVATION_OUT_OF_RANGE)
        if age_s > 1.0 / model.config.trained_on.fps or not age_s >= 0:
            fault = first_fault(fault, torch.ones_like(finite), Reason.OBSERVATION_STALE)
        return images, state, fault

    def _check_action(
        self, proposed: Tensor | None, fault: Tensor, hold: Tensor, missing_reason: Reason
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Faults, the proposal and what of it lies in the data's range: (B,), (B, A), (B, A) in robot units."""
        units = self.model.units
        if proposed is None:
            fault = first_fault(fault, torch.ones_like(fault, dtype=torch.bool), missing_reason)
            proposed = hold
        proposed = self.model.place(proposed)
        expected = (len(hold), len(units.action_low))
        if tuple(proposed.shape) != expected:
            raise ValueError(
                f"proposed action has shape {tuple(proposed.shape)}, expected {expected}: "
                f"{', '.join(units.action_names)}. The base policy must be of the filter's action space"
            )
        finite = torch.isfinite(proposed).all(-1)
        fault = first_fault(fault, ~finite, Reason.ACTION_NOT_FINITE)
        clipped, out_of_range = units.clip(torch.where(finite[:, None], proposed, hold), self.pose)
        fault = first_fault(fault, out_of_range, Reason.ACTION_OUT_OF_RANGE)
        return fault, proposed, self._tell_clipped(proposed, clipped, fault)

    def _tell_clipped(self, proposed: Tensor, clipped: Tensor, fault: Tensor) -> Tensor:
        """What is executed of proposals that pass; says so once where that is not the proposal itself."""
        passes = (fault == Reason.PASSED)[:, None]
        beyond = passes & ((clipped - proposed).abs() > 1e-5 * proposed.abs().clamp(min=1))
        if not self._told_clipped and beyond.any():
            self._told_clipped = True
            names = ", ".join(name for name, any_row in zip(self.model.units.action_names, beyond.any(0)) if any_row)
            logger.warning("the policy leaves the range of the data a little; what is executed is clipped: %s", names)
        return torch.where(beyond, clipped, proposed)  # others pass to the bit

    def _filter_history(self, images: dict[str, Tensor], state: Tensor, judged: Tensor, fault: Tensor) -> Belief:
        """What the world model makes of the episode; rows whose observation is unusable go on by imagination alone."""
        world_model, units = self.model.world_model, self.model.units
        percepts = world_model.perceive(images)
        blind, state = torch.isin(fault, fault.new_tensor(BLIND)), state.nan_to_num(0.0)
        before = judged if self.executed is None else self.executed

        def observe(latent: Latent | None) -> Latent:
            start = latent is None
            latent = world_model.initial(len(state)) if start else latent
            predicted = world_model.step(latent, units.first_action(before) if start else before)
            return replace_rows(world_model.correct(predicted, percepts, state), predicted, where=blind)

        return self.belief.after(observe, self.model.config.law.history_frames)

    def _go_on(self, latent: Latent, action: Tensor) -> tuple[Latent, Tensor]:
        """N x B latents after `proposal_steps` steps of the action (B, A), and the least margin until there (N x B,).

        N is 1, or the number of samples that are drawn of each robot's future.
        """
        law, imagination = self.model.config.law, self.model.imagination
        n = max(1, law.samples)
        action = action.repeat(n, 1)
        latent = map_latent(latent, lambda t: t.repeat(n, *[1] * (t.dim() - 1)))
        least = torch.full_like(action[:, 0], torch.inf)
        for _ in range(law.proposal_steps):
            latent = imagination.step(latent, action)
            least = torch.minimum(least, imagination.margin(latent))
        return latent, least

    def _usable(self, action: Tensor, value: Tensor, hold: Tensor) -> Tensor:
        """The safety policy's action in robot units; where it or its value is not finite, hold."""
        units = self.model.units
        finite = (torch.isfinite(action).all(-1) & torch.isfinite(value))[:, None].expand_as(action)
        # A target that does not move stays as it was told, so that an arm does not sink, and a grip does not open.
        finite = finite & ~(units.stays | (units.is_target & (action == 0)))
        return torch.where(finite, units.denormalise_action(action, self.pose), hold)

    def _hold(self, state: Tensor) -> Tensor:
        """Stay: (B, A) in robot units."""
        settled = ~self.moving if self.holding is None else ~self.moving | self.holding
        hold = self.model.units.hold(state, self.told, settled)
        if not hold.isfinite().all() and self.model.config.law.mode != "monitor":
            raise UnknownPoseError(
                "the first observation of the episode shows no usable state, and these commands are positions: nobody "
                "knows where the robot is, so nothing is commanded. See to the robot's sensors, and start again"
            )
        return hold


class UnknownPoseError(RuntimeError):
    """Nobody knows where the robot is, and it takes positions: there is no command that is known to be harmless."""


_shields: "weakref.WeakSet[Shield]" = weakref.WeakSet()
