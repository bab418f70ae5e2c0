"""The verbs of the console command. Each is a dataclass of options with a `run`."""

import dataclasses
import getpass
import logging
import os
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

from lerobot.envs.configs import EnvConfig

logger = logging.getLogger(__name__)


@dataclass
class DatasetSource:
    """A LeRobotDataset: its id, and its folder if it is not in LeRobot's home."""

    repo_id: str = "local/dataset"
    root: str | None = None

    def metadata(self):
        from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

        return LeRobotDatasetMetadata(self.repo_id, root=self.root)

    def downloaded(self):
        """Metadata of a dataset whose files are on this machine: one without a folder is fetched from the Hub."""
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        if self.root:
            return self.metadata()
        try:
            return LeRobotDataset(self.repo_id).meta
        except OSError as e:
            raise OSError(f"{e} If {self.repo_id} is on this machine, give its folder: --dataset.root=...") from e


@dataclass
class OptionalDatasetSource(DatasetSource):
    """A LeRobotDataset, or none."""

    repo_id: str | None = None


@dataclass
class PolicySource:
    """A checkpoint: a folder, a Hub id, or the name of a committed one (see `latentsafe path`)."""

    path: str = "dubins"


@dataclass
class OptionalPolicySource:
    """A checkpoint, or none."""

    path: str | None = None


@dataclass
class Collect:
    """Record labelled episodes of a simulated task.

    Sources of the Dubins car: random (the paper's 2,000 trajectories of three actions), random_continuous,
    random_left_only (the ablation), careful and reckless (goal-reaching demonstrations for diffusion policies).
    Sources of the Franka: bag_mix (the paper's 1,300 trajectories), bag_branches (several from each grasped state),
    bag_climbs (up in steps and pauses, as under a filter), bag_lifts (one and the same lift by either end),
    bag_between (branches and climbs, grasped between ends and middle), bag_dither and bag_clumsy (grasped badly and
    lifted by unsteady fingers, as by a policy that errs), bag_policies (the committed diffusion policies act and
    are interrupted now and then), bag_shielded (they are, by a slow way down, where the committed filter would override
    them), bag_retreats (whole lifts by either end and the middle, lowered slowly or stopped now and then), bag_pulls
    (the same undisturbed), bag_middle, bag_strong and bag_weak (demonstrations whose hand is pushed aside while
    the operator is recorded), blocks_demos, blocks_random.
    A killed recording of the Franka goes on if started again.
    """

    source: str
    repo_id: str
    root: Path
    n_episodes: int | None = None
    """None: 2,000 of the car, and as many of the Franka as the source says."""
    seed: int = 0
    """At one seed all sources start from the same scenes: where variety counts, give each its own."""
    workers: int = 1
    """Processes that record the Franka."""

    def run(self) -> None:
        from functools import partial

        from lerobot_latentsafe.collection import dubins, franka

        if self.source in franka.SOURCES:
            record = partial(franka.collect_franka, workers=self.workers)
        elif self.source in dubins.SOURCES:
            record = dubins.collect_dubins
        else:
            known = ", ".join([*dubins.SOURCES, *franka.SOURCES])
            raise ValueError(f"--source is {self.source!r}; expected one of {known}")
        dataset = record(self.source, self.repo_id, self.root, self.n_episodes, self.seed)
        print(f"{dataset.num_episodes} episodes, {dataset.num_frames} frames in {self.root}")


