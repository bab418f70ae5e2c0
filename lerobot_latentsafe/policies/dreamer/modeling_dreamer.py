"""The task policy of the blocks study: DreamerV3's actor-critic in a world model's imagination, as a LeRobot policy."""

import copy
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import ModelCard
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor

from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.host import on_host
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.model_card import make_task_policy_card
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.policies.dreamer.behavior import Actor, ReturnRange, TwoHotHead, imagine, lambda_returns
from lerobot_latentsafe.policies.dreamer.configuration_dreamer import LatentSafeDreamerConfig
from lerobot_latentsafe.runtime.checkpoint import fitting_weights, read_config
from lerobot_latentsafe.runtime.hub import save_policy
from lerobot_latentsafe.runtime.locations import CheckpointError, named_by, resolve_checkpoint
from lerobot_latentsafe.safety_model import SafetyModel, UntrainedFilterError

WORLD_MODEL_FOLDER = "world_model"
SHARED = ("task", "cameras", "fps", "state_names", "action_names")
"""What policy and world model must agree on."""


class WorldModelMismatchError(ValueError):
    """A world model of another task, camera, rate, state or action space than the policy's."""


class LatentSafeDreamerPolicy(PreTrainedPolicy):
    """Actor, critic and reward head on the latents of a world model, which has a folder of its own in a checkpoint.

    Args:
        model: the world model with its units and margin; by default what lies at `config.world_model_path`.
    """

    config_class = LatentSafeDreamerConfig
    name = "latentsafe_dreamer"

    def __init__(self, config: LatentSafeDreamerConfig, model: SafetyModel | None = None, **kwargs: Any):
        super().__init__(config)
        model = model or _load_world_model(config)
        adopt_world_model(config, model)
        self._model = [model]  # in a list, so that its weights are not ours
        behavior, dim = config.behavior, model.world_model.feature_dim
        self.actor = Actor(dim, model.units.action_varies.clone(), behavior)
        self.critic, self.reward = TwoHotHead(dim, behavior), TwoHotHead(dim, behavior)
        self.slow_critic = copy.deepcopy(self.critic).requires_grad_(False)
        self.return_range = ReturnRange(behavior.return_rate)
        self.to(model.device)
        self.reset()

    @property
    def model(self) -> SafetyModel:
        """World model, margin and units."""
        return self._model[0]

    def train(self, mode: bool = True) -> "LatentSafeDreamerPolicy":
        """Policy and world model to training, or to evaluation."""
        self.model.train(mode)
        return super().train(mode)

    def require_stage(self, stage: str) -> None:
        """Raise unless the world model's training has come at least this far."""
        self.model.require_stage(stage)

    # -- acting ---

    def reset(self) -> None:
        """Start an episode."""
        self.latent: Latent | None = None
        self.executed: Tensor | None = None

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The likeliest action: (B, A) in robot units."""
        return self.act(batch, explore=False)

    @torch.no_grad()
    def act(self, batch: dict[str, Tensor], explore: bool) -> Tensor:
        """One tick: look, and choose the likeliest action, or a drawn one. (B, A) in robot units."""
        model, units = self.model, self.model.units
        model.require_stage("world_model")
        percepts, state = model.see(batch)
        first = self.latent is None
        if first:  # what the fingers do is known of every frame that was learned from, so it must be of this one
            self.executed = units.first_action(self._seen_commands(batch))
        self.latent = model.world_model.observe(self.latent, self.executed, percepts, state)
        features = model.world_model.features(self.latent)
        self.executed = self.actor.sample(features).clamp(-1, 1) if explore else self.actor.mode(features)
        if first:  # what counts as having led to the first frame depends on its action, see `first_action`
            self.latent = model.world_model.observe(None, units.first_action(self.executed), percepts, state)
        return units.denormalise_action(self.executed)

    def _seen_commands(self, batch: dict[str, Tensor]) -> Tensor:
        """What the state shows of commands of the same name: (B, A), inside; zero of others."""
        units = self.model.units
        shown = self.model.tensor(self.model.limits.seen(on_host(self.model.state(batch))))
        return units.normalise_action(shown.clamp(units.action_low, units.action_high)).nan_to_num(0.0)

    def was_overridden(self, executed: Tensor) -> None:
        """Remember what was done, (B, A) in robot units, instead of what was chosen."""
        self.executed = self.model.units.normalise_action(executed).clamp(-1, 1)

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """A chunk of one: (B, 1, A)."""
        return self.select_action(batch).unsqueeze(1)

    # -- learning ---

    def get_optim_params(self) -> list:
        """Parameters of actor, critic and reward head."""
        return [*self.actor.parameters(), *self.critic.parameters(), *self.reward.parameters()]

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Refused: this policy learns from episodes of its own."""
        raise UntrainedFilterError(
            "a latentsafe_dreamer policy learns from episodes of its own: train it with latentsafe train-dreamer"
        )

    def model_loss(self, clip: Clip, reward: Tensor) -> tuple[Tensor, Tensor, dict[str, Tensor | float]]:
        """Loss of world model, margin and reward head, the clip's features (B, T, D), and metrics.

        Args:
            reward: (B, T), that of arriving at each frame.
        """
        loss, features, metrics = self.model.clip_loss(clip)
        reward_loss = (self.reward.loss(features, reward) * clip.valid).sum() / clip.valid.sum()
        return loss + reward_loss, features, {**metrics, "loss_reward": reward_loss}

    def cloning_loss(self, features: Tensor, meant: Tensor, known: Tensor) -> Tensor:
        """Negative log density of the actions that an operator meant to take after each frame: ().

        Args:
            features: (B, T, D); meant: (B, T, A) in [-1, 1]; known: bool (B, T), frames after which there is one.
        """
        surprise = -self.actor.log_prob(features, meant)
        return (surprise * known).sum() / known.sum().clamp(min=1)

    def behavior_losses(self, start: Latent) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Losses of actor (by the policy gradient) and critic on imagined rollouts from N latents, and metrics."""
        config, world_model = self.config.behavior, self.model.world_model
        features, actions = imagine(world_model, self.actor, start, config.horizon)
        with torch.no_grad():
            reward, value = self.reward(features[1:]), self.slow_critic(features)
            returns = lambda_returns(reward, value[1:], config.gamma, config.trace)
            advantage = (returns - value[:-1]) / self.return_range.update(returns)
        before = features[:-1]
        entropy = self.actor.entropy(before).mean()
        actor_loss = -(advantage * self.actor.log_prob(before, actions)).mean() - config.entropy * entropy
        critic_loss = self.critic.loss(before, returns).mean()
        metrics = {
            "loss_actor": actor_loss, "loss_critic": critic_loss, "entropy": entropy,
            "imagined_reward": reward.mean(), "imagined_return": returns.mean(),
        }  # fmt: skip
        return actor_loss, critic_loss, metrics

    @torch.no_grad()
    def follow_slowly(self) -> None:
        """Move the slow critic towards the critic."""
        slow, fast = tuple(self.slow_critic.parameters()), tuple(self.critic.parameters())
        torch._foreach_lerp_(slow, fast, self.config.behavior.slow_rate)

    # -- files ---

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        save_policy(LatentSafePolicy(self.model.config, model=self.model), save_directory / WORLD_MODEL_FOLDER)
        config, path = self.config, self.config.world_model_path
        config.world_model_path = WORLD_MODEL_FOLDER
        try:
            super()._save_pretrained(save_directory, state_dict=state_dict)
        finally:
            config.world_model_path = path

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: str | Path, *, config: LatentSafeDreamerConfig | None = None,
        revision: str | None = None, strict: bool = True, **kwargs: Any,
    ) -> "LatentSafeDreamerPolicy":  # fmt: skip
        """Load from a folder, a committed name or a Hub id."""
        folder = resolve_checkpoint(pretrained_name_or_path, revision)
        config = config or read_config(folder)
        if not isinstance(config, LatentSafeDreamerConfig):
            raise CheckpointError(f"{pretrained_name_or_path} is a {config.type!r} policy, expected latentsafe_dreamer")
        config.world_model_path = _found_world_model(folder, config.world_model_path)
        with fitting_weights(folder):
            return super().from_pretrained(folder, config=config, strict=True, **kwargs)

    def generate_model_card(self, dataset_repo_id: str, model_type: str, license: str | None,
                            tags: list[str] | None, cfg=None, dataset_meta=None) -> ModelCard:  # fmt: skip
        """A card that says that this policy is a baseline that fails at times."""
        config = self.config
        return make_task_policy_card(config.task, config.repo_id or "me/policy", dataset_repo_id, license, tags)


def stored_world_model(folder: Path, config: LatentSafeDreamerConfig) -> str | None:
    """Path of the world model of a policy stored in a folder: beside it, or that of a checkpoint which it shares."""
    path = config.world_model_path
    return str(folder / path) if path == WORLD_MODEL_FOLDER else path


def _found_world_model(folder: Path, path: str | None) -> str | None:
    """Where it is on this machine: a user may choose any, a folder's own configuration names what it may name."""
    if path is None or path != getattr(read_config(folder), "world_model_path", None):
        return path
    return str(named_by(folder, path, f"Put it into {folder / WORLD_MODEL_FOLDER}, or give --policy.world_model_path"))


def _load_world_model(config: LatentSafeDreamerConfig) -> SafetyModel:
    if config.world_model_path is None:
        raise UntrainedFilterError(
            "this latentsafe_dreamer policy has no world model: train one with latentsafe train-dreamer, or load one "
            "with --policy.path=..."
        )
    return load_filter(config.world_model_path, device=config.device).model


def adopt_world_model(config: LatentSafeDreamerConfig, model: SafetyModel) -> None:
    """Take over what the policy sees and does from its world model, or check that they agree.

    Raises:
        WorldModelMismatchError: naming what differs.
    """
    for name in SHARED:
        known, found = getattr(config, name), getattr(model.config.trained_on, name)
        if known is not None and known != found:
            raise WorldModelMismatchError(
                f"the world model has {name} = {found}, this policy was trained with {known}; give it the world model "
                "it came with, or train another with latentsafe train-dreamer"
            )
        setattr(config, name, found)
    config.input_features, config.output_features = (
        dict(model.config.input_features),
        dict(model.config.output_features),
    )
