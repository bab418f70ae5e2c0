"""Failure labels: one verdict a frame, kept outside `observation.*` so that no policy can read the answer."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

FAILING, SAFE, UNLABELLED = 1, 0, -1


class UnlabelledDatasetError(ValueError):
    """The dataset has no usable failure labels."""


@dataclass
class FailureLabels:
    """Labels by the dataset's frame index.

    Attributes:
        failure: int8 (N,), 1 failing, 0 safe, -1 unlabelled.
        terminal: int8 (N,), 1 where an episode ended by itself, 0 where it goes on, -1 unknown.
        episode: int64 (N,), the episode of each frame.
    """

    failure: np.ndarray
    terminal: np.ndarray
    episode: np.ndarray

    @classmethod
    def load(cls, root: str | Path, specification: str = "failure") -> "FailureLabels":
        """Read labels of a dataset on disk.

        They come from the column `specification`, or from the sidecar `labels/<specification>.parquet` with the
        columns `index` and `failure`, which wins where both exist.

        Raises:
            UnlabelledDatasetError: neither exists, a sidecar does not match the frames, or one class is missing.
        """
        root = Path(root)
        files = sorted(root.glob("data/*/*.parquet"))
        if not files:
            raise UnlabelledDatasetError(f"{root} holds no data/*/*.parquet; is it a LeRobotDataset (v3) folder?")
        columns = set(pq.ParquetFile(files[0]).schema_arrow.names)
        wanted = ["index", "episode_index", *({specification, "next.done"} & columns)]
        table = {name: [] for name in wanted}
        for file in files:
            read = pq.read_table(file, columns=wanted)
            for name in wanted:
                table[name].append(np.asarray(read[name].to_pylist()).reshape(-1))
        data = {name: np.concatenate(parts) for name, parts in table.items()}
        order = np.argsort(data["index"])
        n = len(order)
        episode = data["episode_index"][order].astype(np.int64)
        terminal = np.full(n, UNLABELLED, np.int8)
        if "next.done" in data:
            terminal = _as_labels(data["next.done"][order], n, f"column 'next.done' of {root}")
        sidecar = root / "labels" / f"{specification}.parquet"
        if sidecar.exists():
            failure = _read_sidecar(sidecar, n)
        elif specification in data:
            if len(data[specification]) != n:
                raise UnlabelledDatasetError(
                    f"column {specification!r} of {root} holds {len(data[specification])} labels for {n} frames; "
                    "expected one a frame"
                )
            failure = _as_labels(data[specification][order], n, f"column {specification!r} of {root}")
        else:
            raise UnlabelledDatasetError(
                f"{root} has no failure labels: expected a column {specification!r} (1 failing, 0 safe, "
                f"-1 unlabelled) or {sidecar.relative_to(root)}; its columns are {', '.join(sorted(columns))}"
            )
        labels = cls(failure, terminal, episode)
        labels._check(root, specification)
        return labels

    def _check(self, root: Path, specification: str) -> None:
        for value, name in ((FAILING, "failing"), (SAFE, "safe")):
            if not (self.failure == value).any():
                raise UnlabelledDatasetError(
                    f"labels {specification!r} of {root} have no {name} frame among {len(self.failure)}; "
                    "a failure margin needs examples of both classes"
                )

    @property
    def balance(self) -> float:
        """Share of failing frames among the labelled."""
        return float((self.failure == FAILING).sum() / (self.failure != UNLABELLED).sum())


def _as_labels(values: np.ndarray, n: int, source: str) -> np.ndarray:
    """Exactly -1, 0 or 1 for each of n frames: what is cast to int8 unchecked could turn into "safe"."""
    if values.shape != (n,):
        raise UnlabelledDatasetError(f"{source} holds {values.size} labels for {n} frames; expected one a frame")
    unknown = sorted({str(v) for v in values.tolist() if v not in (FAILING, SAFE, UNLABELLED)})
    if unknown:
        raise UnlabelledDatasetError(f"{source} holds {', '.join(unknown[:5])}; expected 1, 0 or -1")
    return values.astype(np.int8)


def _read_sidecar(path: Path, n: int) -> np.ndarray:
    table = pq.read_table(path)
    missing = {"index", "failure"} - set(table.column_names)
    if missing:
        raise UnlabelledDatasetError(f"{path} lacks the columns {sorted(missing)}; expected index and failure")
    index, failure = np.asarray(table["index"]), np.asarray(table["failure"].to_pylist())
    if len(index) != n or not np.array_equal(np.sort(index), np.arange(n)):
        raise UnlabelledDatasetError(
            f"{path} labels {len(index)} frames, the dataset has {n}; expected each index 0..{n - 1} once. "
            "It may belong to another dataset"
        )
    labels = np.full(n, UNLABELLED, np.int8)
    labels[index] = _as_labels(failure, n, str(path))
    return labels