@dataclass
class Cache:
    """Copy a dataset without its images and store what a world model sees of its frames beside it.

    That is each frame, decoded and resized, for an RSSM; with --encoder, the tokens of a frozen encoder and their
    principal components, for a token world model (gru). A killed build goes on if it is started again;
    `torchrun --nproc_per_node=N $(which latentsafe) cache ...` shares the work among processes.
    """

    output_dir: Path
    dataset: DatasetSource = field(default_factory=DatasetSource)
    image_size: int | None = None
    """Pixels; None takes 32, or 96 with an encoder."""
    encoder: str | None = None
    """auto, dinov2, dinov2_registers, dinov3, efficientnet_lite0, a folder or a Hub id."""
    dtype: str = "float16"
    """How tokens are stored: float16, or int8 with a scale for each token."""
    basis_from: Path | None = None
    """Another cache, whose principal components to use: one world model must read all its data by the same."""

    def run(self) -> None:
        from functools import partial

        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        from lerobot_latentsafe.datasets.build_cache import Pictures, Tokens, build_frame_cache
        from lerobot_latentsafe.encoders.perception import PerceptionConfig

        dataset = LeRobotDataset(self.dataset.repo_id, root=self.dataset.root)
        recipe, size = Pictures, self.image_size or 32
        if self.encoder:
            size = self.image_size or 96
            config = PerceptionConfig(encoder=self.encoder)
            recipe = partial(Tokens, config=config, dtype=self.dtype, basis_from=self.basis_from)
        cache = build_frame_cache(dataset, self.output_dir, size, recipe)
        if cache is None:
            return  # another process finishes
        print(f"{cache.manifest['n_frames']} frames at {size} px in {self.output_dir}")
        print(f"train with --dataset.repo_id={self.dataset.repo_id}_cache --dataset.root={self.output_dir}")


@dataclass
class EvalWorldModel:
    """Ask a trained world model whether it obeys the action, looks, and knows failure in imagination.

    On held-out episodes, cached by `latentsafe cache`: prediction errors against shuffled actions and against copying
    the last frame; the margin on seen and imagined frames; whether the model, shown the first frame of an episode,
    foresees how it ends; and whether it foresees the next second from all along the way, with the filter's `memory`.
    On episodes that branch from one state (bag_branches) that takes obeying the action; on episodes that share one
    motion (bag_lifts) it takes looking. Read it beside a control that is blind.
    """

    policy: PolicySource
    dataset: DatasetSource = field(default_factory=DatasetSource)
    n_episodes: int = 200
    """Episodes used at most, the last ones of the dataset."""
    horizon: int = 30
    """Steps of an episode that are imagined; what fails later counts as safe."""
    seed: int = 0
    json: Path | None = None

    def run(self) -> None:
        import numpy as np

        from lerobot_latentsafe.evaluation.statistics import provenance, write_json
        from lerobot_latentsafe.evaluation.world_model import evaluate_world_model
        from lerobot_latentsafe.training import load_with_cache

        if self.horizon < 1:
            raise ValueError(f"--horizon is {self.horizon}; expected at least 1 step")
        policy, reader = load_with_cache(self.policy.path, self.dataset.metadata(), self.seed)
        episodes = np.unique(reader.labels.episode)[-self.n_episodes :]
        row = evaluate_world_model(policy, reader, episodes, self.seed, horizon=self.horizon)
        if row["episodes"]["failing"] == 0:
            print(f"no episode fails within --horizon={self.horizon} steps: nothing says whether failures are foreseen")
        for part, numbers in row.items():
            for name, number in numbers.items():
                print(f"{part:9s} {name:18s} {_short(number)}")
        if self.json:
            write_json(self.json, {**row, **provenance(seeds=[self.seed])})


def _short(number: float | dict) -> str:
    if not isinstance(number, dict):
        return f"{number:.3f}" if isinstance(number, float) else str(number)
    if "k" in number:
        return f"{number['k']} of {number['n']}"
    return "  ".join(f"{name} {value:.3f}" for name, value in number.items())


@dataclass
class TrainMargin:
    """Fit the failure margin to the labels on a trained, frozen world model.

    For world models trained with --policy.margin_weight=0, and whenever labels change or another failure is meant: the
    world model stays. Run train-reachability afterwards.
    """

    policy: PolicySource
    output_dir: Path
    dataset: DatasetSource = field(default_factory=DatasetSource)
    seed: int = 0

    def run(self) -> None:
        from lerobot_latentsafe.training import train_margin

        train_margin(self.policy.path, self.dataset.metadata(), self.output_dir, self.seed)
        print(f"world model with a new margin in {self.output_dir}")


