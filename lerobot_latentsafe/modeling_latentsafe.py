"""The latent safety filter as a LeRobot policy.

`forward` is the training loss of world model and failure margin, so `lerobot-train --policy.type=latentsafe` trains
them. `select_action` is the fallback policy; given a base policy, it is the base policy, shielded.
"""

import logging
from pathlib import Path
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor

from lerobot_latentsafe.checkpoint import (
    CheckpointError,
    check_sealed,
    fitting_weights,
    read_config,
    resolve_checkpoint,
    seal,
)
from lerobot_latentsafe.configuration_latentsafe import STAGES, LatentSafeConfig
from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.datasets.frame_cache import to_model_images
from lerobot_latentsafe.filter import FilterDecision, Reason
from lerobot_latentsafe.margin import FailureMargin, hinge_loss
from lerobot_latentsafe.memory import keep_freed_memory
from lerobot_latentsafe.reachability import BACKUPS, LatentImagination, SafetyCritic, look_ahead, safety_bellman_target
from lerobot_latentsafe.shield import BasePolicy, Shield
from lerobot_latentsafe.world_models.base import Clip, Latent

logger = logging.getLogger(__name__)

BASE_FOLDER = "base_policy"
CONSTANT_BAND = 0.05
"""Relative half-width of the range of a command that never varies in the data."""
RANGE_SLACK = 0.25
"""Share of the range trained on by which another dataset's actions may exceed it."""


class UntrainedFilterError(RuntimeError):
    """The checkpoint has not been trained far enough for what is asked of it."""


