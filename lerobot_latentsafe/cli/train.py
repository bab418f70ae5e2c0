"""Verbs that make a filter: cached frames, the margin, the critic, the threshold."""

from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from lerobot_latentsafe.calibration import calibrate, check_options, episode_values, store
from lerobot_latentsafe.cli.options import CACHE_THEM, DatasetSource, PolicySource
from lerobot_latentsafe.datasets.build_cache import TOKEN_COMPONENTS, TOKEN_TYPES, Pictures, Tokens, build_frame_cache
from lerobot_latentsafe.datasets.frame_cache import FrameCache
from lerobot_latentsafe.encoders.perception import PerceptionConfig
from lerobot_latentsafe.runtime import distributed
from lerobot_latentsafe.runtime.files import replacing_folder
from lerobot_latentsafe.runtime.hub import save_policy
from lerobot_latentsafe.runtime.options import require_at_least
from lerobot_latentsafe.training import load_with_cache, train_margin, train_reachability


@dataclass
class Cache:
    """Copy a dataset without its images, and store what a world model sees of its frames beside it.

    latentsafe cache --dataset.repo_id=me/bag --dataset.root=data/bag --output_dir=data/bag_tokens --encoder=auto

    For an RSSM that is each frame, decoded and resized. With --encoder it is the tokens of a frozen encoder and their
    principal components, for a token world model (gru, dino_wm). If a build was killed, start it again: it goes on.
    `torchrun --nproc_per_node=N $(which latentsafe) cache ...` shares the work among processes.
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

    def __post_init__(self) -> None:
        require_at_least("--image_size", self.image_size, 1)
        require_at_least("--token_components", self.token_components, 0)
        if self.dtype not in TOKEN_TYPES:
            raise ValueError(f"--dtype is {self.dtype!r}; expected {' or '.join(TOKEN_TYPES)}")

    def run(self) -> None:
        """Build the cache, or go on building it."""
        recipe = Pictures
        if self.encoder:
            config = PerceptionConfig(encoder=self.encoder, token_components=self._token_components())
            recipe = partial(Tokens, config=config, dtype=self.dtype, basis_from=self.basis_from)
        cache = build_frame_cache(
            self.dataset.opened(), self.output_dir, self.image_size, recipe, self.dataset.episodes
        )
        if cache is None:
            return  # another process finishes
        print(f"{cache.manifest['n_frames']} frames at {cache.image_size} px in {self.output_dir}")
        print(f"train with --dataset.repo_id={cache.manifest['repo_id']}_cache --dataset.root={self.output_dir}")

    def _token_components(self) -> int:
        if self.token_components is not None:
            return self.token_components
        if self.basis_from is None:
            return TOKEN_COMPONENTS
        return FrameCache.open(self.basis_from).manifest.get("token_components", 0)


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

    def __post_init__(self) -> None:
        require_at_least("--steps", self.steps, 1)
        if not self.seeds or len({*self.seeds}) < len(self.seeds) or min(self.seeds) < 0:
            raise ValueError(f"--seeds is {self.seeds}; expected numbers from 0 on, each once, such as [0,1,2]")

    def run(self) -> None:
        """Train and save, seed by seed."""
        self.dataset.require_whole("train-reachability", CACHE_THEM)
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

    latentsafe calibrate --policy.path=outputs/filter --dataset.repo_id=me/held_cache \\
      --dataset.root=data/held_tokens --output_dir=outputs/calibrated

    Give episodes that the filter was not trained on. The filter with its new epsilon is written to --output_dir.
    """

    policy: PolicySource
    output_dir: Path
    """The folder to write."""
    dataset: DatasetSource = field(default_factory=DatasetSource)
    n_episodes: int = 200
    """Episodes used at most, the last ones of the dataset, if --dataset.episodes names none."""
    max_missed: float = 0.05
    """Share of failing episodes that may be warned about too late."""
    lead_steps: int = 3
    """Frames of warning asked for before the failure."""

    def __post_init__(self) -> None:
        require_at_least("--n_episodes", self.n_episodes, 1)
        check_options(self.max_missed, self.lead_steps)

    def run(self) -> None:
        """Choose, save, and print what it was chosen on."""
        with replacing_folder(self.output_dir) as folder:
            policy, reader = load_with_cache(self.policy.path, self.dataset.metadata())
            episodes = self.dataset.of(reader.labels.episode, self.n_episodes)
            found = calibrate(episode_values(policy.model, reader, episodes), self.max_missed, self.lead_steps)
            store(policy.config, found)
            policy.config.change(frame_cache=None)
            save_policy(policy, folder)
        for name, value in asdict(found).items():
            print(f"{name:18s} {value:g}")