@dataclass
class TrainReachability:
    """Learn V and the fallback policy in the imagination of a trained, frozen world model.

    With several --seeds each gets its own critic, in <output_dir>/seed_<n>. `torchrun --nproc_per_node=N
    $(which latentsafe) train-reachability ...` shares imagined states and batches among processes; what is learned is
    the same.
    """

    policy: PolicySource
    output_dir: Path
    dataset: DatasetSource = field(default_factory=DatasetSource)
    seeds: list[int] = field(default_factory=lambda: [0])
    steps: int | None = None
    """Gradient steps; None takes the configuration's."""
    target: str = "reachability"
    """What the critic learns: the safety value (reachability), or SQRL's risk of failing, a baseline."""

    def run(self) -> None:
        from lerobot_latentsafe.runtime import distributed
        from lerobot_latentsafe.training import train_reachability

        with distributed.joined():
            for seed in self.seeds:
                output_dir = self.output_dir if len(self.seeds) == 1 else self.output_dir / f"seed_{seed}"
                meta = self.dataset.metadata()
                train_reachability(self.policy.path, meta, output_dir, seed, self.steps, self.target)
                if distributed.rank() == 0:
                    print(f"filter with a trained critic in {output_dir}")


@dataclass
class Calibrate:
    """Choose the smallest epsilon that warns in time on held-out failing episodes, and store the evidence.

    Give episodes the filter was not trained on; the filter with its new epsilon is written to --output_dir.
    """

    policy: PolicySource
    output_dir: Path
    dataset: DatasetSource = field(default_factory=DatasetSource)
    n_episodes: int = 200
    """Episodes used at most, the last ones of the dataset."""
    max_missed: float = 0.05
    """Share of failing episodes that may be warned about too late."""
    lead_steps: int = 3
    """Frames of warning asked for before the failure."""

    def run(self) -> None:
        import numpy as np

        from lerobot_latentsafe.calibration import calibrate, episode_values, store
        from lerobot_latentsafe.runtime.checkpoint import save_filter
        from lerobot_latentsafe.runtime.files import refuse_existing
        from lerobot_latentsafe.training import load_with_cache

        refuse_existing(self.output_dir)
        policy, reader = load_with_cache(self.policy.path, self.dataset.metadata())
        episodes = np.unique(reader.labels.episode)[-self.n_episodes :]
        found = calibrate(episode_values(policy, reader, episodes), self.max_missed, self.lead_steps)
        store(policy, found)
        policy.config.frame_cache = None
        save_filter(policy, self.output_dir)
        for name, value in dataclasses.asdict(found).items():
            print(f"{name:18s} {value:g}")


@dataclass
class Wrap:
    """Write a filter and the policy it shields as one self-contained folder that every LeRobot command can load."""

    policy: PolicySource
    output_dir: Path
    base_policy_path: str | None = None
    epsilon: float | None = None
    guard: int | None = None
    release: float | None = None
    retreat: dict[str, float] | None = None
    """Command -> robot units a step, as {delta_z.pos: -0.006}: what acts where the critic's action did not help."""
    patience: int | None = None
    dwell: int | None = None
    memory: int | None = None
    """Frames that are remembered at most, such as a clip of the world model's training has."""
    law: str | None = None
    mode: str | None = None
    half: bool = False
    """Store weights in 16 bits."""
    drawing: bool = True
    """Keep what draws an RSSM's imagination for reports, two fifths of its weights."""

    def run(self) -> None:
        from lerobot_latentsafe.configuration_latentsafe import DECIDES
        from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
        from lerobot_latentsafe.runtime.checkpoint import save_filter
        from lerobot_latentsafe.runtime.files import refuse_existing

        refuse_existing(self.output_dir)
        policy = LatentSafePolicy.from_pretrained(self.policy.path)
        policy.config.override(self, *DECIDES, "retreat", "patience", "dwell", "memory", "law", "mode")
        if not self.drawing:
            if not policy.world_model.draws:
                raise ValueError(f"--drawing=false, but the {policy.config.world_model.type} world model draws nothing")
            policy.world_model.stop_drawing()
        if self.base_policy_path:
            policy.attach(self.base_policy_path)
        save_filter(policy, self.output_dir, half=self.half)
        print(f"wrote {self.output_dir}")


