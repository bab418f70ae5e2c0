"""The latent safety filter as a LeRobot policy.

`forward` is the training loss of world model and failure margin, so `lerobot-train --policy.type=latentsafe` trains
them. `select_action` is the fallback policy; given a base policy, it is the base policy, shielded.
"""

import logging
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import ModelCard
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from lerobot_latentsafe._compat import EVALUATION, NOT_AVERAGED, ROLLOUT, called_from, training_run
from lerobot_latentsafe.base_policy import BasePolicy, base_to_shield
from lerobot_latentsafe.calibration import Calibration, belonging, differences
from lerobot_latentsafe.configuration_latentsafe import SEALED, SEALED_ENTRIES, LatentSafeConfig
from lerobot_latentsafe.datasets.adoption import adopt_dataset, check_candidates
from lerobot_latentsafe.datasets.clips import FilterData
from lerobot_latentsafe.datasets.fingerprints import episode_marks, with_episodes
from lerobot_latentsafe.datasets.live_cameras import looks_of
from lerobot_latentsafe.decision import FilterDecision, LawOptions, Reason
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.host import on_host
from lerobot_latentsafe.model_card import make_model_card
from lerobot_latentsafe.runtime.checkpoint import (
    BASE_FOLDER,
    check_in_use,
    check_sealed,
    fitting_weights,
    read_config,
    seal,
    weights_digest,
    writing_checkpoint,
)
from lerobot_latentsafe.runtime.distributed import agree, on_its_own
from lerobot_latentsafe.runtime.locations import CheckpointError, resolve_checkpoint
from lerobot_latentsafe.runtime.malloc import keep_freed_memory
from lerobot_latentsafe.runtime.processors import check_own_processors
from lerobot_latentsafe.runtime.time_limit import TimeLimit
from lerobot_latentsafe.safety_model import SafetyModel, UntrainedFilterError
from lerobot_latentsafe.shield import Shield
from lerobot_latentsafe.unknown.monitor import Familiar, StatisticsError

logger = logging.getLogger(__name__)

STATISTICS = "policy_monitor.safetensors"
"""The file of the monitor's numbers, in a filter's folder; its name is one that a seal covers."""


