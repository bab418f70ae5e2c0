"""The verbs of the console command. Each is a dataclass of options with a `run`."""

import dataclasses
import logging
from dataclasses import dataclass, field
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


@dataclass
class PolicySource:
    """A checkpoint: a folder, a Hub id, or the name of a committed one (see `latentsafe path`)."""

    path: str = "dubins"


@dataclass
class Collect:
    """Record labelled episodes of the Dubins car.

    Sources: random (the paper's 2,000 trajectories of three actions), random_continuous, random_left_only (the
    ablation), careful and reckless (goal-reaching demonstrations for diffusion policies).
    """

    source: str
    repo_id: str
    root: Path
    n_episodes: int = 2000
    seed: int = 0

    def run(self) -> None:
        from lerobot_latentsafe.datasets.collect import collect_dubins

        dataset = collect_dubins(self.source, self.repo_id, self.root, self.n_episodes, self.seed)
        print(f"{dataset.num_episodes} episodes, {dataset.num_frames} frames in {self.root}")


@dataclass
class Cache:
    """Copy a dataset without its images and store its frames, decoded and resized, beside it."""

    output_dir: Path
    dataset: DatasetSource = field(default_factory=DatasetSource)
    image_size: int = 32

    def run(self) -> None:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        from lerobot_latentsafe.datasets.frame_cache import build_frame_cache

        dataset = LeRobotDataset(self.dataset.repo_id, root=self.dataset.root)
        cache = build_frame_cache(dataset, self.output_dir, self.image_size)
        print(f"{cache.manifest['n_frames']} frames at {self.image_size} px in {self.output_dir}")
        print(f"train with --dataset.repo_id={self.dataset.repo_id}_cache --dataset.root={self.output_dir}")


@dataclass
class TrainReachability:
    """Learn V and the fallback policy in the imagination of a trained, frozen world model.

    With several --seeds each gets its own critic, in <output_dir>/seed_<n>.
    """

    policy: PolicySource
    output_dir: Path
    dataset: DatasetSource = field(default_factory=DatasetSource)
    seeds: list[int] = field(default_factory=lambda: [0])
    steps: int | None = None
    """Gradient steps; None takes the configuration's."""

    def run(self) -> None:
        from lerobot_latentsafe.training import train_reachability

        for seed in self.seeds:
            output_dir = self.output_dir if len(self.seeds) == 1 else self.output_dir / f"seed_{seed}"
            train_reachability(self.policy.path, self.dataset.metadata(), output_dir, seed, self.steps)
            print(f"filter with a trained critic in {output_dir}")


@dataclass
class PathOf:
    """Print the folder of a committed checkpoint."""

    name: str = "dubins"

    def run(self) -> None:
        from lerobot_latentsafe.checkpoint import resolve_checkpoint

        print(resolve_checkpoint(self.name))