@dataclass
class Push:
    """Push a filter, a shielded policy or a task policy of train-dreamer to the Hub with its card."""

    policy: PolicySource
    repo_id: str
    dataset_repo_id: str = "unknown"
    """The dataset named in the card."""
    base_policy_path: str | None = None
    results: list[Path] = field(default_factory=list)
    """Files of eval-shield or of the experiments in scripts/, whose rates the card is to report."""
    private: bool = False

    def run(self) -> None:
        from lerobot.configs.policies import PreTrainedConfig

        from lerobot_latentsafe.model_card import measured
        from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
        from lerobot_latentsafe.policies.dreamer.modeling_dreamer import LatentSafeDreamerPolicy
        from lerobot_latentsafe.runtime.checkpoint import resolve_checkpoint
        from lerobot_latentsafe.runtime.hub import push_filter

        kind = PreTrainedConfig.from_pretrained(resolve_checkpoint(self.policy.path)).type
        policy_class = LatentSafeDreamerPolicy if kind == LatentSafeDreamerPolicy.name else LatentSafePolicy
        policy = policy_class.from_pretrained(self.policy.path)
        if self.base_policy_path:
            policy.attach(self.base_policy_path)
        for file in self.results:
            policy.config.evaluation |= measured(file, policy.config.law)
        print(f"pushed to {push_filter(policy, self.repo_id, self.dataset_repo_id, self.private)}")


@dataclass
class EvalMonitor:
    """Compare a filter's verdict V > 0 with the exact safe set, and drive its fallback policy from feasible starts.

    Truths: discrete (the car's exact discrete-time value with three actions) or continuous (the paper's:
    hj_reachability on its grid). Without --states the paper's grid of 51 x 51 x 53 states is scored.
    """

    env: EnvConfig
    policy: PolicySource = field(default_factory=PolicySource)
    truth: str = "discrete"
    states: Path | None = None
    """.npy file (N, 3): x, y, heading."""
    values_out: Path | None = None
    """Where to write V of these states, .npy (N,)."""
    json: Path | None = None
    figure: Path | None = None
    """Where to draw value slices over the exact boundary, .png."""

    def run(self) -> None:
        import numpy as np

        from lerobot_latentsafe.dubins.ground_truth import load_states, truth_on
        from lerobot_latentsafe.evaluation.statistics import check_environment, provenance, write_json
        from lerobot_latentsafe.experiments.dubins.monitor import LatentMonitor, evaluate_monitor
        from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

        if self.env.type != "latentsafe_dubins":
            raise ValueError(f"--env.type is {self.env.type!r}; an exact safe set is known for latentsafe_dubins only")
        states, true_value = truth_on(load_states(self.states) if self.states else None, self.truth)
        policy = LatentSafePolicy.from_pretrained(self.policy.path)
        check_environment(policy, self.env)
        monitor = LatentMonitor(policy)
        row, value = evaluate_monitor(monitor, states, true_value)
        row = {"truth": self.truth, **row, **provenance(seeds=[])}
        for name, entry in row.items():
            print(f"{name:20s} {entry:.4f}" if isinstance(entry, float) else f"{name:20s} {entry}")
        if self.values_out:
            self.values_out.parent.mkdir(parents=True, exist_ok=True)
            np.save(self.values_out, value)
        if self.json:
            write_json(self.json, row)
        if self.figure:
            from lerobot_latentsafe.experiments.dubins.figures import value_slices
            from lerobot_latentsafe.reports.figures import save

            save(value_slices({"latent": monitor}), self.figure)


