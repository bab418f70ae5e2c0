"""Configuration of the latent safety filter as a LeRobot policy, in groups that are validated where they stand."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode
from lerobot.optim import AdamConfig, CosineDecayWithWarmupSchedulerConfig, OptimizerConfig
from lerobot.optim.optimizers import OptimizerParams
from lerobot.utils.constants import HF_LEROBOT_HOME
from torch.optim import Adam

from lerobot_latentsafe._compat import training_run
from lerobot_latentsafe.constraints import LikenessConfig
from lerobot_latentsafe.critic import BACKUPS, FallbackConfig, ReachabilityConfig
from lerobot_latentsafe.datasets.layout import check_for_lerobot
from lerobot_latentsafe.decision import LawConfig
from lerobot_latentsafe.margin import MarginConfig
from lerobot_latentsafe.units import TrainedOn
from lerobot_latentsafe.world_models import RSSMConfig, WorldModelConfig

if TYPE_CHECKING:
    from lerobot.configs.train import TrainPipelineConfig

SEALED = ("world_model", "fallback", "trained_on")
"""Groups that belong to the weights; the others are the user's."""
SEALED_ENTRIES = (
    *SEALED,
    "input_features",
    "output_features",
    *(f"margin.{name}" for name in ("hidden", "layers", "failure_specification")),
    *(f"reachability.{name}" for name in ("critic_hidden", "actor_hidden", "activation", "components")),
    "likeness",
    "normalization_mapping",
)
"""All that decides what the weights mean. Of margin and reachability the rest is about training."""


class CriticTargetError(ValueError):
    """A critic is asked for what it was not trained to say: a risk read as a safety value, or the reverse."""


@OptimizerConfig.register_subclass("latentsafe_adam")
@dataclass
class FusedAdamConfig(AdamConfig):
    """Adam that takes a step in one pass over the weights: torch's default takes several, five times as long here."""

    def build(self, params: OptimizerParams) -> Adam:
        """The optimizer of these parameters."""
        return Adam(params, self.lr, self.betas, self.eps, self.weight_decay, fused=True)


