"""Verbs that make a filter: cached frames, the margin, the critic, the threshold."""

from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

from lerobot.envs.configs import EnvConfig

from lerobot_latentsafe.calibration import (
    Calibration,
    Scores,
    calibrate,
    check_options,
    curve,
    in_words,
    require_few_alarms,
)
from lerobot_latentsafe.cli.options import CACHE_THEM, DatasetSource
from lerobot_latentsafe.cli.places import PolicySource
from lerobot_latentsafe.conformal import fixed_sequence, needed_for_sure, proven
from lerobot_latentsafe.constraints import LikenessConfig
from lerobot_latentsafe.datasets.build_cache import MakeRecipe, build_frame_cache
from lerobot_latentsafe.datasets.cache_recipes import TOKEN_COMPONENTS, TOKEN_TYPES, Pictures, Tokens
from lerobot_latentsafe.datasets.cache_tasks import ShardedBuild, build_sharded_cache
from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.datasets.episode_groups import groups_of, weights_of
from lerobot_latentsafe.datasets.fingerprints import episode_marks, refuse_trained_on
from lerobot_latentsafe.datasets.frame_cache import FrameCache
from lerobot_latentsafe.datasets.join_caches import join_caches
from lerobot_latentsafe.decision import ENGINES
from lerobot_latentsafe.encoders.perception import PerceptionConfig
from lerobot_latentsafe.evaluation.decision_values import decision_values
from lerobot_latentsafe.evaluation.rollouts import failures_by_epsilon
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.labeling.constraints import add_constraint
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.reports.figures import misses_and_alarms, save
from lerobot_latentsafe.runtime import distributed
from lerobot_latentsafe.runtime.files import refuse_existing, replacing_folder
from lerobot_latentsafe.runtime.hub import save_policy
from lerobot_latentsafe.runtime.options import require_at_least
from lerobot_latentsafe.runtime.tasks import Tasks
from lerobot_latentsafe.training import load_with_cache, train_margin, train_reachability


@dataclass
class Cache:
    """Copy a dataset without its images, and store what a world model sees of its frames beside it.

    latentsafe cache --dataset.repo_id=me/bag --dataset.root=data/bag --output_dir=data/bag_tokens --encoder=auto

    For an RSSM that is each frame, decoded and resized. With --encoder it is the tokens of a frozen encoder and their
    principal components, for a token world model (gru, dino_wm). If a build was killed, start it again: it goes on.
    `torchrun --nproc_per_node=N $(which latentsafe) cache ...` shares the work among processes of one computer.

    With --tasks.number=N the cache is made in N shards, by --tasks.workers processes here, or by Slurm or Ray. A shard
    that is done stays. docs/scaling.md shows a file of options for a cluster.
    """

    output_dir: Path
    """The folder to write."""
    dataset: DatasetSource = field(default_factory=DatasetSource)
    image_size: int | None = None
    """Pixels; by default 32, or with an encoder what that is usually given: 96 for efficientnet_lite0, 224 for DINO."""
    encoder: str | None = None
    """auto, dinov2, dinov2_registers, dinov3, efficientnet_lite0, a folder or a Hub id."""
    token_components: int | None = None
    """Principal components that stand for each camera's token of a patch, a sixth of the bytes; 0: whole tokens, as the
    published DINO-WM reads them. By default 16, or as many as --basis_from has."""
    dtype: str = "float16"
    """How tokens are stored: float16, or int8 with a scale for each token."""
    basis_from: Path | None = None
    """Another cache, whose principal components to use: one world model must read all its data by the same."""
    engine: str = "torch"
    """What encodes: torch; or onnx, ONNX Runtime, faster on a CPU and equal to torch up to rounding."""
    tasks: Tasks = field(default_factory=Tasks)

    def __post_init__(self) -> None:
        require_at_least("--image_size", self.image_size, 1)
        require_at_least("--token_components", self.token_components, 0)
        if self.dtype not in TOKEN_TYPES:
            raise ValueError(f"--dtype is {self.dtype!r}; expected {' or '.join(TOKEN_TYPES)}")
        if self.engine not in ENGINES:
            raise ValueError(f"--engine is {self.engine!r}; expected {' or '.join(ENGINES)}")
        if self.engine != "torch" and not self.encoder:
            raise ValueError(
                f"--engine={self.engine} computes an encoder's tokens, and there is no encoder; give --encoder"
            )

    def run(self) -> None:
        """Build the cache, or go on building it."""
        cache = self._in_shards() if self.tasks.number else self._whole()
        if cache is None:
            return  # another process finishes
        print(f"{cache.manifest['n_frames']} frames at {cache.image_size} px in {self.output_dir}")
        print(f"train with --dataset.repo_id={cache.manifest['repo_id']}_cache --dataset.root={self.output_dir}")

    def _whole(self) -> FrameCache | None:
        dataset = self.dataset.opened()
        return build_frame_cache(dataset, self.output_dir, self.image_size, self._recipe(), self.dataset.episodes)

    def _in_shards(self) -> FrameCache | None:
        self.tasks.require_executor()
        meta, output_dir = self.dataset.metadata(), self.output_dir.absolute()
        build = ShardedBuild(meta.repo_id, Path(meta.root).absolute(), output_dir, self.image_size, self._recipe())
        cache = build_sharded_cache(build, self.tasks, self.dataset.episodes)
        if cache is None:
            print(f"submitted: the last task finishes {output_dir}; logs are in {output_dir}.tasks")
        return cache

    def _recipe(self) -> MakeRecipe:
        if not self.encoder:
            return Pictures
        config = PerceptionConfig(encoder=self.encoder, token_components=self._token_components())
        basis_from = self.basis_from and self.basis_from.absolute()
        return partial(Tokens, config=config, dtype=self.dtype, basis_from=basis_from, engine=self.engine)

    def _token_components(self) -> int:
        if self.token_components is not None:
            return self.token_components
        if self.basis_from is None:
            return TOKEN_COMPONENTS
        return FrameCache.open(self.basis_from).manifest.get("token_components", 0)


