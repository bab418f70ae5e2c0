"""Verbs that bring a filter to where it is used: folders, the Hub, older checkpoints."""

from dataclasses import dataclass, field
from pathlib import Path

from lerobot.policies.pretrained import PreTrainedPolicy

from lerobot_latentsafe.cli.places import PolicySource
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.migration import migrate_checkpoint
from lerobot_latentsafe.model_card import measured
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.policies.dreamer.modeling_dreamer import LatentSafeDreamerPolicy
from lerobot_latentsafe.runtime.checkpoint import read_config
from lerobot_latentsafe.runtime.files import refuse_existing
from lerobot_latentsafe.runtime.hub import push_policy, save_policy
from lerobot_latentsafe.runtime.locations import resolve_checkpoint
from lerobot_latentsafe.world_models.rssm import RSSM


@dataclass
class Wrap:
    """Write a filter and the policy it shields as one self-contained folder that every LeRobot command can load.

    latentsafe wrap --policy.path=outputs/filter --base_policy_path=me/my_policy --output_dir=outputs/shielded

    Options of --law change the filter's law; what is not given stays as it is.
    """

    policy: PolicySource
    output_dir: Path
    """The folder to write."""
    base_policy_path: str | None = None
    """The policy to shield: a folder, a Hub id, or the name of a committed checkpoint."""
    law: LawOptions = field(default_factory=LawOptions)
    half: bool = False
    """Store weights in 16 bits."""
    drawing: bool = True
    """Keep what draws an RSSM's imagination for reports, two fifths of its weights."""

    def run(self) -> None:
        """Load, change and save."""
        refuse_existing(self.output_dir)
        policy = load_filter(self.policy.path, law=self.law, base_policy=self.base_policy_path)
        if not self.drawing:
            world_model = policy.model.world_model
            if not (isinstance(world_model, RSSM) and world_model.draws):
                raise ValueError(f"--drawing=false, but the {world_model.config.type} world model draws nothing")
            world_model.stop_drawing()
            policy.config.change(world_model=world_model.config)
        save_policy(policy, self.output_dir, half=self.half)
        print(f"wrote {self.output_dir}")


@dataclass
class Push:
    """Push a filter, a shielded policy or a task policy of train-dreamer to the Hub with its card.

    latentsafe push --policy.path=outputs/shielded --repo_id=me/shielded --dataset_repo_id=me/bag
    """

    policy: PolicySource
    repo_id: str
    """The repository on the Hub, such as me/filter."""
    dataset_repo_id: str = "unknown"
    """The dataset named in the card."""
    base_policy_path: str | None = None
    """The policy to shield: a folder, a Hub id, or the name of a committed checkpoint."""
    results: list[Path] = field(default_factory=list)
    """Files of eval-shield or of the experiments in scripts/, whose rates the card is to report."""
    private: bool = False
    """In a repository that only you see."""

    def run(self) -> None:
        """Load, upload, and print the address."""
        url = push_policy(self._load(), self.repo_id, self.dataset_repo_id, self.private)
        print(f"pushed to {url}")

    def _load(self) -> PreTrainedPolicy:
        if read_config(resolve_checkpoint(self.policy.path)).type == LatentSafeDreamerPolicy.name:
            if self.base_policy_path or self.results:
                raise ValueError("--base_policy_path and --results belong to a filter; --policy.path is a task policy")
            return LatentSafeDreamerPolicy.from_pretrained(self.policy.path)
        policy = load_filter(self.policy.path, base_policy=self.base_policy_path)
        policy.model.require_stage("world_model")
        evaluation = dict(policy.config.evaluation)
        for file in self.results:
            evaluation |= measured(file, policy.config.law.name)
        policy.config.change(evaluation=evaluation)
        return policy


@dataclass
class MigrateCheckpoint:
    """Copy a checkpoint of a version before 0.2 into the present layout, with the filters and policies in it.

    latentsafe migrate-checkpoint --policy.path=outputs/old_filter --output_dir=outputs/filter

    Weights and decisions stay the same; only names and groups of the configuration change.
    """

    policy: PolicySource
    output_dir: Path
    """The folder to write."""

    def run(self) -> None:
        """Copy, and name what was migrated."""
        source = resolve_checkpoint(self.policy.path)
        for folder in migrate_checkpoint(source, self.output_dir):
            print(f"migrated {source / folder} to {self.output_dir / folder}")