class LatentSafePolicy(PreTrainedPolicy):
    """A safety model behind a shield and, optionally, the base policy that they shield.

    Args:
        config: of the filter.
        dataset_stats, dataset_meta: of the dataset to train on, as LeRobot's `make_policy` gives them.
        model: a safety model that exists already; by default one with fresh weights.

    Attributes:
        model: world model, margin, critic and units.
        shield: history, faults and the law.
        reader: clips of the dataset that the policy is trained on, if it was made for one.
    """

    config_class = LatentSafeConfig
    name = "latentsafe"

    def __init__(
        self, config: LatentSafeConfig, dataset_stats=None, dataset_meta=None, model: SafetyModel | None = None,
        **kwargs: Any,
    ):  # fmt: skip
        super().__init__(config)
        data = None
        if dataset_meta is not None:
            if (run := training_run()) is not None:
                config.require_averaged_checkpoints(run)
            data = adopt(config, dataset_meta)
        self.model = model or SafetyModel(config)
        config.validate_features()
        self.reader = None if data is None else data.reader(config.world_model, self.model.units)
        if data is not None and data.cache is not None:
            self.model.world_model.load_basis(Path(data.frame_cache))
        setattr(self, NOT_AVERAGED, self._never_averaged())
        self._steps = 0
        self._told_untrained = self._told_outdated = False
        self._base: list[BasePolicy] = []  # in a list, so that its weights are not ours
        self._base_lost = False
        self._in_time = TimeLimit(self.model.device.type)
        self.shield = Shield(self.model)
        if config.base_policy_path and not self.model.lacks_weights:
            self.attach(config.base_policy_path)

    # -- training (stage 1) ---

    def get_optim_params(self) -> list:
        """Parameters of world model and margin; the critic is trained by `latentsafe train-reachability`."""
        return [*self.model.world_model.parameters(), *self.model.margin.parameters()]

    def _never_averaged(self) -> list[str]:
        """What DistributedDataParallel need not send around at every step.

        That is the critic, which this stage does not train, and all buffers, which are the same on every rank.
        """
        trained = {id(p) for p in self.get_optim_params()}
        untrained = [name for name, p in self.named_parameters() if id(p) not in trained]
        return [*untrained, *(name for name, _ in self.named_buffers())]

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """World-model loss plus the weighted hinge loss of the margin (Eq. 3), in mixed precision under autocast."""
        if self.reader is None:
            raise UntrainedFilterError(
                "forward needs the dataset's labels: build the policy through lerobot-train or make_policy(ds_meta=...)"
            )
        if self.model.device.type == "cpu":
            keep_freed_memory()
        clip = self.reader.read(batch, self.model)
        with on_its_own() if self.config.local_updates > 1 else nullcontext():
            loss, _, metrics = self.model.clip_loss(clip)
        told = torch.stack([torch.as_tensor(value, device=loss.device).float() for value in metrics.values()])
        return loss, dict(zip(metrics, told.tolist()))  # a GPU is waited for once

    def update(self) -> None:
        """Average weights over ranks after every `local_updates` steps; LeRobot calls this after each."""
        self._steps += 1
        if self.config.local_updates > 1 and self._steps % self.config.local_updates == 0:
            agree(self.model.world_model)
            agree(self.model.margin)

    # -- deployment ---

    @property
    def base(self) -> BasePolicy | None:
        """The policy that is shielded."""
        return self._base[0] if self._base else None

    def attach(self, base: str | Path | BasePolicy) -> None:
        """Shield a policy: an object, or that of a folder, a Hub id or a committed name.

        Raises:
            ValueError: it acts in another action space, reads another state, or acts at another rate.
        """
        path = getattr(base.config, "pretrained_path", None) if isinstance(base, BasePolicy) else base
        if not isinstance(base, BasePolicy):
            base = BasePolicy.load(base, self.config.device, self.config.base_ahead)
        self._check_base(base, path)
        base.speak(self.config.trained_on.action_names, self.config.trained_on.state_names)
        features = {**base.config.input_features, **self.config.input_features}
        self.config.change(input_features=features, base_policy_path=str(path or "base policy"))
        self._base = [base]

    def _check_base(self, base: BasePolicy, path: str | Path | None) -> None:
        trained_on = self.config.trained_on
        own, theirs = self.config.action_feature, base.config.action_feature
        if theirs is None or tuple(own.shape) != tuple(theirs.shape):
            raise ValueError(
                f"base policy {path} acts in {getattr(theirs, 'shape', None)}, the filter in {own.shape} "
                f"({', '.join(trained_on.action_names or [])}); they must share one action space"
            )
        task = getattr(base.config, "task", None)  # a policy with a world model says what that is of
        for name, known, wanted in (("task", trained_on.task, task), ("fps", trained_on.fps, base.origin.fps)):
            if known is not None and wanted is not None and known != wanted:
                raise ValueError(f"base policy {path} has {name} = {wanted}, the filter {known}; they must agree")

    def reset(self) -> None:
        """Start an episode."""
        if called_from(EVALUATION):  # a simulation waits for every action
            self.shield.clock = standing_still
        self.shield.pace.strict |= called_from(ROLLOUT)
        self.say_if_outdated()
        self.shield.reset()
        self.shield.warm_up()
        if self.base:
            self._replan(None, None)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The shielded base action, or the fallback's action if there is no base policy: (B, A) in robot units."""
        if self.reader is not None and not self.model.is_trained_for_law():
            return self._stand_still(batch)
        return self.decide(batch).action

    def _stand_still(self, batch: dict[str, Tensor]) -> Tensor:
        """No motion (B, A): what lerobot-train's `--env.type` evaluates while there is no critic yet."""
        if not self._told_untrained:
            self._told_untrained = True
            logger.warning(
                "lerobot-train evaluates a filter whose safety critic is not trained yet: the robot stands still, and "
                "the success rate says nothing. Leave out --env.type, or give --env_eval_freq=0; train the critic with "
                "latentsafe train-reachability, then measure with latentsafe eval-shield"
            )
        return self.model.tensor(self.model.limits.hold(on_host(self.model.state(batch))))

    @torch.no_grad()
    def decide(self, batch: dict[str, Tensor], age_s: float = 0.0) -> FilterDecision:
        """Like `select_action`, with the whole decision.

        Args:
            age_s: seconds since before the observation was taken.
        """
        self.model.require_trained_for_law()
        self.shield.offer()
        if self.base is None:
            return self._judge(batch, None, age_s, missing_reason=Reason.NO_BASE_POLICY)
        began = self.shield.clock()
        proposed, wrong = self._ask_base(batch, age_s)
        plan = {} if proposed is None else {"planned": self.base.planned, "coming": self.base.coming}
        age_s += self.shield.clock() - began
        decision = self._judge(batch, proposed, age_s, missing_reason=wrong, **plan)
        # A policy that is only late keeps its plan where the robots stayed meanwhile.
        stayed = wrong == Reason.DEADLINE_MISSED and self.shield.guard.holding.all()
        if self._breaks_the_plan(decision) and not stayed:
            self._replan(decision.action, self.shield.patience(len(decision.action)))
        return decision

    def _breaks_the_plan(self, decision: FilterDecision) -> bool:
        """Whether what is done is so far from what the base policy wanted that it is to plan anew, or be told."""
        if decision.falls_back.any() or (self.base.is_told and decision.intervened.any()):
            return True
        away = self.shield.nearest.deviation(decision)[on_host(decision.adjusted, torch.bool)]
        return bool((away > self.config.law.replan_above).any())

    def _ask_base(self, batch: dict[str, Tensor], age_s: float) -> tuple[Tensor | None, Reason]:
        """What the base policy proposes; None, and why, if it gives nothing in time."""
        if self._base_lost:
            self._replan(None, self.shield.patience(self._rows(batch)))
        if self._base_lost:
            return None, Reason.BASE_POLICY_FAILED
        # It gets an observation of its own: what it does to it must not change what is judged.
        own = {key: value.clone() if isinstance(value, Tensor) else value for key, value in batch.items()}
        left_s = self.shield.time_left(age_s, self._rows(batch))
        try:
            return self._in_time(lambda: self.base.propose(own), left_s), Reason.BASE_POLICY_FAILED
        except TimeoutError as e:
            self.shield.note_failure("the base policy was late", e)
            return None, Reason.DEADLINE_MISSED
        except Exception as e:
            if self.config.law.mode == "monitor":  # there is nothing else to do than what the policy wants
                raise
            self.shield.note_failure("the base policy failed", e)
            return None, Reason.BASE_POLICY_FAILED

    def _rows(self, batch: dict[str, Tensor]) -> int:
        """For how many robots an observation is, by what the filter reads of it."""
        read = [batch.get(key) for key in self.model.inputs]
        return min((len(value) for value in read if isinstance(value, Tensor) and value.dim() > 1), default=1)

    def _replan(self, executed: Tensor | None, seconds: float | None) -> None:
        """Have the base policy plan anew after an override (B, A), or begin; one that cannot is asked nothing.

        Args:
            seconds: to wait for it at most; None: however long it takes.
        """
        if self._in_time.busy:  # it is still at work on what is past
            self._base_lost = True
            return
        try:
            self._in_time(lambda: self.base.reset() if executed is None else self.base.replan(executed), seconds)
            self._base_lost = False
        except Exception as e:
            self._base_lost = True
            self.shield.note_failure("the base policy could not plan anew", e)

    @torch.compiler.disable
    def _judge(self, *given: Any, **options: Any) -> FilterDecision:
        """The shield's decision, in single precision under autocast and uncompiled: the same wherever it is made."""
        with self.model.single_precision():
            return self.shield(*given, **options)

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """A chunk of one: (B, 1, A). A longer one would be filtered on stale observations."""
        return self.select_action(batch).unsqueeze(1)

    def supports_rtc(self) -> bool:
        """No: a chunk is decided on one observation, and a filter must see what every action of it leads to."""
        logger.error(
            "a shielded policy judges one action a tick, and real-time chunking asks for whole chunks. Run the bare "
            "policy with --inference.type=rtc on a shielded robot (--robot.type=latentsafe_shielded)"
        )
        return False

    # -- what its calibration belongs to ---

    def belonging(self) -> dict[str, Any]:
        """What a calibration of this filter is of: its law, its weights, and the policy that it shields."""
        base = weights_digest(self.base.policy.state_dict()) if self.base else None
        config = self.config
        constraints = {name: config.likeness.known[name] for name in sorted(config.constraints)}
        weights = weights_digest(self.model.state_dict())
        return belonging(config.law, weights, base, config.base_policy_path, constraints)

    def take_calibration(self, found: Calibration, epsilon: float) -> None:
        """Set the threshold, and keep the evidence beside it, with what it belongs to."""
        self.config.change(law=replace(self.config.law, epsilon=epsilon))
        self.config.change(calibration=replace(found, belongs_to=self.belonging()).as_json())

    def outdated(self) -> list[str]:
        """In words, why the evidence for epsilon does not speak of this filter as it is; empty where it does."""
        return differences(self.config.calibration, self.belonging()) if self.config.calibration else []

    def say_if_outdated(self) -> None:
        """Warn once of a calibration that is another filter's."""
        if self._told_outdated:
            return
        self._told_outdated = True
        for why in self.outdated():
            logger.warning("epsilon is not calibrated for this filter: %s. Run latentsafe calibrate again", why)

    # -- files ---

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        config, base_path = self.config, self.config.base_policy_path
        config.base_policy_path = BASE_FOLDER if self.base else None
        try:
            with writing_checkpoint(save_directory) as folder:
                if self.base:
                    self.base.save(folder / BASE_FOLDER)
                super()._save_pretrained(folder, state_dict=state_dict)
                if self.model.familiar is not None:
                    save_file(self.model.familiar.tensors(), folder / STATISTICS)
                seal(folder, SEALED_ENTRIES)
        finally:
            config.base_policy_path = base_path

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: str | Path | None, *, config: LatentSafeConfig | None = None,
        revision: str | None = None, strict: bool = True, **kwargs: Any,
    ) -> "LatentSafePolicy":  # fmt: skip
        """Load from a folder, a committed name or a Hub id.

        Raises:
            CheckpointError: what is cut, edited, overridden or of another type, or names what it may not.
        """
        if pretrained_name_or_path is None:
            raise CheckpointError(
                "a latentsafe policy needs a trained filter: give --policy.path=<filter> "
                "(with --policy.base_policy_path=<policy to shield>) instead of --policy.type=latentsafe"
            )
        hub = {k: kwargs.pop(k) for k in ("cache_dir", "token", "local_files_only", "force_download") if k in kwargs}
        folder = resolve_checkpoint(pretrained_name_or_path, revision, **{k: v for k, v in hub.items() if v})
        config = config or read_config(folder)
        _check(folder, config, training="dataset_meta" in kwargs)
        chosen, base = config.base_policy_path, base_to_shield(folder, config.base_policy_path)
        config.base_policy_path = None  # it is attached when the weights are there
        try:
            with fitting_weights(folder):
                policy = super().from_pretrained(folder, config=config, strict=True, **kwargs)
        finally:
            config.base_policy_path = chosen
        if config.trained_on.monitor is not None:
            policy.monitor_by(_familiar(folder, policy.model))
        if base is not None:
            policy.attach(base)
        return policy

    def monitor_by(self, familiar: Familiar) -> None:
        """Watch for the unknown by these numbers, in a shield that remembers nothing yet."""
        self.model.familiar = familiar
        self.shield = Shield(self.model)

    def generate_model_card(self, dataset_repo_id: str, model_type: str, license: str | None,
                            tags: list[str] | None, cfg=None, dataset_meta=None) -> ModelCard:  # fmt: skip
        """A card that says what the filter was trained on, how epsilon was set, and what it is not."""
        return make_model_card(self.config, dataset_repo_id, license, tags, self.outdated())