@dataclass
class EvalShield:
    """Run a policy bare and shielded from the same starts, and say what the filter changed."""

    env: EnvConfig
    policy: PolicySource = field(default_factory=PolicySource)
    base_policy_path: str | None = None
    n_episodes: int = 200
    seed: int = 0
    epsilon: float | None = None
    guard: int | None = None
    release: float | None = None
    law: str | None = None
    """These override the filter's."""
    json: Path | None = None
    video: Path | None = None
    """Folder for videos of the first episodes, bare and shielded side by side."""
    n_videos: int = 5
    figure: Path | None = None
    """Where to draw the trajectories, .png."""

    def run(self) -> None:
        from lerobot_latentsafe.configuration_latentsafe import DECIDES
        from lerobot_latentsafe.evaluation.statistics import compare, provenance, write_json
        from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

        if self.n_episodes < 1:
            raise ValueError(f"--n_episodes is {self.n_episodes}; expected at least 1")
        policy = LatentSafePolicy.from_pretrained(self.policy.path)
        policy.config.override(self, *DECIDES, "law")
        if self.base_policy_path:
            policy.attach(self.base_policy_path)
        result = compare(policy, self.env, self.n_episodes, self.seed, self.n_videos if self.video else 0)
        episodes = result.pop("episodes")
        row = {
            **result,
            "epsilon": policy.config.epsilon,
            "guard": policy.config.guard,
            "release": policy.config.release,
            "law": policy.config.law,
            **provenance(seeds=[self.seed]),
        }
        for name in ("bare", "shielded"):
            rates = row[name]
            print(
                name.ljust(9),
                *(f"{k} {v['k']}/{v['n']}" for k, v in rates.items() if isinstance(v, dict)),
                sep="  ",
            )
        share, p_value = row["shielded"]["overridden_share"], row["violation_p_value"]
        print(f"overridden {share:.1%} of steps, difference in violations p = {p_value:.2g}")
        if self.json:
            write_json(self.json, row)
        if self.figure:
            from lerobot_latentsafe.experiments.dubins.figures import trajectories
            from lerobot_latentsafe.reports.figures import save

            save(trajectories(episodes), self.figure)
        if self.video:
            from lerobot_latentsafe.reports.figures import write_videos

            for path in write_videos(episodes, self.video, self.env.fps):
                print(path)


@dataclass
class Label:
    """Open a local page on which a person marks where episodes fail; every key is saved beside the dataset.

    With --policy.path, a trained filter draws its margin, guesses, and puts the most useful episodes first.
    """

    dataset: DatasetSource = field(default_factory=DatasetSource)
    policy: OptionalPolicySource = field(default_factory=OptionalPolicySource)
    specifications: list[str] = field(default_factory=lambda: ["failure"])
    """What can fail: each name gets labels of its own; those that have a label file are offered anyway."""
    user: str = field(default_factory=getpass.getuser)
    """Who labels; kept with each label."""
    host: str = "127.0.0.1"
    port: int = 8765
    """0 takes a free one."""

    def run(self) -> None:
        if not (find_spec("starlette") and find_spec("uvicorn")):
            raise ImportError("the page needs starlette and uvicorn: pip install 'lerobot_policy_latentsafe[label]'")
        from lerobot_latentsafe.datasets.episodes import DatasetFrames
        from lerobot_latentsafe.labeling.app import LabelServer, listen, serve
        from lerobot_latentsafe.labeling.store import LabelStore
        from lerobot_latentsafe.labeling.suggestions import Suggester

        frames = DatasetFrames(self.dataset.downloaded())
        store = LabelStore(frames.root, frames.meta.repo_id, self.specifications)
        server = LabelServer(store, frames, self.user)
        listener = listen(self.host, self.port)
        if self.policy.path:
            server.suggester = Suggester(self.policy.path, frames.meta.repo_id, frames.root, server.suggestion_arrived)
        serve(server, listener)


