"""Verbs that label by a function or a model, and those that check, carry and write labels."""

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_latentsafe.cli.options import DatasetSource
from lerobot_latentsafe.cli.places import DefaultPolicySource
from lerobot_latentsafe.datasets.columns import push_dataset, write_columns
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.labels import UNLABELLED
from lerobot_latentsafe.evaluation.along_episodes import episode_margins
from lerobot_latentsafe.labeling import automatic
from lerobot_latentsafe.labeling.carrying import carry_labels, specifications_in
from lerobot_latentsafe.labeling.disagreements import find_disagreements, write_disagreements
from lerobot_latentsafe.labeling.label_tasks import CutLabelling
from lerobot_latentsafe.labeling.store import LabelStore, in_words
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.runtime.tasks import Tasks

SHOWN = 10
"""Episodes without a label that are named."""


@dataclass
class AutoLabel:
    """Let a function label the episodes that have no label yet; labels people gave stay.

    latentsafe auto-label --labeller=my_module:my_function --dataset.repo_id=me/bag --dataset.root=data/bag

    Every answer is saved before the next is asked for: if it is stopped, the same command goes on there.

    Labellers: dubins_truth (the car's recorded position), module:function (your own, see labeling/automatic.py), and
    vision_language, which asks the model at --url about --failure and takes well-formed answers only. A service's key
    is read from the environment variable LATENTSAFE_MODEL_KEY.

    With --tasks.number=N the episodes are shared among N tasks; their answers become labels once all have one. See
    docs/scaling.md.
    """

    labeller: str
    """Who labels; see above."""
    dataset: DatasetSource = field(default_factory=DatasetSource)
    specification: str = "failure"
    """The name of the labels."""
    failure: str | None = None
    """What counts as a failure, in words, for vision_language."""
    url: str = "http://127.0.0.1:8000/v1"
    """Where the model of vision_language answers, in the protocol of OpenAI's chat."""
    model: str = "default"
    """What it is called there."""
    tasks: Tasks = field(default_factory=Tasks)

    def run(self) -> None:
        """Label, and say how many; exits with 1 if an episode got no answer, or one that is no label."""
        labeller = self._find()
        frames = self.dataset.frames()
        result = self._in_tasks(frames) if self.tasks.number else self._alone(frames, labeller)
        if result is not None and (without := result["refused"] + result["failed"]):
            sys.exit(f"{len(without)} episodes got no label; the others are saved. The same command asks again")

    def _alone(self, frames: DatasetFrames, labeller: automatic.Labeller) -> dict[str, list]:
        store = LabelStore(frames.root, frames.meta.repo_id, [self.specification])
        result = automatic.label_automatically(store, frames, self.specification, labeller, self.labeller)
        _tell_labelled(result)
        return result

    def _in_tasks(self, frames: DatasetFrames) -> dict[str, list] | None:
        self.tasks.require_executor()
        self.tasks.require_work(len(frames.episodes), "episodes")
        asked = {name: getattr(self, name) for name in ("labeller", "failure", "url", "model")}
        work = CutLabelling.of(frames, self.specification, self.labeller, self._find, asked, _tell_labelled)
        result = work.run(self.tasks)
        if result is None:
            print(f"submitted: the last task saves the labels; logs are in {work.output}.tasks")
        return result

    def _find(self) -> automatic.Labeller:
        if self.labeller != "vision_language":
            return automatic.find_labeller(self.labeller)
        if not self.failure:
            raise ValueError("vision_language needs --failure: what counts as one, such as 'a candy left the bag'")
        endpoint = automatic.ChatEndpoint(self.url, self.model, os.environ.get("LATENTSAFE_MODEL_KEY"))
        return automatic.VisionLanguageLabeller(endpoint, self.failure)