@dataclass
class JoinCaches:
    """Make one cached dataset of several, to train on all of them; what was perceived is linked, not copied.

    latentsafe join-caches --sources='[data/bag_tokens,data/lift_tokens]' --repo_id=me/all --output_dir=data/all_tokens

    LeRobot's training takes one dataset at a time: it refuses --dataset.repo_id='[a,b]'. Caches must be alike: the same
    cameras, sizes and encoder, and with an encoder the same principal components (latentsafe cache --basis_from).
    Labels come along.
    """

    sources: list[Path]
    """Folders of cached datasets."""
    repo_id: str
    """The id of the new one."""
    output_dir: Path
    """The folder to write."""

    def run(self) -> None:
        """Join."""
        cache = join_caches(self.sources, self.repo_id, self.output_dir)
        print(f"{cache.manifest['n_frames']} frames of {len(self.sources)} datasets in {self.output_dir}")
        print(f"train with --dataset.repo_id={self.repo_id} --dataset.root={self.output_dir}")


@dataclass
class TrainMargin:
    """Fit the failure margin to the labels on a trained, frozen world model.

    latentsafe train-margin --policy.path=outputs/world_model/checkpoints/last/pretrained_model \\
      --dataset.repo_id=me/bag_cache --dataset.root=data/bag_tokens --output_dir=outputs/margin

    Do it after training a world model with --policy.margin.weight=0, and whenever labels change or another failure is
    meant: the world model stays. Run train-reachability afterwards. If it was killed, start it again.
    """

    policy: PolicySource
    output_dir: Path
    """The folder to write."""
    dataset: DatasetSource = field(default_factory=DatasetSource)
    seed: int = 0
    """Of the margin's first weights, and of the windows that it is fitted to."""

    def __post_init__(self) -> None:
        require_at_least("--seed", self.seed, 0)

    def run(self) -> None:
        """Fit and save."""
        self.dataset.require_whole("train-margin", CACHE_THEM)
        train_margin(self.policy.path, self.dataset.metadata(), self.output_dir, self.seed)
        print(f"world model with a new margin in {self.output_dir}")


