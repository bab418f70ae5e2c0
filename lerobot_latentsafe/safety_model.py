"""World model, failure margin and safety critic as one plain object: no LeRobot policy, no history, no files.

The shield, the evaluation, the task policy that learns in imagination and the LeRobot policy share it.
"""

import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor, nn

from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.constraints import Constrained, Likeness
from lerobot_latentsafe.critic import BACKUPS, SafetyCritic, safety_bellman_target
from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.latent import Latent, is_sound, map_latent
from lerobot_latentsafe.limits import Limits
from lerobot_latentsafe.margin import FailureMargin, hinge_loss
from lerobot_latentsafe.meanings import MeaningError
from lerobot_latentsafe.pictures import to_model_images
from lerobot_latentsafe.reachability import look_ahead
from lerobot_latentsafe.units import Units
from lerobot_latentsafe.unknown.monitor import Familiar, StatisticsError
from lerobot_latentsafe.world_models.base import WorldModel


class UntrainedFilterError(RuntimeError):
    """The checkpoint has not been trained far enough for what is asked of it."""


class LatentImagination:
    """A world model and failure margin behind the `Imagination` protocol.

    Args:
        frozen: bool (A,), commands that a fallback leaves as they were, such as a gripper's.
        sampled: draw what comes next from the world model's distribution, instead of its mean or mode.
    """

    def __init__(self, world_model: WorldModel, margin: FailureMargin, frozen: Tensor, sampled: bool = False):
        self.world_model, self.failure_margin, self.frozen, self.sampled = world_model, margin, frozen, sampled

    def step(self, latent: Latent, action: Tensor) -> Latent:
        """Next latent under actions (B, A) in [-1, 1], each held for all ticks of a step."""
        return self.follow(latent, action.repeat(1, self.world_model.config.frame_skip))

    def follow(self, latent: Latent, actions: Tensor) -> Latent:
        """Next latent under the actions of a step's ticks, side by side (B, K A)."""
        step = self.world_model.sample_step if self.sampled else self.world_model.step
        return step(latent, actions)

    def features(self, latent: Latent) -> Tensor:
        """(B, D), what actor and critic read."""
        return self.world_model.features(latent)

    def ended(self, latent: Latent) -> Tensor:
        """Whether the episode is over in this latent: bool (B,)."""
        return self.world_model.ended(latent)

    def margin(self, latent: Latent) -> Tensor:
        """Bounded margin l(z): (B,)."""
        return self.judged(latent)[1]

    def judged(self, latent: Latent) -> tuple[Tensor, Tensor]:
        """Features (B, D) and bounded margin (B,), both at once."""
        features = self.world_model.features(latent)
        return features, self.failure_margin.bounded(features)

    def complete(self, latent: Latent, action: Tensor) -> Tensor:
        """The action (B, A) with the frozen commands as they were before this latent."""
        before = latent["action"][:, -action.shape[-1] :]  # of the last tick
        return torch.where(self.frozen.to(action.device), before, action)