@dataclass
class CheckLabels:
    """List the labelled episodes that a trained filter disagrees with, the worst first, on one HTML page."""

    policy: PolicySource = field(default_factory=PolicySource)
    dataset: DatasetSource = field(default_factory=DatasetSource)
    specification: str = "failure"
    output: Path = Path("outputs/disagreements.html")

    def run(self) -> None:
        from lerobot_latentsafe.datasets.episodes import DatasetFrames
        from lerobot_latentsafe.evaluation.along_episodes import episode_margins
        from lerobot_latentsafe.labeling.disagreements import find_disagreements, in_words, write_disagreements
        from lerobot_latentsafe.labeling.store import LabelStore
        from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

        frames = DatasetFrames(self.dataset.downloaded())
        store = LabelStore(frames.root, frames.meta.repo_id, [self.specification])
        margins = dict(episode_margins(LatentSafePolicy.from_pretrained(self.policy.path), frames))
        found = find_disagreements(store, self.specification, margins)
        for d in found[:20]:
            label = in_words(store.verdict(self.specification, d.episode).first, len(d.margin))
            print(f"episode {d.episode:5d}  {d.degree:.2f}  labelled: {label}")
        write_disagreements(self.output, found, store, frames, self.specification)
        print(f"{len(found)} disagreements; open {self.output}")


@dataclass
class AutoLabel:
    """Let a function label the episodes that have no label yet; labels people gave stay.

    Labellers: dubins_truth (the car's recorded position), module:function (your own, see labeling/automatic.py), and
    vision_language, which asks the model at --url about --failure and takes well-formed answers only. A service's key
    is read from the environment variable LATENTSAFE_MODEL_KEY.
    """

    labeller: str
    dataset: DatasetSource = field(default_factory=DatasetSource)
    specification: str = "failure"
    failure: str | None = None
    """What counts as a failure, in words, for vision_language."""
    url: str = "http://127.0.0.1:8000/v1"
    model: str = "default"

    def run(self) -> None:
        from lerobot_latentsafe.datasets.episodes import DatasetFrames
        from lerobot_latentsafe.labeling import automatic
        from lerobot_latentsafe.labeling.store import LabelStore

        if self.labeller != "vision_language":
            labeller = automatic.find_labeller(self.labeller)
        elif self.failure:
            endpoint = automatic.ChatEndpoint(self.url, self.model, os.environ.get("LATENTSAFE_MODEL_KEY"))
            labeller = automatic.VisionLanguageLabeller(endpoint, self.failure)
        else:
            raise ValueError("vision_language needs --failure: what counts as one, such as 'a candy left the bag'")
        frames = DatasetFrames(self.dataset.downloaded())
        store = LabelStore(frames.root, frames.meta.repo_id, [self.specification])
        result = automatic.label_automatically(store, frames, self.specification, labeller, self.labeller)
        for name, episodes in result.items():
            print(f"{name:10s} {len(episodes)} episodes")
        for episode, why in result["refused"][:10]:
            print(f"episode {episode}: {why}")


@dataclass
class MergeDecisions:
    """Copy a recording of `latentsafe record` with what the shield decided as columns `shield.*`, for LeRobot alone."""

    output_dir: Path
    new_repo_id: str
    dataset: DatasetSource = field(default_factory=DatasetSource)

    def run(self) -> None:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        from lerobot_latentsafe.datasets.columns import write_decisions

        dataset = LeRobotDataset(self.dataset.repo_id, root=self.dataset.root)
        written = write_decisions(dataset, self.output_dir, self.new_repo_id)
        print(f"{written.num_frames} frames with the shield's decisions in {self.output_dir}")