def world_model_digest(model: SafetyModel) -> str:
    """Identifies the weights of a world model."""
    return weights_digest(model.world_model.state_dict())[:16]


def _familiar(folder: Path, model: SafetyModel) -> Familiar:
    """The numbers of a filter's monitor.

    Raises:
        CheckpointError: they are missing, not readable, or of another monitor, camera or world model.
    """
    file, record, again = (
        folder / STATISTICS,
        model.config.trained_on.monitor,
        "fit the monitor again: latentsafe monitor",
    )
    if not file.is_file():
        raise CheckpointError(f"{file} is missing, and the filter has a monitor of the unknown; {again}")
    try:
        found = Familiar.of(load_file(file))
    except (SafetensorError, OSError, StatisticsError) as e:
        raise CheckpointError(f"{file} is not readable ({e}); {again}") from e
    image_keys, size = list(model.world_model.image_keys), model.config.world_model.image_size
    for what, known, used in (
        ("numbers", record.statistics, found.digest()),
        ("cameras", record.cameras, image_keys),
        ("number of cameras", len(record.cameras), found.n_cameras),
        ("image_size", record.image_size, size),
        ("world model", record.world_model, world_model_digest(model)),
    ):
        if known != used:
            raise CheckpointError(f"the monitor of {folder} was fitted with {what} {known}, and finds {used}; {again}")
    return found


