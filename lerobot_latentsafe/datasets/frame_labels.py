"""Labels of frames, with who gave each and when; and how they move from one dataset to another by content."""

from collections import defaultdict
from dataclasses import dataclass
from typing import Self

import numpy as np

from lerobot_latentsafe.datasets.fingerprints import by_length_alone
from lerobot_latentsafe.datasets.label_places import LabelFileError

FAILING, SAFE, UNLABELLED = LABELS = 1, 0, -1


@dataclass
class FrameLabels:
    """Labels by frame index, and who gave each, and when.

    Attributes:
        failure: int8 (N,).
        by: int32 (N,), a place in `names`, or -1.
        at: int64 (N,), microseconds since 1970 UTC; 0 where unlabelled or unknown.
        names: who labelled.
        left: labelled episodes of the file that have no place in the dataset.
    """

    failure: np.ndarray
    by: np.ndarray
    at: np.ndarray
    names: list[str]
    left: int = 0

    @classmethod
    def empty(cls, n: int) -> Self:
        """Labels of n frames that nobody has labelled."""
        return cls(np.full(n, UNLABELLED, np.int8), np.full(n, -1, np.int32), np.zeros(n, np.int64), [])

    def onto(
        self, columns: list[str], episodes: list[str], lengths: list[int], there: list[str], start: np.ndarray, n: int
    ) -> Self | None:
        """The same labels on the n frames of a dataset that has some of the same episodes; None: it has none of them.

        What cannot be told apart, and what these labels do not cover, is unlabelled there.

        Args:
            columns: those that the fingerprints are of.
            episodes, lengths: fingerprints and frames of the episodes that these labels are of.
            there, start: fingerprints and first frames of the episodes of the dataset.
        """
        spans = [slice(end - length, end) for end, length in zip(np.cumsum(lengths), lengths)]
        if there[: len(episodes)] == episodes:
            source = {i: i for i in range(len(episodes))}
        elif by_length_alone(columns) or not set(there) & set(episodes):
            return None
        else:
            source = self._alike(there, episodes, spans)
        moved = self.empty(n)
        moved.names = list(self.names)
        for to, i in source.items():
            rows = slice(start[to], start[to] + lengths[i])
            moved.failure[rows], moved.by[rows] = self.failure[spans[i]], self.by[spans[i]]
            moved.at[rows] = self.at[spans[i]]
        placed = {episodes[i] for i in source.values()}
        left = (span for span, episode in zip(spans, episodes) if episode not in placed)
        moved.left = sum(bool((self.failure[span] != UNLABELLED).any()) for span in left)
        return moved

    def _alike(self, there: list[str], episodes: list[str], spans: list[slice]) -> dict[int, int]:
        """Which of these episodes each of a dataset's is; of episodes that look alike, only if their labels do, too."""
        alike = defaultdict(list)
        for i, episode in enumerate(episodes):
            alike[episode].append(i)
        source = {}
        for to, episode in enumerate(there):
            if len({self.failure[spans[i]].tobytes() for i in alike.get(episode, [])}) == 1:
                source[to] = max(alike[episode], key=lambda i: self.at[spans[i]].max(initial=0))
        return source

    def updated(self, other: "FrameLabels") -> Self:
        """These labels, and another's on the same frames where it was given later, or alone."""
        names = [*self.names, *(name for name in other.names if name not in self.names)]
        places = np.array([names.index(name) for name in other.names] + [-1])
        alone = (self.at == 0) & (self.failure == UNLABELLED)
        taken = (other.at > self.at) | (alone & (other.failure != UNLABELLED))
        return type(self)(
            np.where(taken, other.failure, self.failure), np.where(taken, places[other.by], self.by).astype(np.int32),
            np.where(taken, other.at, self.at), names, self.left,
        )  # fmt: skip


def as_labels(values: np.ndarray, n: int, source: str) -> np.ndarray:
    """Exactly -1, 0 or 1 for each of n frames: what is cast to int8 unchecked could turn into "safe".

    Raises:
        LabelFileError: anything else, naming some of it.
    """
    if values.shape == (n, 1):
        values = values[:, 0]
    if values.shape != (n,):
        raise LabelFileError(f"{source} holds {values.size} labels for {n} frames; expected one a frame")
    told = np.unique(values) if values.dtype.kind in "biuf" else values
    told = told if values.dtype.kind in "biufO" else told.astype(str)  # NumPy's times would become whole numbers
    unknown = sorted({str(v) for v in told.tolist() if not (isinstance(v, int | float) and v in LABELS)})
    if unknown:
        raise LabelFileError(f"{source} holds {', '.join(unknown[:5])}; expected 1, 0 or -1")
    return values.astype(np.int8)
