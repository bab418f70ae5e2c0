"""The shield: what stands between any base policy and a robot. History, units, timing and faults live here.

The policy wrapper and every other adapter share this one core. Its rule: nothing that is not finite, fresh, in time
and in range ever counts as safe.
"""

import logging
import time
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from safetensors import SafetensorError
from torch import Tensor

from lerobot_latentsafe.checkpoint import TRAINED
from lerobot_latentsafe.chunks import ChunksAhead, queued_actions
from lerobot_latentsafe.configuration_latentsafe import RECENT
from lerobot_latentsafe.datasets.frame_cache import check_proportions
from lerobot_latentsafe.filter import FilterDecision, Reason, least_restrictive
from lerobot_latentsafe.memory import keep_freed_memory
from lerobot_latentsafe.world_models.base import Belief, Latent, map_latent, replace_rows

if TYPE_CHECKING:
    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

logger = logging.getLogger(__name__)

RANGE_TOLERANCE = 1e-3
"""Share of the action range by which float error may exceed it."""


class Shield:
    """Filters one action a tick for a batch of robots, remembering what they saw and did.

    Args:
        filter: a trained LatentSafePolicy: world model, margin, critic and their configuration.
        clock: seconds, monotonic; replaceable in tests.
    """

    def __init__(self, filter: "LatentSafePolicy", clock: Callable[[], float] = time.perf_counter):
        self.filter, self.clock = filter, clock
        keep_freed_memory()
        self._twins: weakref.WeakKeyDictionary[Shield, bool] = weakref.WeakKeyDictionary()
        self.reset()
        _shields.add(self)

    def reset(self) -> None:
        """Forget the history: call at the start of every episode."""
        self.belief = Belief()
        self.executed: Tensor | None = None
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
        without: Reason = Reason.BASE_POLICY_FAILED,
        known: Reason = Reason.PASSED,
    ) -> FilterDecision:
        """Decide on one proposed action.

        Args:
            observation: LeRobot batch: images (B, C, H, W) in [0, 1], observation.state (B, S) in robot units.
            proposed: (B, A) in robot units, or None if there is none.
            age_s: how old the observation is, seconds; older than one period of the filter's fps is stale.
            without: the reason to give where there is none.
            known: a fault that the caller has found, if any.

        Returns:
            The decision, also kept as `self.decision`.
        """
        started = self.clock()
        model, config = self.filter, self.filter.config
        images, state, fault = self._check_observation(observation, age_s)
        fault, proposed, inputs = self._check_action(proposed, fault, state, without)
        fault = _first_fault(fault, torch.ones_like(fault, dtype=torch.bool), known)
        belief = self._filter_history(images, state, inputs, fault)
        latent = belief.latent
        margin = model.imagination.margin(latent)
        predicted, on_the_way = self._go_on(latent, inputs)
        both = {key: torch.cat([predicted[key], latent[key]]) for key in latent}  # one pass through imagination
        sizes = [len(on_the_way), len(state)]
        (value, here), (_, action) = (part.split(sizes) for part in model.plan(both))
        if self.recent is None:
            self._forget_overrides(len(state))
        retreats = self._retreats()
        moves = retreats & torch.isfinite(here)  # where nothing is known, nothing moves
        fallback = torch.where(moves[:, None], self._retreat(state), self._usable(action, here, state))
        # A margin that is negative now, or on the way, is a failure whatever comes after.
        value = model.worst(on_the_way, value).view(-1, len(state)).amin(0)
        value = model.worst(margin, value)
        finished = self.clock()
        if config.deadline_ms is not None and (finished - started) * 1e3 > config.deadline_ms:
            fault = _first_fault(fault, torch.ones_like(fault, dtype=torch.bool), Reason.DEADLINE_MISSED)
        decision = least_restrictive(
            proposed, fallback, value, margin, self._threshold(), fault, monitor=config.mode == "monitor"
        )
        acts = decision.intervened
        self.recent = torch.cat([self.recent[:, 1:], acts[:, None]], 1)
        self.retreated = (self.retreated + 1) * (acts & retreats)
        self.belief, self.decision, self.decided_at = belief, decision, finished
        self.was_executed(decision.action)
        self._tell(decision)
        return decision

    @property
    def latent(self) -> Latent | None:
        """The posterior that the last decision was made on."""
        return self.belief.latent

    def was_executed(self, action: Tensor) -> None:
        """Remember (B, A) in robot units as what was done; call it where something else was than was decided."""
        self.executed = self.filter.normalise_action(action).nan_to_num(0.0).clamp(-1, 1)

    def _forget_overrides(self, n: int) -> None:
        """For n robots: of the last steps, whether they were overridden; and the steps of a retreat that goes on."""
        self.recent = torch.zeros(n, RECENT, dtype=torch.bool, device=self.filter.device)
        self.retreated = torch.zeros(n, dtype=torch.long, device=self.filter.device)

    def _retreats(self) -> Tensor:
        """Whether an override now would be the retreat's: one goes on, or the critic's action has been tried: (B,)."""
        config = self.filter.config
        tried = self.recent.sum(1) >= config.patience
        return (self.retreated > 0) | tried if config.retreat else torch.zeros_like(tried)

    def _retreat(self, state: Tensor) -> Tensor:
        """The manoeuvre of `config.retreat`, with the kept commands as they were: (B, A) in robot units."""
        model, action = self.filter, self._hold(state)
        for name, motion in model.config.retreat.items():
            action[:, model.config.action_names.index(name)] = motion
        return action

    def _threshold(self) -> Tensor:
        """What V must exceed: epsilon; where the filter acts `release`, and before `dwell` steps of retreat nothing."""
        config, acting = self.filter.config, self.recent[:, -1]
        threshold = torch.where(acting, max(config.epsilon, config.release), config.epsilon)
        return torch.where((self.retreated > 0) & (self.retreated < config.dwell), torch.inf, threshold)

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
            if fresh and torch.equal(other.decision.action.cpu(), action) and self._no_stricter_than(other):
                self.belief, self.executed = other.belief, other.executed
                self.decision, self.decided_at = other.decision, other.decided_at
                self.recent, self.retreated = other.recent, other.retreated
                return True
        return False

    def _no_stricter_than(self, other: "Shield") -> bool:
        """Whether the other has our weights, acts, and passes nothing that we would not."""
        own, theirs = self.filter.config, other.filter.config
        alike = (*TRAINED, "law", "lookahead", "guard", "samples", "memory", "retreat", "patience")
        same = all(getattr(own, name) == getattr(theirs, name) for name in alike)
        laxer = any(getattr(theirs, name) < getattr(own, name) for name in ("epsilon", "release", "dwell"))
        if not same or theirs.mode == "monitor" or laxer:
            return False
        if other not in self._twins:  # weights are compared once
            ours, its = self.filter.state_dict(), other.filter.state_dict()
            self._twins[other] = ours.keys() == its.keys() and all(
                ours[key].device == its[key].device and torch.equal(ours[key], its[key]) for key in ours
            )
        return self._twins[other]

    def _check_observation(
        self, observation: dict[str, Tensor], age_s: float
    ) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """Model inputs and the first fault of each row; faulty rows hold zeros."""
        model, config = self.filter, self.filter.config
        missing = [k for k in (*model.world_model.image_keys, "observation.state") if k not in observation]
        if missing:
            raise KeyError(
                f"observation lacks {', '.join(missing)}; this filter was trained on "
                f"{', '.join(model.world_model.image_keys)} and observation.state. Got "
                f"{', '.join(k for k in observation if k.startswith('observation'))}. Rename the camera or state "
                "(--rename_map), or train a filter for this robot"
            )
        state = model.normalise_state(observation["observation.state"].to(model.device))
        if self.executed is not None and len(self.executed) != len(state):
            raise ValueError(
                f"the batch went from {len(self.executed)} to {len(state)} robots within an episode; "
                "call reset() between episodes"
            )
        fault = torch.zeros(len(state), dtype=torch.long, device=model.device)
        images = {}
        finite = torch.isfinite(state).all(-1)
        for key in model.world_model.image_keys:
            image = observation[key].to(model.device)
            check_proportions(key, tuple(image.shape[1:]), config.input_features[key].shape)
            low, high = image.amin((1, 2, 3)), image.amax((1, 2, 3))  # NaN if anything is; aminmax is five times slower
            usable = torch.isfinite(low) & torch.isfinite(high) & (low >= -1e-3) & (high <= 1 + 1e-3)
            finite &= usable
            images[key] = model.model_images(image if usable.all() else image.nan_to_num(0.0).clamp(0, 1)).clamp(0, 1)
            # A camera that delivers one flat colour is covered or dead.
            fault = _first_fault(fault, high - low < 1e-3, Reason.OBSERVATION_MISSING)
        fault = _first_fault(fault, ~finite, Reason.OBSERVATION_NOT_FINITE)
        if age_s > 1.0 / config.fps or not age_s >= 0:
            fault = _first_fault(fault, torch.ones_like(finite), Reason.OBSERVATION_STALE)
        return images, state.nan_to_num(0.0), fault

    def _check_action(
        self, proposed: Tensor | None, fault: Tensor, state: Tensor, without: Reason
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Faults, the proposal in robot units, and model inputs in [-1, 1]."""
        model, batch_size = self.filter, len(state)
        everyone = torch.ones(batch_size, dtype=torch.bool, device=model.device)
        if proposed is None:
            fault = _first_fault(fault, everyone, without)
            proposed = self._hold(state)
        proposed = proposed.to(model.device, torch.float32)
        expected = (batch_size, len(model.config.action_low))
        if tuple(proposed.shape) != expected:
            raise ValueError(
                f"proposed action has shape {tuple(proposed.shape)}, expected {expected}: "
                f"{', '.join(model.config.action_names or [])}. The base policy must be of the filter's action space"
            )
        finite = torch.isfinite(proposed).all(-1)
        inputs = model.normalise_action(torch.where(finite[:, None], proposed, self._hold(state)))
        fault = _first_fault(fault, ~finite, Reason.ACTION_NOT_FINITE)
        out_of_range = (inputs.abs() > 1 + 2 * RANGE_TOLERANCE).any(-1)
        fault = _first_fault(fault, out_of_range, Reason.ACTION_OUT_OF_RANGE)
        return fault, proposed, inputs.clamp(-1, 1)

    def _filter_history(self, images: dict[str, Tensor], state: Tensor, inputs: Tensor, fault: Tensor) -> Belief:
        """What the world model makes of the episode; rows whose observation is unusable go on by imagination alone."""
        world_model = self.filter.world_model
        percepts = world_model.perceive(images)
        blind = (fault >= Reason.OBSERVATION_NOT_FINITE) & (fault <= Reason.OBSERVATION_STALE)
        before = inputs if self.executed is None else self.executed

        def observe(latent: Latent | None) -> Latent:
            start = latent is None
            latent = world_model.initial(len(state)) if start else latent
            predicted = world_model.step(latent, self.filter.first_action(before) if start else before)
            return replace_rows(world_model.correct(predicted, percepts, state), predicted, where=blind)

        return self.belief.after(observe, self.filter.config.memory)

    def _go_on(self, latent: Latent, action: Tensor) -> tuple[Latent, Tensor]:
        """N x B latents after `guard` steps of the action (B, A), and the least margin until there (N x B,).

        N is 1, or the number of samples that are drawn of each robot's future.
        """
        model, config = self.filter, self.filter.config
        n = max(1, config.samples)
        imagination, action = model.imagination, action.repeat(n, 1)
        latent = map_latent(latent, lambda t: t.repeat(n, *[1] * (t.dim() - 1)))
        least = torch.full_like(action[:, 0], torch.inf)
        for _ in range(config.guard):
            latent = imagination.step(latent, action)
            least = torch.minimum(least, imagination.margin(latent))
        return latent, least

    def _usable(self, action: Tensor, value: Tensor, state: Tensor) -> Tensor:
        """The safety policy's action in robot units; where it or its value is not finite, hold."""
        finite = torch.isfinite(action).all(-1) & torch.isfinite(value)
        return torch.where(finite[:, None], self.filter.denormalise_action(action), self._hold(state))

    def _hold(self, state: Tensor) -> Tensor:
        """No motion, and the kept commands as they were, or are seen to be if nothing was executed yet: robot units."""
        model, still = self.filter, self.filter.hold_action(len(state))
        kept = model.commands_seen(state) if self.executed is None else model.denormalise_action(self.executed)
        return torch.where(model.kept & kept.isfinite(), kept, still)


_shields: "weakref.WeakSet[Shield]" = weakref.WeakSet()


def _first_fault(fault: Tensor, where: Tensor, reason: Reason) -> Tensor:
    """Set a reason on rows that have none yet."""
    return torch.where((fault == Reason.PASSED) & where, torch.full_like(fault, reason), fault)


class BasePolicy:
    """Any LeRobot policy with its own processors, as the thing to be shielded.

    Args:
        path: folder, Hub id or the name of a committed checkpoint.
        device: where it runs.
        ahead: if not 0, its chunks are made off the control thread; see `ChunksAhead`.
    """

    def __init__(self, path: str | Path, device: str, ahead: int = 0):
        from lerobot.policies.factory import get_policy_class, make_pre_post_processors

        from lerobot_latentsafe.checkpoint import CheckpointError, read_config, resolve_checkpoint

        self.path = resolve_checkpoint(path)
        config = read_config(self.path)
        if config.type == "latentsafe":
            raise ValueError(
                f"base policy {path} is itself a latentsafe filter; shields do not nest. "
                "Give --base_policy_path the policy to be shielded"
            )
        config.device = device
        self.config = config
        try:
            self.policy = get_policy_class(config.type).from_pretrained(self.path, config=config, strict=True)
        except (SafetensorError, RuntimeError) as e:
            raise CheckpointError(
                f"base policy {self.path}: weights unreadable or not its own ({e}); copy it again"
            ) from e
        self.preprocessor, self.postprocessor = make_pre_post_processors(
            config, pretrained_path=self.path, preprocessor_overrides={"device_processor": {"device": device}}
        )
        self.chunks = ChunksAhead(self.policy, ahead) if ahead else None

    def reset(self) -> None:
        self.policy.reset()
        if self.chunks is not None:
            self.chunks.reset()
        self.preprocessor.reset()
        self.postprocessor.reset()

    def propose(self, observation: dict[str, Tensor]) -> Tensor:
        """Action (B, A) in robot units, through the base policy's own processors."""
        act = self.policy.select_action if self.chunks is None else self.chunks.act
        return self.postprocessor(act(self.preprocessor(dict(observation))))

    def replan(self, executed: Tensor) -> None:
        """Drop the rest of a planned chunk: after an intervention it belongs to a state that never came.

        A policy that remembers its actions, and says so by a method `was_overridden`, is told what was done instead:
        (B, A) in robot units.
        """
        if hasattr(self.policy, "was_overridden"):
            return self.policy.was_overridden(executed)
        if self.chunks is not None:
            self.chunks.replan()
        elif (queue := queued_actions(self.policy)) is not None:
            queue.clear()
        else:
            self.policy.reset()

    def save(self, folder: Path) -> None:
        """Write weights, config and processors to a folder."""
        self.policy.save_pretrained(folder)
        self.preprocessor.save_pretrained(folder)
        self.postprocessor.save_pretrained(folder)