class LatentSafePolicy(PreTrainedPolicy):
    """World model, failure margin, safety critic and, optionally, the base policy they shield."""

    config_class = LatentSafeConfig
    name = "latentsafe"

    def __init__(self, config: LatentSafeConfig, dataset_stats=None, dataset_meta=None, **kwargs: Any):
        super().__init__(config)
        self.reader: ClipReader | None = None
        if dataset_meta is not None:
            self.reader = ClipReader.of_dataset(config, dataset_meta)
            adopt_dataset(config, dataset_meta, dataset_stats or dataset_meta.stats)
        if config.action_low is None:
            raise UntrainedFilterError(
                "this latentsafe policy has no dataset and no checkpoint: train one with lerobot-train "
                "--policy.type=latentsafe --dataset.repo_id=..., or load one with --policy.path=..."
            )
        config.validate_features()
        moved = (name[1:] if name.startswith(("+", "-")) else name for name in config.fallback_moves or [])
        named = (*config.kept_commands, *moved)
        unknown = [name for name in named if name not in config.action_names]
        if unknown:
            raise ValueError(f"no action is named {', '.join(unknown)}; there are {', '.join(config.action_names)}")
        config.require_possible_retreat()  # a dataset may have told the ranges only now
        n_actions = len(config.action_low)
        self.world_model = config.world_model.build(config.cameras, len(config.state_mean), n_actions)
        if self.reader is not None and self.reader.cache is not None:
            self.world_model.load_basis(Path(config.frame_cache))
        self.margin = FailureMargin(self.world_model.feature_dim, config.margin_hidden, config.margin_layers)
        for name in ("action_low", "action_high", "state_mean", "state_std"):
            self.register_buffer(name, torch.tensor(getattr(config, name), dtype=torch.float32), persistent=False)
        self.register_buffer("action_varies", torch.tensor(config.action_varies), persistent=False)
        candidates = None
        if config.action_candidates is not None:
            candidates = self.normalise_action(torch.tensor(config.action_candidates, dtype=torch.float32))
        kept = torch.tensor([name in config.kept_commands for name in config.action_names])
        self.register_buffer("kept", kept, persistent=False)
        self.critic = self.new_critic(candidates)
        self._ddp_params_and_buffers_to_ignore = self._never_averaged()
        self._base: list[BasePolicy] = []  # in a list, so that its weights are not ours
        self.shield = Shield(self)
        if config.base_policy_path:
            self.attach(config.base_policy_path)

    def new_critic(self, candidates: Tensor | None) -> SafetyCritic:
        """A critic with fresh weights, bounded to the commands the fallback may move."""
        names, chosen = self.config.action_names, self.config.fallback_moves
        moves, bounds = self.action_varies & ~self.kept, []
        for sign, bound in (("-", self.config.fallback_low), ("+", self.config.fallback_high)):
            allowed = [chosen is None or name in chosen or sign + name in chosen for name in names]
            bound = torch.tensor(bound) if bound else float(sign + "1") * torch.ones(len(names))
            bounds.append((bound * torch.tensor(allowed)).to(moves.device) * moves)
        sizes = self.world_model.feature_dim, len(moves), candidates, self.config.reachability
        return SafetyCritic(*sizes, *bounds, self.config.target).to(moves.device)

    @property
    def imagination(self) -> LatentImagination:
        """World model and margin, as reachability sees them."""
        return LatentImagination(self.world_model, self.margin, self.kept, self.config.samples > 0)

    # -- units ---

    @property
    def device(self) -> torch.device:
        return self.action_low.device

    def normalise_action(self, action: Tensor) -> Tensor:
        """Robot units -> [-1, 1] by the dataset's range."""
        return 2 * (action - self.action_low) / (self.action_high - self.action_low) - 1

    def denormalise_action(self, action: Tensor) -> Tensor:
        """[-1, 1] -> robot units."""
        return self.action_low + (action + 1) / 2 * (self.action_high - self.action_low)

    def first_action(self, action: Tensor) -> Tensor:
        """What counts as having led to the first frame of an episode: no motion, kept commands as in `action`."""
        return torch.where(self.kept, action, 0.0)

    def normalise_state(self, state: Tensor) -> Tensor:
        return (state.float() - self.state_mean) / self.state_std

    def model_images(self, images: Tensor) -> Tensor:
        return to_model_images(images, self.config.world_model.image_size)

    def hold_action(self, batch_size: int) -> Tensor:
        """What to do when nothing can be known: zero motion, or the nearest the range allows."""
        middle = (self.action_low + self.action_high) / 2
        still = torch.zeros_like(middle).clamp(self.action_low, self.action_high)
        return torch.where(self.action_varies, still, middle).repeat(batch_size, 1)

    def commands_seen(self, state: Tensor) -> Tensor:
        """What a normalised state (B, S) tells of commands of the same name, such as `gripper.pos`.

        Returns:
            (B, A) in robot units, in range; NaN for commands that the state does not tell.
        """
        names, seen = self.config.state_names or [], state.new_full((len(state), len(self.action_low)), torch.nan)
        for i, name in enumerate(self.config.action_names or []):
            if name in names:
                j = names.index(name)
                seen[:, i] = state[:, j] * self.state_std[j] + self.state_mean[j]
        return seen.clamp(self.action_low, self.action_high)

    # -- training (stage 1) ---

    def get_optim_params(self) -> list:
        return [*self.world_model.parameters(), *self.margin.parameters()]

    def _never_averaged(self) -> list[str]:
        """What torch's DistributedDataParallel, which reads this list, need not send around at every step.

        That is the critic, which this stage does not train, and all buffers, which are the same on every rank.
        """
        trained = {id(p) for p in self.get_optim_params()}
        untrained = [name for name, p in self.named_parameters() if id(p) not in trained]
        return [*untrained, *(name for name, _ in self.named_buffers())]

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """World-model loss plus the weighted hinge loss of the margin (Eq. 3)."""
        if self.reader is None:
            raise UntrainedFilterError(
                "forward needs the dataset's labels: build the policy through lerobot-train or make_policy(ds_meta=...)"
            )
        if self.device.type == "cpu":
            keep_freed_memory()
        loss, _, metrics = self.clip_loss(self.reader.read(batch, self))
        return loss, {name: torch.as_tensor(value).item() for name, value in metrics.items()}

    def clip_loss(self, clip: Clip) -> tuple[Tensor, Tensor, dict[str, Tensor | float]]:
        """The loss of a clip, the features (B, T, D) of its frames, and metrics."""
        loss, features, metrics = self.world_model.loss(clip)
        margin = self.margin(features)
        failure = torch.where(clip.valid, clip.failure, -1)
        margin_loss = hinge_loss(margin, failure, self.config.margin_delta)
        loss = loss + self.config.margin_weight * margin_loss
        labelled = failure >= 0
        correct = (((margin < 0) == (failure == 1)) & labelled).sum() / labelled.sum()
        if self.training:
            self.config.stage = STAGES[1]
        return loss, features, {**metrics, "loss_margin": margin_loss, "margin_accuracy": correct}

    def value(self, latent: Latent) -> Tensor:
        """V(z) of latents (B, ...) -> (B,); see `plan`."""
        return self.plan(latent)[0]

    def plan(self, latent: Latent) -> tuple[Tensor, Tensor]:
        """The safety value V(z), and the fallback action in [-1, 1]: (B,), (B, A).

        min(l, max_a Q) of the critic, read after `config.lookahead` imagined steps of the best of a few policies; or
        what `config.law` says instead.
        """
        self.require_stage(self.needed_stage)
        still = self.normalise_action(self.hold_action(1))
        if self.config.law == "margin":
            margin = self.imagination.margin(latent)
            return margin, self.imagination.complete(latent, still.expand(len(margin), -1))
        critic = self.critic if self.config.law in BACKUPS else None
        return look_ahead(self.imagination, latent, self.critic.held_actions(still), self.config.lookahead, critic)

    @property
    def needed_stage(self) -> str:
        """How far training must have come for this law to decide."""
        return "reachability" if self.config.law in BACKUPS else "world_model"

    def worst(self, margin: Tensor, value: Tensor) -> Tensor:
        """The value of going through a margin l to a latent of some value, all (...,): Eq. 5 undiscounted."""
        return BACKUPS.get(self.config.law, safety_bellman_target)(margin, value, 1.0)

    # -- deployment ---

    @property
    def base(self) -> BasePolicy | None:
        return self._base[0] if self._base else None

    def attach(self, path: str | Path) -> None:
        """Shield the policy at `path`: folder, Hub id or committed name."""
        base = BasePolicy(path, self.config.device, self.config.base_ahead)
        own, theirs = self.config.action_feature, base.config.action_feature
        if theirs is None or tuple(own.shape) != tuple(theirs.shape):
            raise ValueError(
                f"base policy {path} acts in {getattr(theirs, 'shape', None)}, the filter in {own.shape} "
                f"({', '.join(self.config.action_names or [])}); they must share one action space"
            )
        for name in ("task", "fps", "action_names"):  # a policy with a world model says what that is of
            known, wanted = getattr(self.config, name), getattr(base.config, name, None)
            if known is not None and wanted is not None and known != wanted:
                raise ValueError(f"base policy {path} has {name} = {wanted}, the filter {known}; they must agree")
        self.config.input_features = {**base.config.input_features, **self.config.input_features}
        self.config.base_policy_path = str(path)
        self._base = [base]

    def reset(self) -> None:
        """Start an episode."""
        self.shield.reset()
        if self.base:
            self.base.reset()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The shielded base action, or the fallback's action if there is no base policy: (B, A) in robot units."""
        return self.decide(batch).action

    @torch.no_grad()
    def decide(self, batch: dict[str, Tensor], age_s: float = 0.0) -> FilterDecision:
        """Like `select_action`, with the whole decision."""
        self.require_stage(self.needed_stage)
        if self.base is None:
            return self.shield(batch, None, age_s, without=Reason.NO_BASE_POLICY)
        try:
            proposed = self.base.propose(batch)
        except Exception:
            if self.config.mode == "monitor":
                raise
            logger.exception("base policy failed; the fallback acts")
            proposed = None
        decision = self.shield(batch, proposed, age_s)
        if decision.intervened.any():
            self.base.replan(decision.action)
        return decision

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """A chunk of one: (B, 1, A). A longer one would be filtered on stale observations."""
        return self.select_action(batch).unsqueeze(1)

    def require_stage(self, stage: str) -> None:
        """Raise unless training has come at least this far, and the critic says what the law reads."""
        self.config.require_critic_of_law()
        if STAGES.index(self.config.stage) < STAGES.index(stage):
            part, command = {
                "world_model": ("world model", "lerobot-train --policy.type=latentsafe"),
                "reachability": ("safety critic", "latentsafe train-reachability --policy.path=..."),
            }[stage]
            raise UntrainedFilterError(
                f"this filter's stage is {self.config.stage!r}, {stage!r} is needed: its {part} was never "
                f"trained. Run {command} first"
            )

    # -- files ---

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        config, base_path = self.config, self.config.base_policy_path
        if self.base:
            self.base.save(save_directory / BASE_FOLDER)
            config.base_policy_path = BASE_FOLDER
        try:
            super()._save_pretrained(save_directory, state_dict=state_dict)
        finally:
            config.base_policy_path = base_path
        seal(save_directory)

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: str | Path | None, *, config: LatentSafeConfig | None = None,
        revision: str | None = None, strict: bool = True, **kwargs: Any,
    ) -> "LatentSafePolicy":  # fmt: skip
        """Load from a folder, a committed name or a Hub id; refuses what is cut, edited or of another type."""
        if pretrained_name_or_path is None:
            raise CheckpointError(
                "a latentsafe policy needs a trained filter: give --policy.path=<filter> "
                "(with --policy.base_policy_path=<policy to shield>) instead of --policy.type=latentsafe"
            )
        hub = {k: kwargs.pop(k) for k in ("cache_dir", "token", "local_files_only", "force_download") if k in kwargs}
        folder = resolve_checkpoint(pretrained_name_or_path, revision, **{k: v for k, v in hub.items() if v})
        config = config or read_config(folder)
        if not isinstance(config, LatentSafeConfig):
            raise CheckpointError(
                f"{pretrained_name_or_path} is a {config.type!r} policy, expected a 'latentsafe' filter; "
                "policies to be shielded go to --base_policy_path"
            )
        check_sealed(folder)
        if config.base_policy_path == BASE_FOLDER and (folder / BASE_FOLDER).is_dir():
            config.base_policy_path = str(folder / BASE_FOLDER)
        with fitting_weights(folder):
            return super().from_pretrained(folder, config=config, strict=True, **kwargs)

    def generate_model_card(self, dataset_repo_id: str, model_type: str, license: str | None,
                            tags: list[str] | None, cfg=None, dataset_meta=None):  # fmt: skip
        """A card that says what the filter was trained on, how epsilon was set, and what it is not."""
        from lerobot_latentsafe.model_card import make_model_card

        return make_model_card(self.config, dataset_repo_id, license, tags)


