"""Verbs that ask what a filter is worth: against the truth, in use, in imagination, on a page."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from lerobot.envs.configs import EnvConfig

from lerobot_latentsafe.cli.options import DatasetSource, OptionalDatasetSource
from lerobot_latentsafe.cli.places import DefaultPolicySource, OptionalPolicySource, PolicySource
from lerobot_latentsafe.decision import LawConfig, LawOptions
from lerobot_latentsafe.dubins.ground_truth import load_states, truth_on
from lerobot_latentsafe.encoders.patch_encoders import load_encoder
from lerobot_latentsafe.evaluation.misses import explain_misses, read_causes
from lerobot_latentsafe.evaluation.rollouts import TOGETHER, check_environment, compare
from lerobot_latentsafe.evaluation.shield_tasks import CutComparison
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.evaluation.world_model import evaluate_world_model
from lerobot_latentsafe.evaluation.yardstick import compare_world_models, summarised
from lerobot_latentsafe.experiments.bag.features import draw_features, see_variants
from lerobot_latentsafe.experiments.dubins.figures import trajectories, value_slices
from lerobot_latentsafe.experiments.dubins.monitor import LatentMonitor, evaluate_monitor
from lerobot_latentsafe.experiments.dubins.report import car_parts
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.reports.figures import causes_of_misses, save, write_videos
from lerobot_latentsafe.reports.filter_report import write_filter_report
from lerobot_latentsafe.runtime.files import replacing
from lerobot_latentsafe.runtime.options import require_at_least
from lerobot_latentsafe.runtime.tasks import Tasks
from lerobot_latentsafe.training import load_with_cache

CAR = "latentsafe_dubins"


@dataclass
class EvalMonitor:
    """Compare a filter's verdict V > 0 with the exact safe set, and drive its fallback policy from feasible starts.

    latentsafe eval-monitor --policy.path=dubins --env.type=latentsafe_dubins --json=outputs/monitor.json

    Truths: discrete (the car's exact discrete-time value with three actions) or continuous (the paper's:
    hj_reachability on its grid). Without --states the paper's grid of 51 x 51 x 53 states is scored.
    """

    env: EnvConfig
    """The environment whose safe set is known."""
    policy: DefaultPolicySource = field(default_factory=DefaultPolicySource)
    truth: str = "discrete"
    """discrete or continuous; see above."""
    states: Path | None = None
    """.npy file (N, 3): x, y, heading."""
    values_out: Path | None = None
    """Where to write V of these states, .npy (N,)."""
    json: Path | None = None
    """Where to write the numbers."""
    figure: Path | None = None
    """Where to draw value slices over the exact boundary, .png."""

    def run(self) -> None:
        """Score, print and write."""
        if self.env.type != CAR:
            raise ValueError(f"--env.type is {self.env.type!r}; an exact safe set is known for {CAR} only")
        states, true_value = truth_on(load_states(self.states) if self.states else None, self.truth)
        policy = load_filter(self.policy.path)
        check_environment(policy, self.env)
        monitor = LatentMonitor(policy.model)
        row, value = evaluate_monitor(monitor, states, true_value)
        row = {"truth": self.truth, **row, **provenance(seeds=[])}
        for name, entry in row.items():
            print(f"{name:20s} {entry:.4f}" if isinstance(entry, float) else f"{name:20s} {entry}")
        if self.values_out:
            with replacing(self.values_out) as partial, partial.open("wb") as file:
                np.save(file, value)
        if self.json:
            write_json(self.json, row)
        if self.figure:
            save(value_slices({"latent": monitor}), self.figure)


@dataclass
class EvalShield:
    """Run a policy bare and shielded from the same starts, and say what the filter changed.

    latentsafe eval-shield --policy.path=bag --base_policy_path=bag_diffusion_weak --env.type=latentsafe_bag \\
      --env.episode_length=150 --n_episodes=20 --json=outputs/shield.json

    Options of --law change the filter's law; what is not given stays as it is. With --tasks.number=N the episodes are
    shared among N tasks, by whole --batch_size; see docs/scaling.md.
    """

    env: EnvConfig
    """Where the policy is run."""
    policy: DefaultPolicySource = field(default_factory=DefaultPolicySource)
    base_policy_path: str | None = None
    """The policy to shield: a folder, a Hub id, or the name of a committed checkpoint."""
    law: LawOptions = field(default_factory=LawOptions)
    n_episodes: int = 200
    """Episodes of each, bare and shielded."""
    seed: int = 0
    """Of the first start; the next ones follow."""
    batch_size: int = TOGETHER
    """Episodes that run side by side; where the policy samples, the numbers depend on it."""
    json: Path | None = None
    """Where to write the numbers."""
    video: Path | None = None
    """Folder for videos of the first episodes, bare and shielded side by side."""
    n_videos: int = 5
    """How many."""
    figure: Path | None = None
    """Where to draw the paths of the car, .png."""
    tasks: Tasks = field(default_factory=Tasks)

    def __post_init__(self) -> None:
        _require_episodes(self.n_episodes, self.seed)
        require_at_least("--n_videos", self.n_videos, 1)
        require_at_least("--batch_size", self.batch_size, 1)
        if self.tasks.number and not self.json:
            raise ValueError("--tasks.number needs --json: what tasks have finished is kept beside that file")

    def run(self) -> None:
        """Compare, print and write."""
        if self.figure and self.env.type != CAR:
            raise ValueError(f"--figure draws paths of {CAR}, --env.type is {self.env.type!r}; give --video instead")
        if self.tasks.number:
            return self._in_tasks()
        policy = self._load()
        n_videos = self.n_videos if self.video else 0
        result = compare(policy, self.env, self.n_episodes, self.seed, n_videos, batch_size=self.batch_size)
        self._tell(result, policy.config.law, provenance(seeds=[self.seed]))

    def _in_tasks(self) -> None:
        self.tasks.require_executor()
        output, n_videos = self.json.absolute(), self.n_videos if self.video else 0
        work = CutComparison(
            output, self._load, self.env, self.n_episodes, self.seed, self.batch_size, n_videos, self._tell,
            provenance(seeds=[self.seed]),
        )  # fmt: skip
        self.tasks.require_work(len(work.numbers), f"times --batch_size={self.batch_size} episodes")
        if work.run(self.tasks) is None:
            print(f"submitted: the last task writes {output}; logs are in {output}.tasks")

    def _load(self) -> LatentSafePolicy:
        return load_filter(self.policy.path, law=self.law, base_policy=self.base_policy_path)

    def _tell(self, result: dict, law: LawConfig, made: dict) -> None:
        episodes = result.pop("episodes")
        row = {
            **result,
            "epsilon": law.epsilon,
            "guard": law.proposal_steps,
            "release": law.resume_above,
            "law": law.name,
            **made,
        }
        print("\n".join(_compared(row)))
        if self.json:
            write_json(self.json, row)
        if self.figure:
            save(trajectories(episodes), self.figure)
        if self.video:
            print(*write_videos(episodes, self.video, self.env.fps), sep="\n")


def _require_episodes(n: int, seed: int) -> None:
    require_at_least("--n_episodes", n, 1)
    require_at_least("--seed", seed, 0)


def _compared(row: dict) -> Iterator[str]:
    """What a filter changed, in three lines."""
    for name in ("bare", "shielded"):
        rates = (f"{k} {v['k']}/{v['n']}" for k, v in row[name].items() if isinstance(v, dict))
        yield "  ".join([name.ljust(9), *rates])
    share, p_value = row["shielded"]["overridden_share"], row["violation_p_value"]
    yield f"overridden {share:.1%} of steps, difference in violations p = {p_value:.2g}"


@dataclass
class EvalWorldModel:
    """Ask a trained world model whether it obeys the action, looks, and knows failure in imagination.

    latentsafe eval-world-model --policy.path=outputs/margin --dataset.repo_id=me/held_cache \\
      --dataset.root=data/held_tokens

    On held-out episodes, cached by `latentsafe cache`: prediction errors against shuffled actions and against copying
    the last frame; the margin on seen and imagined frames; whether the model, shown the first frame of an episode,
    foresees how it ends; and whether it foresees the next second from all along the way, with the filter's
    `law.history_frames`. On episodes that branch from one state (bag_branches) that takes obeying the action; on
    episodes that share one motion (bag_lifts) it takes looking. Read it beside a control that is blind.

    Errors of one model are in a unit of its own. To compare several, of whatever kind, give --policies in place of
    --policy.path: they are scored in one space, an encoder's tokens, beside controls that cannot be good.

    latentsafe eval-world-model --policies='{gru: outputs/gru, dino_wm: outputs/dino_wm}' --branches=5 \
      --dataset.repo_id=me/held_cache --dataset.root=data/held_tokens --json=outputs/world_models.json
    """

    policy: OptionalPolicySource = field(default_factory=OptionalPolicySource)
    policies: dict[str, str] | None = None
    """Several to compare: a name of each, and its folder, Hub id or name of a committed checkpoint."""
    branches: int = 0
    """So many episodes of the dataset that follow each other start from one state, as in bag_branches; 0: no two do."""
    pictures: str | None = None
    """Folder of the same dataset with a cache of pictures, for those of --policies that read pictures (rssm)."""
    dataset: DatasetSource = field(default_factory=DatasetSource)
    n_episodes: int = 200
    """Episodes used at most, the last ones of the dataset, if --dataset.episodes names none."""
    horizon: int = 30
    """Steps of an episode that are imagined; what fails later counts as safe."""
    seed: int = 0
    """Of the windows that are drawn."""
    json: Path | None = None
    """Where to write the numbers."""

    def __post_init__(self) -> None:
        _require_episodes(self.n_episodes, self.seed)
        require_at_least("--horizon", self.horizon, 1)
        require_at_least("--branches", self.branches, 0)
        if (self.policy.path is None) == (not self.policies):
            raise ValueError(
                f"--policy.path is {self.policy.path}, --policies is {self.policies}; give one checkpoint, or several "
                "with names: --policies='{gru: outputs/gru, dino_wm: outputs/dino_wm}'"
            )

    def run(self) -> None:
        """Ask, print and write."""
        if self.policies:
            return self._compare(self.policies)
        policy, reader = load_with_cache(self.policy.path, self.dataset.metadata(), self.seed)
        episodes = self.dataset.of(reader.labels.episode, self.n_episodes)
        row = evaluate_world_model(policy.model, reader, episodes, self.seed, horizon=self.horizon)
        if row["episodes"]["failing"] == 0:
            print(f"no episode fails within --horizon={self.horizon} steps: nothing says whether failures are foreseen")
        for part, numbers in row.items():
            for name, number in numbers.items():
                print(f"{part:9s} {name:18s} {_short(number)}")
        if self.json:
            write_json(self.json, {**row, **provenance(seeds=[self.seed])})

    def _compare(self, policies: dict[str, str]) -> None:
        meta = self.dataset.metadata()
        pictures = DatasetSource(root=self.pictures).metadata() if self.pictures else None
        episodes = self.dataset.of(np.arange(meta.total_episodes), self.n_episodes)
        rows = compare_world_models(
            policies, meta, episodes, self.branches, pictures, horizon=self.horizon, seed=self.seed
        )
        summary = {name: summarised(row) for name, row in rows.items()}
        for name, numbers in summary.items():
            for what, number in numbers.items():
                print(f"{name:22s} {what:14s} {_short(number)}")
        if self.json:
            write_json(self.json, {"summary": summary, "models": rows, **provenance(seeds=[self.seed])})


def _short(number: float | dict | None) -> str:
    if not isinstance(number, dict):
        return f"{number:.3f}" if isinstance(number, float) else "-" if number is None else str(number)
    if "k" in number:
        return f"{number['k']} of {number['n']}"
    return "  ".join(f"{name} {_short(value)}" for name, value in number.items())


@dataclass
class ExplainMisses:
    """Tell which part of a filter is to blame for recorded failures that it did not warn of in time.

    latentsafe explain-misses --policy.path=outputs/calibrated --dataset.repo_id=me/held_cache \\
      --dataset.root=data/held_tokens --json=outputs/misses.json

    The first that holds: doomed (it failed before the lead had passed), fallback (V fell to epsilon, but later than the
    lead), margin (it does not see the failure that is there), world_model (it imagined otherwise than it came), value
    (imagination foresees the failure, and V said that there was a way out). Options of --law change the filter's law.
    """

    policy: PolicySource
    dataset: DatasetSource = field(default_factory=DatasetSource)
    n_episodes: int = 200
    """Episodes used at most, the last ones of the dataset, if --dataset.episodes names none."""
    lead_steps: int = 3
    """Frames of warning asked for before the failure."""
    law: LawOptions = field(default_factory=LawOptions)
    json: Path | None = None
    """Where to write the episodes of each cause; latentsafe report --misses=[...] draws them."""
    figure: Path | None = None
    """Where to draw their shares, .png."""

    def __post_init__(self) -> None:
        require_at_least("--n_episodes", self.n_episodes, 1)
        require_at_least("--lead_steps", self.lead_steps, 1)

    def run(self) -> None:
        """Judge, print and write."""
        policy, reader = load_with_cache(self.policy.path, self.dataset.metadata())
        policy.config.change(law=policy.config.law.changed(self.law))
        episodes = self.dataset.of(reader.labels.episode, self.n_episodes)
        found = explain_misses(policy.model, reader, episodes, self.lead_steps)
        counts = {cause: len(some) for cause, some in found.missed.items()}
        print(f"{len(found.warned)} of {len(found.warned) + sum(counts.values())} failing episodes warned of in time")
        for cause, n in counts.items():
            print(f"{cause:12s} {n}")
        if self.json:
            row = {"warned": found.warned, "missed": found.missed, "shares": found.shares()}
            write_json(self.json, {**row, "epsilon": policy.config.law.epsilon, **provenance(seeds=[])})
        if self.figure:
            save(causes_of_misses({policy.config.law.name: counts}), self.figure)


@dataclass
class Report:
    """Write one HTML file about a filter, which opens from disk and prints.

    latentsafe report --policy.path=outputs/shielded --env.type=latentsafe_bag --env.episode_length=150 \\
      --n_episodes=10 --output=outputs/report.html

    With --env.type and a base policy it says what the filter changes: the policy is run bare and shielded from the
    same starts. With --dataset.repo_id it shows what `latentsafe record` stored under the filter. What the filter
    imagined when it acted is shown, too; for a world model that cannot draw (gru, dino_wm), as the most similar frames
    of these episodes and of the dataset, which may be any of the same robot. Options of --law change the filter's law.
    """

    policy: DefaultPolicySource = field(default_factory=DefaultPolicySource)
    env: EnvConfig | None = None
    """Where the policy is run."""
    base_policy_path: str | None = None
    """The policy to shield: a folder, a Hub id, or the name of a committed checkpoint."""
    dataset: OptionalDatasetSource = field(default_factory=OptionalDatasetSource)
    output: Path = Path("outputs/report.html")
    """The file to write."""
    law: LawOptions = field(default_factory=LawOptions)
    n_episodes: int = 50
    """Episodes of each, bare and shielded."""
    seed: int = 0
    """Of the first start; the next ones follow."""
    misses: list[Path] = field(default_factory=list)
    """Files of explain-misses, each of which gets a bar."""

    def __post_init__(self) -> None:
        _require_episodes(self.n_episodes, self.seed)

    def run(self) -> None:
        """Write it."""
        if self.base_policy_path and self.env is None:
            raise ValueError("--base_policy_path runs a policy, but where? Give --env.type")
        policy = load_filter(self.policy.path, law=self.law, base_policy=self.base_policy_path)
        recorded = self.dataset.frames() if self.dataset.repo_id or self.dataset.root else None
        extra = car_parts if self.env is not None and self.env.type == CAR else None
        misses = {file.stem: read_causes(file) for file in self.misses}
        write_filter_report(self.output, policy, self.env, self.n_episodes, self.seed, recorded, extra, misses)
        print(f"open {self.output}")


@dataclass
class DrawFeatures:
    """Draw each variant of the bag beside the first three principal components of its patch features, as colours.

    latentsafe draw-features --encoder=auto --output=outputs/features.png

    A camera has one basis for all variants: what has one colour in all of them looks the same to the encoder, whatever
    the bag is made of.
    """

    encoder: str = "auto"
    """auto, dinov2, dinov2_registers, dinov3, efficientnet_lite0, a folder or a Hub id."""
    image_size: int = 224
    """Pixels; a multiple of the encoder's patch."""
    behavior: str = "closed_end"
    """What the scripted operator does."""
    step: int = 36
    """Control step of the behaviour that is drawn."""
    seed: int = 5
    """Of the scene."""
    output: Path = Path("outputs/features.png")
    """The picture to write."""

    def __post_init__(self) -> None:
        for name, least in (("image_size", 1), ("step", 0), ("seed", 0)):
            require_at_least(f"--{name}", getattr(self, name), least)

    def run(self) -> None:
        """Draw and save."""
        encoder = load_encoder(self.encoder)
        encoder.n_patches(self.image_size, self.image_size)
        seen = see_variants(self.image_size, self.behavior, self.step, self.seed)
        save(draw_features(encoder, seen), self.output)
        print(f"{encoder.name} on {len(seen)} variants in {self.output}")