def _check(folder: Path, config: PreTrainedConfig, training: bool) -> None:
    """Refuse a filter that is not as it was saved, in the configuration that is used.

    Raises:
        CheckpointError: what is cut, edited, overridden or of another type.
    """
    if not isinstance(config, LatentSafeConfig):
        raise CheckpointError(
            f"{folder} is a {config.type!r} policy, expected a 'latentsafe' filter; "
            "policies to be shielded go to --base_policy_path"
        )
    if config.use_peft:
        raise CheckpointError(
            f"--policy.use_peft of {folder} is true; a filter's weights take no adapter: leave it out"
        )
    check_sealed(folder, SEALED)
    check_in_use(folder, config, SEALED_ENTRIES)
    config.validate_features()
    check_own_processors(config, folder, renames=training)


def load_filter(
    path: str | Path, *, law: LawOptions | None = None, base_policy: str | Path | BasePolicy | None = None,
    device: str | None = None,
) -> LatentSafePolicy:  # fmt: skip
    """A trained filter, ready to decide.

    Args:
        path: a folder, a Hub id, or the name of a committed checkpoint, such as "dubins".
        law: changes of its law, such as LawOptions(epsilon=0.3); by default the checkpoint's.
        base_policy: the policy to shield; by default that of the checkpoint, if any.
        device: such as "cuda"; by default the checkpoint's.

    Raises:
        CheckpointError: nothing to load, or something cut, edited or of another type.
        ValueError: a law that is none, or a base policy of another action space.
    """
    folder = resolve_checkpoint(path)
    config = read_config(folder, device)
    if base_policy is not None and isinstance(config, LatentSafeConfig):
        config.base_policy_path = None  # it is not even looked at
    policy = LatentSafePolicy.from_pretrained(folder, config=config).eval()
    if law is not None:
        policy.config.change(law=policy.config.law.changed(law))
    if base_policy is not None:
        policy.attach(base_policy)
    policy.say_if_outdated()
    policy.shield.warm_up()
    return policy