@PreTrainedConfig.register_subclass("latentsafe")
@dataclass
class LatentSafeConfig(PreTrainedConfig):
    """A world model, a failure margin and a safety actor-critic that shield another policy.

    Attributes:
        world_model: its type and sizes.
        margin: the failure margin (Eq. 3).
        reachability: actor-critic sizes and schedule (Eq. 5).
        fallback: what the fallback policy may do.
        likeness: what makes frames alike, and the constraints that were made of some; see `constraints.py`.
        constraints: names of those that count, of a filter that takes constraints, such as [spilled, left_of_line].
        law: when the filter acts; a user may change it.
        trained_on: what the weights were trained on, and how far.
        frame_cache: folder made by `latentsafe cache`; by default the one in the dataset's folder, if there is one.
        base_policy_path: the policy to shield: a folder, a Hub id or the name of a committed checkpoint.
        base_ahead: if not 0, the base policy's next chunk of actions is made off the control thread, begun when so many
            of the present one are still to come. For a base policy that takes longer than a period to think.
        calibration: the evidence epsilon was chosen on, see `Calibration`; written by `latentsafe calibrate`.
        evaluation: what was measured -> the rate in words; written by `latentsafe push --results=...` for the card.
        optimizer_lr, grad_clip_norm, scheduler_steps: of the training of world model and margin by lerobot-train.
        local_updates: steps of that training that each of several processes takes by itself before their weights are
            averaged, which saves most of the waiting. 1: gradients are averaged at each, and together the processes
            learn what one would.
        drop_n_last_frames: frames at the end of each episode at which no training window starts.
        normalization_mapping: identity: state and actions are scaled by the model with the numbers that it stores.
    """

    world_model: WorldModelConfig = field(default_factory=RSSMConfig)
    margin: MarginConfig = field(default_factory=MarginConfig)
    reachability: ReachabilityConfig = field(default_factory=ReachabilityConfig)
    fallback: FallbackConfig = field(default_factory=FallbackConfig)
    likeness: LikenessConfig = field(default_factory=LikenessConfig)
    constraints: list[str] = field(default_factory=list)
    law: LawConfig = field(default_factory=LawConfig)
    trained_on: TrainedOn = field(default_factory=TrainedOn)

    frame_cache: str | None = None
    base_policy_path: str | None = None
    base_ahead: int = 0
    calibration: dict[str, Any] = field(default_factory=dict)
    evaluation: dict[str, str] = field(default_factory=dict)

    optimizer_lr: float = 1e-3
    grad_clip_norm: float = 100.0
    scheduler_steps: int = 3000
    local_updates: int = 1
    drop_n_last_frames: int = 1
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict.fromkeys(("VISUAL", "STATE", "ACTION", "ENV"), NormalizationMode.IDENTITY)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.base_ahead < 0:
            raise ValueError(f"--policy.base_ahead is {self.base_ahead}; expected 0 (on the control thread) or more")
        if self.local_updates < 1:
            raise ValueError(f"--policy.local_updates is {self.local_updates}; expected at least 1")
        self.require_critic_of_law()
        self.require_known_commands()
        self.likeness.require_known(self.constraints, self.trained_on.stage == "critic")

    def require_critic_of_law(self) -> None:
        """Refuse a law that reads the critic as something it was not trained for.

        Raises:
            CriticTargetError: naming both.
        """
        target, law, needed = self.trained_on.target, self.law.name, self.law.critic
        if target not in BACKUPS:
            raise ValueError(f"target is {target!r}; expected one of {', '.join(BACKUPS)}")
        if self.trained_on.stage == "critic" and needed not in (None, target):
            raise CriticTargetError(
                f"--policy.law.name is {law!r}, but this filter's critic was trained for {target!r}; use it with "
                f"--policy.law.name={target}, or train one with latentsafe train-reachability --target={needed}"
            )

    def require_known_commands(self) -> None:
        """Refuse commands that no action has, and a retreat that leaves the range trained on, once that is known.

        Raises:
            ValueError: naming the command and what there is.
        """
        ranges = self.trained_on.motion_ranges
        if not ranges:
            return
        unknown = [name for name in self.fallback.named_commands if name not in ranges]
        if unknown:
            raise ValueError(f"no action is named {', '.join(unknown)}; there are {', '.join(ranges)}")
        for name, motion in self.law.retreat.items():
            wrong = f"--policy.law.retreat moves {name}"
            if name not in ranges:
                raise ValueError(f"{wrong}; the actions are {', '.join(ranges)}")
            if name in self.fallback.frozen_commands:
                raise ValueError(f"{wrong}, one of fallback.frozen_commands, which no fallback changes")
            low, high = ranges[name]
            if not low <= motion <= high:
                raise ValueError(f"{wrong} by {motion:g}; the filter was trained on {low:g} to {high:g}")

    def change(self, **groups: Any) -> None:
        """Take over new values of fields, if they make a configuration; LeRobot keeps a reference to this object.

        Raises:
            ValueError: what results is no configuration; nothing was changed.
        """
        replace(self, **groups)
        for name, value in groups.items():
            setattr(self, name, value)

    def require_averaged_checkpoints(self, run: "TrainPipelineConfig") -> None:
        """Refuse a training that would save weights which its processes have not averaged.

        Raises:
            ValueError: naming the option and what it may be.
        """
        apart = self.local_updates
        for name in ("steps", "save_freq"):
            if (steps := getattr(run, name)) % apart:
                raise ValueError(
                    f"--{name} is {steps}, and with --policy.local_updates={apart} weights are averaged after each "
                    f"{apart} steps; give --{name}={apart * max(1, round(steps / apart))}, or another multiple"
                )

    @property
    def observation_delta_indices(self) -> list[int] | None:
        """The frames of a clip; with a frame cache the policy cuts them itself, from `index`."""
        sizes = self.world_model
        return None if self.frame_cache else [sizes.frame_skip * t for t in range(sizes.clip_length)]

    @property
    def action_delta_indices(self) -> None:
        """Numbers are looked up beside the dataset, from `index`."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """No rewards are read."""
        return None

    def get_optimizer_preset(self) -> FusedAdamConfig:
        """Adam, as lerobot-train asks for it: the last time that it asks a policy before it opens the dataset.

        Raises:
            DatasetContractError: it would end in an error of its own there.
        """
        run = training_run()
        folder = None if run is None else run.dataset.root or HF_LEROBOT_HOME / str(run.dataset.repo_id)
        if folder is not None and (run.dataset.root or Path(folder).exists()):
            check_for_lerobot(Path(folder), run.dataset.use_imagenet_stats)
        return FusedAdamConfig(lr=self.optimizer_lr, weight_decay=0.0, grad_clip_norm=self.grad_clip_norm)

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        """Cosine decay to a twentieth after 100 steps of warm-up."""
        return CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=100,
            num_decay_steps=self.scheduler_steps,
            peak_lr=self.optimizer_lr,
            decay_lr=self.optimizer_lr / 20,
        )

    def validate_features(self) -> None:
        """Refuse a dataset without actions; one without proprioception is read by its pictures alone.

        Raises:
            ValueError: there is no action, or one of other numbers than the weights give.
        """
        if not self.action_feature:
            raise ValueError(
                "latentsafe needs an action feature, and output_features names none: take a dataset with actions, or "
                "restore the filter's config.json"
            )
        n, shape = len(self.trained_on.action_names or []), tuple(self.action_feature.shape)
        if n and shape != (n,):
            raise ValueError(f"output_features says that an action is {shape}, and the filter commands {n} numbers")