def adopt_dataset(config: LatentSafeConfig, meta, stats: dict) -> None:
    """Fill units and ranges in from a dataset, or check that it matches what the filter was trained on."""
    action, state = meta.features["action"], meta.features["observation.state"]
    found = {
        "fps": int(meta.fps),
        "action_names": list(action["names"] or []),
        "state_names": list(state["names"] or []),
    }
    for name, value in found.items():
        known = getattr(config, name)
        if known is not None and known != value:
            raise ValueError(
                f"{meta.repo_id} has {name} = {value}, this filter was trained with {known}; "
                "train a new filter or use a dataset recorded with the same robot and rate"
            )
        setattr(config, name, value)
    config.robot_type = config.robot_type or meta.robot_type
    if config.action_low is None:
        low, high = _list(stats["action"]["min"]), _list(stats["action"]["max"])
        config.action_varies = [h - l > 1e-6 for l, h in zip(low, high)]
        if not any(config.action_varies):
            raise ValueError(f"the actions of {meta.repo_id} never change: {low}; record episodes that move")
        # A command that never varies gets a band around it, so that float noise is not out of range.
        band = [0.0 if v else CONSTANT_BAND * max(abs(l), 1.0) for v, l in zip(config.action_varies, low)]
        config.action_low = [l - b for l, b in zip(low, band)]
        config.action_high = [h + b for h, b in zip(high, band)]
        config.state_mean = _list(stats["observation.state"]["mean"])
        config.state_std = [max(s, 1e-3) for s in _list(stats["observation.state"]["std"])]
    _check_range(config, meta.repo_id, _list(stats["action"]["min"]), _list(stats["action"]["max"]))
    # The data's actions decide the candidates' range check.
    for candidate in config.action_candidates or []:
        inside = all(lo - 1e-4 <= a <= hi + 1e-4 for lo, a, hi in zip(config.action_low, candidate, config.action_high))
        if len(candidate) != len(config.action_low) or not inside:
            raise ValueError(
                f"action candidate {candidate} is outside of what {meta.repo_id} covers: "
                f"{config.action_low} to {config.action_high}"
            )


def _check_range(config: LatentSafeConfig, repo_id: str, low: list[float], high: list[float]) -> None:
    """Refuse actions far outside of the range that the filter was trained on: they would be clipped, unseen."""
    for name, l, h, trained_low, trained_high in zip(
        config.action_names, low, high, config.action_low, config.action_high
    ):
        slack = RANGE_SLACK * (trained_high - trained_low)
        if l < trained_low - slack or h > trained_high + slack:
            raise ValueError(
                f"{name} of {repo_id} reaches from {l:g} to {h:g}, this filter was trained on {trained_low:g} to "
                f"{trained_high:g}: another unit, or another robot? Convert the actions, or train a new filter"
            )


def _list(values) -> list[float]:
    return [float(v) for v in torch.as_tensor(values).flatten()]