def _tell_labelled(result: dict[str, list]) -> None:
    """How many episodes were labelled, and why others were not."""
    for name, episodes in result.items():
        print(f"{name:10s} {len(episodes)} episodes")
    for episode, why in (result["refused"] + result["failed"])[:SHOWN]:
        print(f"episode {episode}: {why}")


@dataclass
class CheckLabels:
    """List the labelled episodes that a trained filter disagrees with, the worst first, on one HTML page.

    latentsafe check-labels --policy.path=outputs/filter --dataset.repo_id=me/bag --dataset.root=data/bag
    """

    policy: DefaultPolicySource = field(default_factory=DefaultPolicySource)
    dataset: DatasetSource = field(default_factory=DatasetSource)
    specification: str = "failure"
    """The name of the labels."""
    output: Path = Path("outputs/disagreements.html")
    """The page to write."""

    def run(self) -> None:
        """Write the page, and print the worst."""
        model, frames = load_filter(self.policy.path).model, self.dataset.frames()
        store = LabelStore(frames.root, frames.meta.repo_id, [self.specification])
        judged = dict(episode_margins(model, frames))
        margins = {episode: margin for episode, margin in judged.items() if not isinstance(margin, str)}
        without = {episode: why for episode, why in judged.items() if isinstance(why, str)}
        found = find_disagreements(store, self.specification, margins)
        for d in found[:20]:
            label = in_words(store.verdict(self.specification, d.episode).first, len(d.margin))
            print(f"episode {d.episode:5d}  {d.degree:.2f}  labelled: {label}")
        write_disagreements(self.output, found, store, frames, self.specification)
        for episode, why in [*without.items()][:SHOWN]:
            print(f"episode {episode} was not judged, because {why}")
        print(f"{len(found)} disagreements; {len(without)} episodes were not judged; open {self.output}")


@dataclass
class CarryLabels:
    """Take over labels from datasets that this one was joined, cut or copied from; episodes are known by content.

    latentsafe carry-labels --sources='[data/bag,data/rollout]' --dataset.repo_id=me/all --dataset.root=data/all
    """

    sources: list[Path]
    """Folders of labelled datasets, or of label files."""
    dataset: DatasetSource = field(default_factory=DatasetSource)

    def run(self) -> None:
        """Carry labels over, and say how many."""
        self.dataset.require_whole("carry-labels", "leave it out: episodes that no source has stay as they are")
        names, meta = specifications_in(self.sources), self.dataset.metadata()
        store = LabelStore(meta.root, meta.repo_id, names)
        for name, n in carry_labels(store, self.sources).items():
            labelled = sum((store.labels(name, e) != UNLABELLED).any() for e in range(len(store)))
            print(f"{name}: {n} episodes have new labels; {labelled} of {len(store)} are labelled")


@dataclass
class WriteLabels:
    """Copy a dataset with its label files as columns, which LeRobot alone can read, and push it on request.

    latentsafe write-labels --dataset.repo_id=me/bag --dataset.root=data/bag --new_repo_id=me/bag_labelled \\
      --output_dir=data/bag_labelled
    """

    output_dir: Path
    """The folder to write."""
    new_repo_id: str
    """The id of the copy."""
    dataset: DatasetSource = field(default_factory=DatasetSource)
    specifications: list[str] = field(default_factory=lambda: ["failure"])
    """The names of the labels that become columns."""
    push_to_hub: bool = False
    """Push the copy to the Hub."""
    private: bool = False
    """In a repository that only you see."""

    def run(self) -> None:
        """Write the copy, and push it if asked to."""
        self.dataset.require_whole(
            "write-labels", "leave it out, and delete episodes of the copy with LeRobot's lerobot-edit-dataset"
        )
        written = write_columns(self.dataset.opened(), self.specifications, self.output_dir, self.new_repo_id)
        print(f"{written.num_frames} frames with the columns {', '.join(self.specifications)} in {self.output_dir}")
        if self.push_to_hub:
            push_dataset(written, self.private)
            print(f"pushed to {self.new_repo_id}")