def adopt(config: LatentSafeConfig, meta: LeRobotDatasetMetadata) -> FilterData:
    """Open a dataset for a filter, and take over what it tells: units, ranges, cameras, cache.

    Raises:
        UnlabelledDatasetError: no failure labels.
        FrameCacheError: a torn cache, or one of another dataset, image size or encoder.
        MeaningError: what a command means cannot be told.
        ValueError: another robot, rate, range or camera than those trained on.
    """
    data = FilterData.open(
        meta, config.margin.failure_specification, config.frame_cache, config.world_model.image_size,
        config.trained_on.cameras,
    )  # fmt: skip
    if config.trained_on.action_low is not None:  # else LeRobot has just read the shapes from the same dataset
        data.check_cameras({key: config.input_features[key].shape for key in data.cameras})
    trained_on = adopt_dataset(config.trained_on, data.contract)
    run, contract = training_run(), data.contract
    marks = episode_marks(contract.episode, contract.state, contract.action)
    trained_on = with_episodes(trained_on, marks, run.dataset.episodes if run is not None else None)
    trained_on.cameras = list(data.cameras)
    if trained_on.looks is None:
        trained_on.looks = looks_of(meta, data.contract, trained_on, data.cache)
    check_candidates(config.fallback.action_candidates, trained_on, meta.repo_id)
    features = {key: feature for key, feature in config.input_features.items() if key not in data.contract.left_out}
    features |= {key: PolicyFeature(FeatureType.VISUAL, shape) for key, shape in data.cameras.items()}
    if data.contract.state_names:
        features[OBS_STATE] = PolicyFeature(FeatureType.STATE, (len(data.contract.state_names),))
    actions = {ACTION: PolicyFeature(FeatureType.ACTION, (len(data.contract.action_names),))}
    world_model = config.world_model
    config.change(
        trained_on=trained_on,
        world_model=world_model if data.cache is None else world_model.of_cache(data.cache.manifest),
        frame_cache=data.frame_cache,
        input_features=features,
        output_features={**config.output_features, **actions},
    )
    return data