class SafetyModel(nn.Module):
    """z, l, Q and the units of a robot.

    Args:
        config: of the filter; its `trained_on` must be filled in. The world model may complete `config.world_model`,
            by the encoder that it found.

    Attributes:
        units: normalises and denormalises.
        limits: of what the robot can show and may be told.
        world_model, margin, critic: the parts.
        likeness: says where a latent is, of a filter that takes constraints; else None.
        familiar: what the monitor of the unknown has learned; None where there is none.
        lacks_weights: whether the configuration speaks of trained weights, and nothing was loaded or trained since.

    Raises:
        UntrainedFilterError: nothing says what actions and states look like.
    """

    def __init__(self, config: LatentSafeConfig):
        super().__init__()
        trained_on = config.trained_on
        if trained_on.action_low is None:
            raise UntrainedFilterError(
                "this latentsafe policy has no dataset and no checkpoint: train one with lerobot-train "
                "--policy.type=latentsafe --dataset.repo_id=..., or load one with --policy.path=..."
            )
        self.config = config
        self.units = Units(trained_on, config.fallback.frozen_commands)
        self.limits = Limits(trained_on, self.units)
        sizes = len(trained_on.state_mean), len(trained_on.action_low) * config.world_model.frame_skip
        with warnings.catch_warnings():  # without proprioception some layers have no inputs
            warnings.filterwarnings("ignore", "Initializing zero-element tensors")
            self.world_model = config.world_model.build(trained_on.cameras, *sizes)
        config.change(world_model=self.world_model.config)
        self._perhaps_targets = trained_on.perhaps_targets(config.fallback.frozen_commands)
        self.familiar: Familiar | None = None
        self.margin = self.new_margin()
        self.likeness = self.new_likeness()
        self.critic = self.new_critic()
        self.lacks_weights = trained_on.has_reached("world_model")
        self.register_load_state_dict_post_hook(_has_loaded)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "SafetyModel":
        """What torch does at `.to(...)`: another device is fine, another precision is not what was measured.

        Raises:
            TypeError: naming the precision.
        """
        asked = fn(torch.zeros(1)).dtype
        if asked != torch.float32:
            raise TypeError(
                f"a latentsafe filter decides in single precision (torch.float32), and was to become {asked}. Leave "
                "the dtype out; a base policy may have its own (`policy.base.policy.to(...)`)"
            )
        return super()._apply(fn, recurse)

    def new_margin(self) -> FailureMargin:
        """A margin with fresh weights."""
        config = self.config.margin
        return FailureMargin(self.world_model.feature_dim, config.hidden, config.layers).to(self.device)

    def new_likeness(self) -> Likeness | None:
        """What says where a latent is, with fresh weights; None where the filter takes no constraints."""
        config = self.config.likeness
        return Likeness(self.world_model.feature_dim, config).to(self.device) if config.alike else None

    def new_critic(self) -> SafetyCritic:
        """A critic with fresh weights, bounded to the commands that the fallback may move."""
        units, fallback, candidates = self.units, self.config.fallback, None
        if fallback.action_candidates is not None:
            robots = torch.tensor(fallback.action_candidates, dtype=torch.float32, device=units.device)
            candidates = units.normalise_motions(robots)
        bounds = fallback.bounds(units.action_names, units.action_varies & ~units.frozen)
        sizes = self.world_model.feature_dim, len(units.action_low), candidates, self.config.reachability
        numbers = len(self.config.likeness.numbers)
        return SafetyCritic(*sizes, *bounds, self.config.trained_on.target, numbers).to(self.device)

    @property
    def device(self) -> torch.device:
        """Where the weights lie."""
        return self.units.device

    def single_precision(self) -> AbstractContextManager:
        """Meanwhile torch computes in single precision, also where a caller asked for mixed precision (autocast)."""
        return torch.autocast(self.device.type, enabled=False)

    @property
    def imagination(self) -> LatentImagination | Constrained:
        """World model and margin, as reachability sees them; the margin is that of the constraints, if there are."""
        inside = LatentImagination(self.world_model, self.margin, self.units.frozen, self.config.law.samples > 0)
        if self.likeness is None:
            return inside
        active = self.config.likeness.tensor(self.config.constraints)
        return Constrained(inside, self.likeness, active.to(self.device))

    # -- seeing ---

    def images(self, images: Tensor) -> Tensor:
        """Pictures (..., 3, H, W), uint8 or in [0, 1], as the world model takes them."""
        return to_model_images(images, self.config.world_model.image_size)

    def place(self, numbers: Tensor) -> Tensor:
        """Numbers on this model's device; of 64-bit floats, which Apple's GPUs do not have, single ones."""
        return numbers.to(self.device, torch.float32) if numbers.is_floating_point() else numbers.to(self.device)

    def tensor(self, numbers: np.ndarray) -> Tensor:
        """Numbers of the host, on this model's device."""
        return torch.from_numpy(numbers).to(self.device)

    @property
    def inputs(self) -> list[str]:
        """Keys of an observation that are read."""
        return [*self.world_model.image_keys, *([OBS_STATE] if self.units.state_names else [])]

    def state(self, observation: dict[str, Tensor]) -> Tensor:
        """Proprioception (B, S) in robot units; S is 0 where the model was trained without."""
        if not self.units.state_names:
            return torch.zeros(len(observation[self.world_model.image_keys[0]]), 0, device=self.device)
        return self.place(observation[OBS_STATE]).float()

    def see(self, observation: dict[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
        """Percepts and normalised proprioception (B, S) of a LeRobot batch of observations in robot units."""
        images = {key: self.images(self.place(observation[key])) for key in self.world_model.image_keys}
        return self.world_model.perceive(images), self.units.normalise_state(self.state(observation))

    # -- deciding ---

    def value(self, latent: Latent) -> Tensor:
        """V(z) of latents (B, ...) -> (B,); see `plan`."""
        return self.plan(latent)[0]

    def plan(self, latent: Latent) -> tuple[Tensor, Tensor]:
        """The safety value V(z), and the fallback action in [-1, 1]: (B,), (B, A).

        min(l, max_a Q) of the critic (Eq. 4), read after `law.lookahead` imagined ticks of the best of a few policies;
        or what `law.name` says instead.
        """
        self.require_trained_for_law()
        law, still = self.config.law, self.units.still
        if law.name == "margin":
            margin = self.imagination.margin(latent)
            return margin, self.imagination.complete(latent, still.expand(len(margin), -1))
        critic = self.critic if law.critic else None
        horizon = self.config.world_model.steps(law.lookahead)
        return look_ahead(self.imagination, latent, self.critic.held_actions(still), horizon, critic)

    def worst(self, margin: Tensor, value: Tensor) -> Tensor:
        """The value of going through a margin l to a latent of some value, all (...,): Eq. 5 undiscounted."""
        return BACKUPS.get(self.config.law.critic, safety_bellman_target)(margin, value, 1.0)

    def go_on(self, latent: Latent, ahead: Tensor, n: int | None = None) -> tuple[Latent, Tensor]:
        """n x B latents after `law.proposal_steps` ticks, and the least margin until there (n x B,).

        Args:
            ahead: (B, K, A), actions as they are heard: the first step hears these, those after it the last, held.
            n: futures of each latent; by default as many as `law.samples`, at least one.
        """
        law, imagination = self.config.law, self.imagination
        n = n or max(1, law.samples)
        action, held = ahead.flatten(1).repeat(n, 1), ahead[:, -1].repeat(n, ahead.shape[1])
        latent = map_latent(latent, lambda t: t.repeat(n, *[1] * (t.dim() - 1)))
        least = torch.full_like(action[:, 0], torch.inf)
        for _ in range(self.config.world_model.steps(law.proposal_steps)):
            latent, action = imagination.follow(latent, action), held
            least = torch.minimum(least, imagination.margin(latent))
        return latent, least

    def through(self, latent: Latent, margin: Tensor, least: Tensor, value: Tensor) -> Tensor:
        """V of actions (B,): of the worst future of each, and of what is now.

        A margin that is negative now, or on the way, is a failure whatever comes after.

        Args:
            latent, margin: B latents now, and l of them.
            least, value: (n x B,) of `go_on`, and V of the latents that it leads to.
        """
        value = self.worst(least, value).view(-1, len(margin)).amin(0)
        return torch.where(is_sound(latent), self.worst(margin, value), torch.nan)

    def value_of_holding(self, latent: Latent, heard: Tensor, roughly: bool = False) -> Tensor:
        """A lower bound of V of actions (B, A), as they are heard, each held from a latent: (B,).

        What comes after them follows the critic's policy alone, not the best of several as in `plan`. So it is cheaper.

        Args:
            roughly: by one future, and without looking ahead: no bound, but cheaper still.
        """
        law, sizes, imagination = self.config.law, self.config.world_model, self.imagination
        n, horizon = (1, 0) if roughly else (None, sizes.steps(law.lookahead))
        predicted, least = self.go_on(latent, heard[:, None].repeat(1, sizes.frame_skip, 1), n)
        none_held = self.units.still[:0]
        value = look_ahead(imagination, predicted, none_held, horizon, self.critic)[0]
        return self.through(latent, imagination.margin(latent), least, value)

    @property
    def _stage_of_law(self) -> str:
        law = self.config.law
        return "critic" if law.critic else "guard" if law.name == "guard" else "world_model"

    def is_trained_for_law(self) -> bool:
        """Whether training has come far enough for the law to decide."""
        return self.config.trained_on.has_reached(self._stage_of_law)

    def require_trained_for_law(self) -> None:
        """Raise unless training has come far enough for the law to decide, and it is known how to stand still.

        Raises:
            MeaningError: a filter of a version before 0.3, to which joint targets were motions: its hold is a jump.
        """
        self.require_stage(self._stage_of_law)
        if self.familiar is None and self.config.trained_on.monitor is not None:
            raise StatisticsError(
                "this filter's monitor of the unknown has no statistics: its configuration was read, its files were "
                "not. Load both with LatentSafePolicy.from_pretrained(folder)"
            )
        if self._perhaps_targets:
            raise MeaningError(
                f"this filter was trained by a version before 0.3 and may take {', '.join(self._perhaps_targets)} for "
                "motions, though the state has numbers of these names. If they are targets, its hold would be a jump. "
                "Train the world model and the critic again: training then tells what each command means"
            )

    def require_stage(self, stage: str) -> None:
        """Raise unless training has come at least this far, and the critic says what the law reads.

        Raises:
            UntrainedFilterError: naming what was never trained, and the command.
            CriticTargetError: the critic was trained for something else.
        """
        self.config.require_critic_of_law()
        trained_on = self.config.trained_on
        if not trained_on.has_reached(stage):
            part, command = {
                "guard": ("range", "latentsafe guard --dataset.repo_id=..."),
                "world_model": ("world model", "lerobot-train --policy.type=latentsafe"),
                "critic": ("safety critic", "latentsafe train-reachability --policy.path=..."),
            }[stage]
            raise UntrainedFilterError(
                f"this filter's stage is {trained_on.stage!r}, {stage!r} is needed: its {part} was never "
                f"trained. Run {command} first"
            )
        if self.lacks_weights:
            raise UntrainedFilterError(
                "this filter has random weights: its configuration was read, its weights were not. Load both with "
                "LatentSafePolicy.from_pretrained(folder), or set config.pretrained_path to the folder before "
                "LeRobot's make_policy"
            )

    # -- learning ---

    def clip_loss(self, clip: Clip) -> tuple[Tensor, Tensor, dict[str, Tensor | float]]:
        """The loss of a clip (world model, and Eq. 3 weighted), the features (B, T, D) of its frames, and metrics."""
        loss, features, metrics = self.world_model.loss(clip)
        margin = self.margin(features)
        failure = torch.where(clip.valid, clip.failure, -1)
        margin_loss = hinge_loss(margin, failure, self.config.margin.delta)
        loss = loss + self.config.margin.weight * margin_loss
        labelled = failure >= 0
        correct = (((margin < 0) == (failure == 1)) & labelled).sum() / labelled.sum()
        if self.training:  # a critic of the world model before knows nothing of this one
            self.config.trained_on.stage = "world_model"
            self.lacks_weights = False
        return loss, features, {**metrics, "loss_margin": margin_loss, "margin_accuracy": correct}


def _has_loaded(model: SafetyModel, incompatible: Any) -> None:
    if not incompatible.missing_keys:
        model.lacks_weights = False
