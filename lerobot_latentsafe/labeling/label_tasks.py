"""Labelling without a person in tasks, on one computer or several.

A piece is an episode: an answer, which may have been paid for, is kept before the next is asked for. Only the last step
writes labels, for a label file has one writer.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.folder import load_metadata
from lerobot_latentsafe.datasets.frame_cache import dataset_fingerprint
from lerobot_latentsafe.datasets.label_places import label_folders
from lerobot_latentsafe.labeling.automatic import PATIENCE, Answer, Labeller, ask, sorted_answers, unlabelled
from lerobot_latentsafe.labeling.store import LabelStore
from lerobot_latentsafe.runtime.tasks import Pieces

Tool = tuple[Labeller, DatasetFrames]


@dataclass(frozen=True)
class CutLabelling(Pieces[Tool, Answer]):
    """Episodes without a label that tasks ask a labeller about; see `label_automatically`.

    Attributes:
        repo_id, root, cameras: of the dataset.
        episodes: those that have no label yet, ascending.
        specification: the name of the labels.
        labeller: its name.
        find: finds it.
        asked: all that its answers depend on, beside the episode; JSON-able.
        tell: hears how it went; see `sorted_answers`.
    """

    output: Path
    repo_id: str
    root: Path
    cameras: list[str]
    episodes: list[int]
    specification: str
    labeller: str
    find: Callable[[], Labeller]
    asked: dict[str, Any]
    tell: Callable[[dict[str, list]], None]

    name = "labels"

    @classmethod
    def of(
        cls, frames: DatasetFrames, specification: str, labeller: str, find: Callable[[], Labeller],
        asked: dict[str, Any], tell: Callable[[dict[str, list]], None],
    ) -> "CutLabelling":  # fmt: skip
        """About the episodes of `frames` that have no label yet.

        Raises:
            LabelFileError, OSError: see `LabelStore`.
        """
        root, repo_id = frames.root.absolute(), frames.meta.repo_id
        with closing(LabelStore(root, repo_id, [specification])) as store:
            to_ask = unlabelled(store, frames, specification)
        folder = label_folders(root, repo_id)[0]  # beside it: what lies in it is label files
        output = folder.with_name(f"{folder.name}.{specification}")
        return cls(output, repo_id, root, frames.cameras, to_ask, specification, labeller, find, asked, tell)

    @property
    def numbers(self) -> Sequence[int]:
        """The episodes."""
        return self.episodes

    def begin(self) -> Tool:
        """The labeller, and the dataset's pictures.

        Raises:
            ValueError: there is no such labeller, or no such dataset.
        """
        frames = DatasetFrames(load_metadata(self.repo_id, self.root), self.episodes)
        frames.cameras = list(self.cameras)
        return self.find(), frames

    def made_of(self, tool: Tool) -> dict[str, Any]:
        """What is asked, and the dataset; which of its episodes have no label may change meanwhile."""
        return {**self.asked, "dataset": dataset_fingerprint(tool[1].meta), "cameras": self.cameras}

    def do(self, tool: Tool, numbers: Sequence[int]) -> Iterator[Answer]:
        """Ask about some episodes."""
        return ask(*tool, numbers, self.labeller, min(PATIENCE, len(self.episodes)))

    def finish(self, results: list[Answer]) -> dict[str, list]:
        """Save the answers about episodes that have no label yet, and tell.

        Raises:
            OSError: the disk is full, or another process labels the dataset; the answers stay.
        """
        with closing(LabelStore(self.root, self.repo_id, [self.specification])) as store:
            frames = DatasetFrames(load_metadata(self.repo_id, self.root), self.episodes)
            still = {*unlabelled(store, frames, self.specification)}
            answers = [answer for answer in results if answer.episode in still]
            labels = {answer.episode: answer.labels for answer in answers if answer.labels is not None}
            store.label_frames(self.specification, labels, f"auto {self.labeller}")
        result = sorted_answers(answers)
        self.tell(result)
        return result
