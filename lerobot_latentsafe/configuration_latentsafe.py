"""Configuration of the latent safety filter as a LeRobot policy."""

from dataclasses import dataclass, field

from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import NormalizationMode
from lerobot.optim import AdamConfig, CosineDecayWithWarmupSchedulerConfig

from lerobot_latentsafe.reachability import BACKUPS, ReachabilityConfig
from lerobot_latentsafe.world_models import RSSMConfig, WorldModelConfig

STAGES = ("untrained", "world_model", "reachability")
MODES = ("filter", "monitor")
LAWS = ("reachability", "risk", "plan", "margin")
DECIDES = ("epsilon", "guard", "release")
"""Settings that say, with a law, when a filter acts."""
RECENT = 10
"""Steps whose overrides count for `patience`."""


class CriticTargetError(ValueError):
    """A critic is asked for what it was not trained to say: a risk read as a safety value, or the reverse."""


@PreTrainedConfig.register_subclass("latentsafe")
@dataclass
class LatentSafeConfig(PreTrainedConfig):
    """A world model, a failure margin and a safety actor-critic that shield another policy.

    Attributes:
        world_model: its type and sizes.
        margin_hidden, margin_layers: the failure margin's MLP (Eq. 3; 2 layers of 16 in the paper).
        margin_delta: delta of Eq. 3.
        margin_weight: weight of Eq. 3 in the training loss; 0 leaves the margin to `latentsafe train-margin`.
        margin_clips: windows of the data that `latentsafe train-margin` fits the margin to.
        failure_specification: name of the failure labels: a dataset column or a sidecar file.
        frame_cache: folder made by `latentsafe cache`; by default the one in the dataset's folder, if there is one.
        reachability: actor-critic sizes and schedule.
        action_candidates: the discrete action set in robot units, e.g. [[-1.25, 1], [0, 1], [1.25, 1]]; None:
            actions are continuous.
        stage: how far training has come: untrained, world_model, reachability. Set by the training commands.
        target: what the critic was trained for: `reachability` (Eq. 5) or `risk` (SQRL). Set by
            `latentsafe train-reachability`.
        epsilon: the filter intervenes where V of the predicted next latent is at or below this. A risk critic's V is
            -risk, so SQRL's threshold of 0.1 is an epsilon of -0.1.
        release: once the filter has acted, the base policy acts again only where V is above this, if that is more than
            epsilon. A policy that is given its way at every second step shakes what the fallback holds.
        retreat: a manoeuvre that is known to lead back to safety, command -> robot units a step, such as
            {delta_z.pos: -0.006}; it acts where the critic's action did not help. V, the worst of all times, is the
            same for waiting at a doubtful place as for leaving it, and the critic may wait.
        patience: overrides in the last ten steps after which the next is the retreat's.
        dwell: steps for which a retreat goes on at least: a single step leads nowhere.
        memory: frames that the filter remembers at most, and at least half as many; 0: the whole episode. A recurrent
            world model may make anything of more frames than a clip of its training has.
        guard: steps for which the proposed action is imagined held before V is asked. 1 is the paper's law; more give
            room for what the world model gets wrong, as time, which a saturated margin cannot.
        calibration: the evidence epsilon was chosen on; written by `latentsafe calibrate`.
        evaluation: what was measured -> the rate in words; written by `latentsafe push --results=...` for the card.
        lookahead: steps of imagination before the critic's value is read, 0 to 25: V and the fallback are the best of
            the critic's policy and of holding each action. 0 is the critic alone, and the cheapest.
        samples: next latents drawn from a stochastic world model, of which the worst counts; 0 imagines its mean or
            mode. If any, the critic is trained on drawn latents, too.
        law: what V is: `reachability`; or a baseline: `risk`, which needs a critic trained for it, `plan`, which
            imagines holding each action, and `margin`, which reads l alone and stands still.
        mode: `filter` overrides unsafe actions, `monitor` only reports what it would have done.
        deadline_ms: if set, a decision that took longer is not trusted, and the fallback acts.
        base_policy_path: the policy to shield: a folder, a Hub id or the name of a committed checkpoint.
        base_ahead: if not 0, the base policy's next chunk of actions is made off the control thread, begun when so many
            of the present one are still to come. For a base policy that takes longer than a period to think.
        cameras: the image features the filter reads, by default all of the dataset's.
        task: what the world model was trained to imagine, in words, where a policy of the same task must share it.
        robot_type: LeRobot's name of the robot that recorded the dataset.
        fps, state_names, action_names, action_low, action_high, state_mean, state_std: what the filter was trained
            on, in robot units; filled in from the dataset.
        kept_commands: actions that the fallback never changes, such as `gripper.pos`: it moves, but keeps its grip.
        fallback_moves: the commands that a continuous fallback may move, such as `delta_z.pos`, or in one direction
            only, such as `-delta_z.pos`; None: all. Where the data seldom show a motion, the world model only guesses
            what it does, and the fallback would exploit that.
        fallback_low, fallback_high: the range of the fallback's continuous actions, in [-1, 1]: that which the data
            cover. Set by `latentsafe train-reachability`.
        action_varies: False for commands the data never vary; the filter keeps those and knows nothing else of them.
    """

    world_model: WorldModelConfig = field(default_factory=RSSMConfig)
    margin_hidden: int = 16
    margin_layers: int = 2
    margin_delta: float = 0.75
    margin_weight: float = 10.0
    margin_clips: int = 10_000
    failure_specification: str = "failure"
    frame_cache: str | None = None

    reachability: ReachabilityConfig = field(default_factory=ReachabilityConfig)
    action_candidates: list[list[float]] | None = None
    kept_commands: list[str] = field(default_factory=list)
    fallback_moves: list[str] | None = None
    fallback_low: list[float] | None = None
    fallback_high: list[float] | None = None
    stage: str = "untrained"
    target: str = "reachability"

    epsilon: float = 0.0
    release: float = -1.0
    retreat: dict[str, float] = field(default_factory=dict)
    patience: int = 0
    dwell: int = 1
    memory: int = 0
    guard: int = 1
    samples: int = 0
    calibration: dict[str, float] = field(default_factory=dict)
    evaluation: dict[str, str] = field(default_factory=dict)
    lookahead: int = 15
    law: str = "reachability"
    mode: str = "filter"
    deadline_ms: float | None = None
    base_policy_path: str | None = None
    base_ahead: int = 0

    task: str | None = None
    cameras: list[str] | None = None
    robot_type: str | None = None
    fps: int | None = None
    state_names: list[str] | None = None
    action_names: list[str] | None = None
    action_low: list[float] | None = None
    action_high: list[float] | None = None
    action_varies: list[bool] | None = None
    state_mean: list[float] | None = None
    state_std: list[float] | None = None

    optimizer_lr: float = 1e-3
    grad_clip_norm: float = 100.0
    scheduler_steps: int = 3000
    drop_n_last_frames: int = 1

    # Images stay in [0, 1]; state and actions are scaled by the model with the numbers it stores itself.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.IDENTITY,
            "ACTION": NormalizationMode.IDENTITY,
            "ENV": NormalizationMode.IDENTITY,
        }
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stage not in STAGES:
            raise ValueError(f"stage is {self.stage!r}; expected one of {', '.join(STAGES)}")
        if self.mode not in MODES:
            raise ValueError(f"--policy.mode is {self.mode!r}; expected one of {', '.join(MODES)}")
        if self.law not in LAWS:
            raise ValueError(f"--policy.law is {self.law!r}; expected one of {', '.join(LAWS)}")
        if not 0 <= self.lookahead <= 25:
            raise ValueError(f"--policy.lookahead is {self.lookahead}; expected 0 (critic alone) to 25 imagined steps")
        if not 1 <= self.guard <= 25:
            raise ValueError(f"--policy.guard is {self.guard}; expected 1 (the paper's law) to 25 steps")
        if not 0 <= self.patience <= RECENT:
            raise ValueError(
                f"--policy.patience is {self.patience}; expected 0 (retreat at once) to {RECENT} overrides"
            )
        if self.dwell < 1:
            raise ValueError(f"--policy.dwell is {self.dwell}; expected at least 1 step")
        if self.memory != 0 and self.memory < 2:
            raise ValueError(f"--policy.memory is {self.memory}; expected 0 (the whole episode) or at least 2 frames")
        if not self.release < 1:
            raise ValueError(f"--policy.release is {self.release}; expected less than 1, which V never exceeds")
        if self.samples < 0:
            raise ValueError(f"--policy.samples is {self.samples}; expected 0 (mean or mode) or a number of draws")
        if self.base_ahead < 0:
            raise ValueError(f"--policy.base_ahead is {self.base_ahead}; expected 0 (on the control thread) or more")
        if self.margin_delta <= 0:
            raise ValueError(f"--policy.margin_delta is {self.margin_delta}; expected a positive number")
        self.require_critic_of_law()
        self.require_possible_retreat()

    def require_possible_retreat(self) -> None:
        """Refuse a retreat by commands that are unknown or kept, or out of the range trained on, once that is known."""
        if self.action_low is None:
            return
        ranges = dict(zip(self.action_names or [], zip(self.action_low, self.action_high)))
        for name, motion in self.retreat.items():
            if name not in ranges:
                raise ValueError(f"--policy.retreat moves {name}; the actions are {', '.join(ranges)}")
            if name in self.kept_commands:
                raise ValueError(f"--policy.retreat moves {name}, one of kept_commands, which no fallback changes")
            low, high = ranges[name]
            if not low <= motion <= high:
                wrong = f"--policy.retreat {name} is {motion:g}"
                raise ValueError(f"{wrong}; the filter was trained on {low:g} to {high:g}")

    def require_critic_of_law(self) -> None:
        """Refuse a law that reads the critic as something it was not trained for.

        Raises:
            CriticTargetError: naming both.
        """
        if self.target not in BACKUPS:
            raise ValueError(f"target is {self.target!r}; expected one of {', '.join(BACKUPS)}")
        if self.stage == "reachability" and self.law in BACKUPS and self.law != self.target:
            raise CriticTargetError(
                f"--policy.law is {self.law!r}, but this filter's critic was trained for {self.target!r}; use it with "
                f"--policy.law={self.target}, or train one with latentsafe train-reachability --target={self.law}"
            )
        if self.law == "risk" and self.lookahead:
            raise ValueError(
                f"--policy.lookahead is {self.lookahead}; a risk is read at the next latent: expected 0 with law 'risk'"
            )

    def override(self, options: object, *names: str) -> None:
        """Take over those of these options that are given, as attributes that are not None.

        Raises:
            ValueError: what results is no configuration.
        """
        for name in names:
            if getattr(options, name) is not None:
                setattr(self, name, getattr(options, name))
        self.__post_init__()

    @property
    def observation_delta_indices(self) -> list[int] | None:
        """Frames t .. t + T - 1; with a frame cache the policy cuts the window itself, from `index`."""
        return None if self.frame_cache else list(range(self.world_model.clip_length))

    @property
    def action_delta_indices(self) -> list[int] | None:
        """The action that led to each frame: LeRobot's frames are (o_t, a_t taken after o_t)."""
        return None if self.frame_cache else list(range(-1, self.world_model.clip_length - 1))

    @property
    def reward_delta_indices(self) -> None:
        return None

    def get_optimizer_preset(self) -> AdamConfig:
        return AdamConfig(lr=self.optimizer_lr, weight_decay=0.0, grad_clip_norm=self.grad_clip_norm)

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        return CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=100,
            num_decay_steps=self.scheduler_steps,
            peak_lr=self.optimizer_lr,
            decay_lr=self.optimizer_lr / 20,
        )

    def validate_features(self) -> None:
        if not self.robot_state_feature:
            raise ValueError("latentsafe needs observation.state (proprioception); the dataset has none")
        if not self.action_feature:
            raise ValueError("latentsafe needs an action feature; the dataset has none")