@dataclass
class TrainReachability:
    """Learn the safety value V and the fallback policy in the imagination of a trained, frozen world model.

    latentsafe train-reachability --policy.path=outputs/margin --dataset.repo_id=me/bag_cache \\
      --dataset.root=data/bag_tokens --output_dir=outputs/filter

    With several --seeds each gets its own critic, in <output_dir>/seed_<n>. `torchrun --nproc_per_node=N
    $(which latentsafe) train-reachability ...` shares imagined states and batches among processes; what is learned is
    the same.
    """

    policy: PolicySource
    output_dir: Path
    """The folder to write."""
    dataset: DatasetSource = field(default_factory=DatasetSource)
    seeds: list[int] = field(default_factory=lambda: [0])
    """One critic is trained for each."""
    steps: int | None = None
    """Gradient steps; by default the configuration's."""
    target: str = "reachability"
    """What the critic learns: the safety value (reachability), or SQRL's risk of failing, a baseline."""
    alike: dict[str, float] = field(default_factory=dict)
    """Number of the recording -> how far apart alike frames may be in it, such as {x.pos: 0.1, y.pos: 0.1}: the critic
    then takes constraints that are added later, without training; see latentsafe add-constraint."""

    def __post_init__(self) -> None:
        require_at_least("--steps", self.steps, 1)
        LikenessConfig(self.alike)
        if not self.seeds or len({*self.seeds}) < len(self.seeds) or min(self.seeds) < 0:
            raise ValueError(f"--seeds is {self.seeds}; expected numbers from 0 on, each once, such as [0,1,2]")

    def run(self) -> None:
        """Train and save, seed by seed."""
        self.dataset.require_whole("train-reachability", CACHE_THEM)
        with distributed.joined():
            for seed in self.seeds:
                output_dir = self.output_dir if len(self.seeds) == 1 else self.output_dir / f"seed_{seed}"
                meta = self.dataset.metadata()
                train_reachability(self.policy.path, meta, output_dir, seed, self.steps, self.target, self.alike)
                if distributed.rank() == 0:
                    print(f"filter with a trained critic in {output_dir}")


@dataclass
class AddConstraint:
    """Let a filter heed one more failure, which a few marked frames show: it needs no training.

    latentsafe add-constraint --policy.path=outputs/filter --dataset.root=data/bag --specification=left_of_line \\
      --output_dir=outputs/filter_with_line

    Mark one to five frames that fail on the page of latentsafe label (key M), under a specification of that name. Or
    label a few episodes there as usual: they also tell how far the failure reaches. The filter must take constraints
    (train-reachability --alike=...). What it heeded before, it heeds still; --policy.constraints=[left_of_line,...]
    says which count wherever it is used.
    """

    policy: PolicySource
    output_dir: Path
    """The folder to write."""
    specification: str
    """The name of the labels, and of the constraint."""
    dataset: DatasetSource = field(default_factory=DatasetSource)
    of: list[str] | None = None
    """The numbers that count, such as [x.pos] for a line; by default all that say what is alike."""

    def run(self) -> None:
        """Make it of the marked frames, save the filter with it, and say where it is."""
        refuse_existing(self.output_dir)
        policy = load_filter(self.policy.path)
        found = add_constraint(policy, self.dataset.frames(), self.specification, self.of)
        save_policy(policy, self.output_dir)
        for prototype in found:
            places = (f"{name} {where:g} \u00b1 {reach:g}" for name, (where, reach) in prototype.items())
            print(f"{self.specification}: {', '.join(places)}")
        print(f"wrote {self.output_dir}: --policy.constraints=[{','.join(policy.config.constraints)}]")