@dataclass
class WriteLabels:
    """Copy a dataset with its label files as columns, which LeRobot alone can read, and push it on request."""

    output_dir: Path
    new_repo_id: str
    dataset: DatasetSource = field(default_factory=DatasetSource)
    specifications: list[str] = field(default_factory=lambda: ["failure"])
    push_to_hub: bool = False
    private: bool = False

    def run(self) -> None:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        from lerobot_latentsafe.datasets.columns import push_dataset, write_columns

        dataset = LeRobotDataset(self.dataset.repo_id, root=self.dataset.root)
        written = write_columns(dataset, self.specifications, self.output_dir, self.new_repo_id)
        print(f"{written.num_frames} frames with the columns {', '.join(self.specifications)} in {self.output_dir}")
        if self.push_to_hub:
            push_dataset(written, self.private)
            print(f"pushed to {self.new_repo_id}")


@dataclass
class Report:
    """Write one HTML file about a filter: opens from disk, prints.

    With --env.type and a base policy, about what it changes: the policy is run bare and shielded from the same starts.
    With --dataset.repo_id, about what `latentsafe record` stored under it. What the filter imagined when it acted is
    shown, too; for a world model that cannot draw (gru, dino_wm), as the most similar frames of these episodes and of
    the dataset, which may be any of the same robot.
    """

    policy: PolicySource = field(default_factory=PolicySource)
    env: EnvConfig | None = None
    base_policy_path: str | None = None
    dataset: OptionalDatasetSource = field(default_factory=OptionalDatasetSource)
    output: Path = Path("outputs/report.html")
    n_episodes: int = 50
    seed: int = 0
    epsilon: float | None = None
    guard: int | None = None
    release: float | None = None
    law: str | None = None
    """These override the filter's."""

    def run(self) -> None:
        from lerobot_latentsafe.configuration_latentsafe import DECIDES
        from lerobot_latentsafe.datasets.episodes import DatasetFrames
        from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
        from lerobot_latentsafe.reports.filter_report import write_filter_report

        if self.n_episodes < 1:
            raise ValueError(f"--n_episodes is {self.n_episodes}; expected at least 1")
        if self.base_policy_path and self.env is None:
            raise ValueError("--base_policy_path runs a policy, but where? Give --env.type")
        policy = LatentSafePolicy.from_pretrained(self.policy.path).eval()
        policy.config.override(self, *DECIDES, "law")
        if self.base_policy_path:
            policy.attach(self.base_policy_path)
        recorded = DatasetFrames(self.dataset.downloaded()) if self.dataset.repo_id else None
        write_filter_report(self.output, policy, self.env, self.n_episodes, self.seed, recorded)
        print(f"open {self.output}")


@dataclass
class PictureFeatures:
    """Draw each variant of the bag beside the first three principal components of its patch features, as colours.

    A camera has one basis for all variants: what has one colour in all of them looks the same to the encoder, whatever
    the bag is made of.
    """

    encoder: str = "auto"
    """auto, dinov2, dinov2_registers, dinov3, efficientnet_lite0, a folder or a Hub id."""
    image_size: int = 224
    """Pixels; a multiple of the encoder's patch."""
    behavior: str = "closed_end"
    step: int = 36
    """Control step of the behaviour that is drawn."""
    seed: int = 5
    output: Path = Path("outputs/features.png")

    def run(self) -> None:
        from lerobot_latentsafe.encoders.patch_encoders import load_encoder
        from lerobot_latentsafe.experiments.bag.features import draw_features, see_variants
        from lerobot_latentsafe.reports.figures import save

        encoder = load_encoder(self.encoder)
        seen = see_variants(self.image_size, self.behavior, self.step, self.seed)
        save(draw_features(encoder, seen), self.output)
        print(f"{encoder.name} on {len(seen)} variants in {self.output}")


@dataclass
class PathOf:
    """Print the folder of a committed checkpoint."""

    name: str = "dubins"

    def run(self) -> None:
        from lerobot_latentsafe.runtime.checkpoint import resolve_checkpoint

        print(resolve_checkpoint(self.name))