@dataclass
class Calibrate:
    """Choose the smallest epsilon that provably misses few failures, on held-out episodes, and store the evidence.

    latentsafe calibrate --policy.path=outputs/filter --base_policy_path=me/my_policy --dataset.repo_id=me/held_cache \\
      --dataset.root=data/held_tokens --alpha=0.05 --output_dir=outputs/calibrated

    Give episodes of the policy that is to be shielded, which the filter was not trained on. A failing episode is
    missed where V, as the filter would decide by it, stays above epsilon until --lead_steps before the failure. At most
    a share --alpha of failing episodes is missed, on average over calibrations; what holds with 95% confidence is said
    beside it. That takes 9, 19, 49 or 99 failing episodes for 10, 5, 2 or 1%. The filter with its epsilon is written
    to --output_dir.

    With --closed_loop the shielded policy is run in --env.type, too, at each of --epsilons, and epsilon is the least
    cautious of those by which it provably fails in at most --alpha of the episodes.
    """

    policy: PolicySource
    output_dir: Path
    """The folder to write."""
    dataset: DatasetSource = field(default_factory=DatasetSource)
    n_episodes: int = 200
    """Episodes used at most, the last ones of the dataset, if --dataset.episodes names none."""
    base_policy_path: str | None = None
    """The policy that was recorded and is to be shielded: a folder, a Hub id, or the name of a committed checkpoint."""
    alpha: float = 0.05
    """Share of failing episodes that may be missed."""
    lead_steps: int = 3
    """Frames of warning asked for before the failure."""
    max_false_alarms: float | None = None
    """Refuse an epsilon by which more than this share of safe episodes may be overridden; by default any share."""
    by: str | None = None
    """Keep --alpha in each group: a column of the dataset, such as policy, or a JSON file, {group: [episodes]}."""
    weights: Path | None = None
    """Likelihood ratio of each episode for a use that differs from the recording: JSON, episode: weight, or .npy."""
    closed_loop: bool = False
    """Run the shielded policy at each of --epsilons, and choose by what then fails."""
    env: EnvConfig | None = None
    """Where it is run."""
    epsilons: list[float] = field(default_factory=lambda: [0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.0])
    """Tried in this order, the most cautious first, as long as they prove safe."""
    n_runs: int = 100
    """Episodes run at each epsilon."""
    seed: int = 0
    """Of the first of them."""
    json: Path | None = None
    """Where to write the scores of all episodes, and misses and false alarms at every epsilon."""
    figure: Path | None = None
    """Where to draw misses and false alarms at every epsilon, .png."""

    def __post_init__(self) -> None:
        require_at_least("--n_episodes", self.n_episodes, 1)
        require_at_least("--n_runs", self.n_runs, 1)
        require_at_least("--seed", self.seed, 0)
        check_options(self.alpha, self.lead_steps, self.max_false_alarms)
        if self.by and self.weights:
            raise ValueError(f"--by={self.by} and --weights={self.weights}: a group has no weights; give one of them")
        if self.closed_loop:
            self._check_closed_loop()

    def _check_closed_loop(self) -> None:
        if self.env is None:
            raise ValueError("--closed_loop runs the shielded policy, but where? Give --env.type")
        if not self.epsilons or any(not later < sooner for sooner, later in pairwise(self.epsilons)):
            raise ValueError(f"--epsilons is {self.epsilons}; expected falling numbers, such as [0.6,0.4,0.2]")
        if self.n_runs < needed_for_sure(self.alpha):
            raise ValueError(
                f"--n_runs is {self.n_runs}; --alpha={self.alpha:g} takes {needed_for_sure(self.alpha)} runs of which "
                "none fails"
            )

    def run(self) -> None:
        """Judge, choose, save, and say what it was chosen on."""
        with replacing_folder(self.output_dir) as folder:
            policy, reader = load_with_cache(self.policy.path, self.dataset.metadata())
            if self.base_policy_path:
                policy.attach(self.base_policy_path)
            found, epsilon = self._choose(policy, reader)
            policy.take_calibration(found, epsilon)
            policy.config.change(frame_cache=None)
            save_policy(policy, folder)
        print(f"epsilon {epsilon:g}", in_words(found), f"wrote {self.output_dir}", sep="\n")

    def _choose(self, policy: LatentSafePolicy, reader: ClipReader) -> tuple[Calibration, float]:
        """What the episodes say, and the epsilon that follows."""
        episodes = self.dataset.of(reader.labels.episode, self.n_episodes)
        marks = episode_marks(reader.labels.episode, reader.state, reader.action)
        known = refuse_trained_on(policy.config.trained_on, marks, episodes)
        groups = groups_of(self.dataset.metadata(), self.by, episodes) if self.by else None
        weights = weights_of(self.weights, episodes) if self.weights else None
        scores = Scores.of(decision_values(policy.model, reader, episodes), self.lead_steps)
        scores.require_both(self.lead_steps)
        self._write(scores)
        trained_on, law = policy.config.trained_on, policy.config.law
        floor = -1.0 if law.name == "risk" else 0.0
        found = calibrate(
            scores, self.alpha, self.lead_steps, trained_on.fps, floor=floor, groups=groups, weights=weights
        )
        if self.max_false_alarms is not None:
            require_few_alarms(found, scores, self.max_false_alarms)
        found, epsilon = replace(found, trained_on_known=known), found.epsilon
        if self.closed_loop:
            runs = failures_by_epsilon(policy, self.env, self.epsilons, self.n_runs, self.seed)
            found = replace(found, closed_loop=fixed_sequence(runs, self.alpha))
            epsilon = proven(found.closed_loop)
        self._write(scores, found)
        return found, epsilon

    def _write(self, scores: Scores, found: Calibration | None = None) -> None:
        """Scores and curve, and once it is chosen the choice: before anything is refused, so that one sees why."""
        if self.json:
            chosen = found.as_json() if found else None
            rows = {"failing": scores.failing, "safe": scores.safe}
            made = provenance(seeds=[self.seed])
            write_json(self.json, {"calibration": chosen, **rows, "curve": curve(scores), **made})
        if self.figure:
            save(misses_and_alarms(curve(scores), self.alpha, found.epsilon if found else None), self.figure)
