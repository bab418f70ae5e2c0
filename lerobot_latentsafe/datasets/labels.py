"""Failure labels: one verdict a frame, kept outside `observation.*` so that no policy can read the answer."""

import hashlib
import logging
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_latentsafe.datasets.arrow import to_numpy
from lerobot_latentsafe.datasets.fingerprints import by_length_alone, episode_spans, fingerprint, telling_columns
from lerobot_latentsafe.datasets.frame_labels import FAILING, SAFE, UNLABELLED, FrameLabels, as_labels
from lerobot_latentsafe.datasets.label_file import METADATA, SCHEMA, LabelTable, Written, read_label_file
from lerobot_latentsafe.datasets.label_places import (
    FOLDER,
    NAME,
    LabelFileError,
    UnlabelledDatasetError,
    label_files,
    label_folders_nearby,
    sidecar_path,
    specifications_of,
)
from lerobot_latentsafe.datasets.reading import DOWNLOAD_AGAIN, BrokenFileError, reading
from lerobot_latentsafe.runtime.files import replacing

logger = logging.getLogger(__name__)


def read_frames(root: str | Path, columns: Iterable[str] = ()) -> dict[str, np.ndarray]:
    """`index`, `episode_index` and those of `columns` that exist, of every frame in the order of the index.

    Raises:
        BrokenFileError: no dataset at root, or a file of it that cannot be read.
    """
    files = sorted(Path(root).glob("data/*/*.parquet"))
    if not files:
        raise BrokenFileError(
            f"{root} holds no data/*/*.parquet, where the frames of a LeRobotDataset (v3) lie; {DOWNLOAD_AGAIN}"
        )
    with reading(files[0]):
        present = set(pq.ParquetFile(files[0]).schema_arrow.names)
    index = _read_column(files, "index")
    order = np.argsort(index, kind="stable")
    read = {"index": index[order]}
    # One after the other: of a large dataset each takes memory, and Arrow keeps what it has had.
    for name in ("episode_index", *sorted(set(columns) & present - {"index"})):
        read[name] = _read_column(files, name)[order]
    pa.default_memory_pool().release_unused()
    return read


def _read_column(files: list[Path], name: str) -> np.ndarray:
    parts = []
    for file in files:
        with reading(file):
            parts.append(to_numpy(pq.ParquetFile(file).read(columns=[name])[name]))
    return _joined(parts)


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    """Of all files; arrays of objects where they are not of one shape."""
    if len({part.shape[1:] for part in parts}) > 1:
        parts = [np.fromiter(part, object, len(part)) for part in parts]
    return np.concatenate(parts)


class Content:
    """The numbers of a dataset, which tell its episodes apart.

    Args:
        root: the dataset's folder.
        more: further columns to read.

    Attributes:
        frames: the columns that were read; see `read_frames`.
        columns: names of those that tell episodes apart.

    Raises:
        UnlabelledDatasetError: no dataset at root.
    """

    def __init__(self, root: str | Path, more: Iterable[str] = ()):
        self.root = Path(root)
        self.columns = telling_columns(self.root)
        self.frames = read_frames(root, [*self.columns, "action", *more])
        self._fingerprints: dict[tuple[str, ...], list[str]] = {}

    def __len__(self) -> int:
        return len(self.frames["index"])

    @cached_property
    def spans(self) -> tuple[np.ndarray, np.ndarray]:
        """First frame index and length of each episode; see `episode_spans`."""
        return episode_spans(self.frames["episode_index"])

    def fingerprints(self, columns: list[str]) -> list[str]:
        """One for each episode, of these columns; none if the dataset lacks one of them."""
        if tuple(columns) in self._fingerprints:
            return self._fingerprints[tuple(columns)]
        if missing := set(columns) - set(self.frames):
            self.frames |= read_frames(self.root, missing)
        rows = (slice(first, first + n) for first, n in zip(*self.spans))
        known = set(columns) <= set(self.frames)
        found = [fingerprint(self.frames, columns, span) for span in rows] if known else []
        return self._fingerprints.setdefault(tuple(columns), found)

    @cached_property
    def identity(self) -> str:
        """One fingerprint for the whole dataset."""
        return hashlib.sha256("".join(self.fingerprints(self.columns)).encode()).hexdigest()[:16]

    def identity_by_actions(self, n: int) -> str:
        """What label files of schema 1 know a dataset by: episodes and actions of its first n frames."""
        digest = hashlib.sha256(np.ascontiguousarray(self.frames["episode_index"][:n], dtype="<i8").tobytes())
        if "action" in self.frames:
            digest.update(np.ascontiguousarray(self.frames["action"][:n], dtype="<f4").tobytes())
        return digest.hexdigest()[:16]


class Sidecar(FrameLabels):
    """The label file of one specification."""

    @classmethod
    def find(
        cls, root: str | Path, specification: str, content: Content, repo_id: str | None = None
    ) -> "Sidecar | None":
        """What all label files of a dataset say, wherever they lie; the later verdict counts. None: there is none.

        Raises:
            LabelFileError: the file that new labels would go to is not this dataset's, or not usable.
        """
        own, found = sidecar_path(root, specification, repo_id), None
        at_home = (own.parent, Path(root).absolute() / FOLDER)
        for file in label_files(root, specification, repo_id):
            try:
                read = cls.read(file, content, repo_id, by_place=file.parent in at_home)
            except LabelFileError as e:
                if file == own:
                    raise
                logger.info("not used: %s", e)
                continue
            found = read if found is None else found.updated(read)
        return found

    @classmethod
    def read(cls, path: Path, content: Content, repo_id: str | None = None, by_place: bool = True) -> "Sidecar":
        """Read a file written by `write`, or a plain table with the columns `index` and `failure`.

        An episode is known by its content: of a dataset that was recorded on, cut or joined since, each episode has
        its labels, and those that the file does not know are unlabelled.

        Args:
            repo_id: the dataset's id, where it is known.
            by_place: whether the file's place tells that it is this dataset's, where nothing in it does.

        Raises:
            LabelFileError: of another dataset, of another schema, not readable, or values that are no labels.
        """
        written, table = read_label_file(path)
        if not by_place and _knows_little(written, content):
            raise LabelFileError(f"{path} does not tell of which episodes it is; move it to its dataset")
        if written is None:
            return cls._of_table(table, len(content), len(content), path)
        if written.schema == SCHEMA:
            stored = cls._of_table(table, written.frames, written.frames, path)
            found = stored.moved(content, written.columns, written.episodes, written.lengths)
        else:
            found = cls._of_schema_1(table, written, content, repo_id, path)
        if found is None:
            raise LabelFileError(
                f"{path} was made for another dataset ({written.repo_id}, {written.frames} frames, "
                f"{written.identity}); this one has {len(content)} frames ({content.identity}). Move the file to its "
                "dataset. Nothing was overwritten"
            )
        return found

    @classmethod
    def _of_table(cls, table: LabelTable, covered: int, n: int, path: Path) -> "Sidecar":
        """Labels of n frames, from a table of the first `covered`."""
        index = table.index
        if len(index) != covered or not np.array_equal(np.sort(index), np.arange(covered)):
            raise LabelFileError(
                f"{path} labels {len(index)} frames, the dataset has {n}; expected each index 0..{covered - 1} once. "
                "It may belong to another dataset"
            )
        sidecar = cls.empty(n)
        sidecar.failure[index], sidecar.by[index], sidecar.at[index] = table.failure, table.by, table.at
        sidecar.names = table.names
        return sidecar

    @classmethod
    def _of_schema_1(
        cls, table: LabelTable, written: Written, content: Content, repo_id: str | None, path: Path
    ) -> "Sidecar | None":
        """From a file that knows its dataset by actions, or, where there are none, by its name."""
        covered = written.frames
        if covered > len(content) or content.identity_by_actions(covered) != written.identity:
            return None
        if "action" not in content.frames and repo_id not in (None, written.repo_id, f"{written.repo_id}_cache"):
            return None
        return cls._of_table(table, covered, len(content), path)

    def moved(self, content: Content, columns: list[str], episodes: list[str], lengths: list[int]) -> "Sidecar | None":
        """The same labels on the frames of another dataset; see `onto`."""
        there = content.fingerprints(columns)
        return self.onto(columns, episodes, lengths, there, content.spans[0], len(content))

    def write(self, path: Path, repo_id: str, content: Content) -> None:
        """Replace the file atomically: whatever happens, the old or the new one is there, whole.

        Args:
            content: of the dataset whose frames these are.
        """
        n = len(self.failure)
        described = Written(
            SCHEMA, n, content.identity, repo_id, content.columns, content.spans[1].tolist(),
            content.fingerprints(content.columns),
        )  # fmt: skip
        by = pa.DictionaryArray.from_arrays(pa.array(self.by, mask=self.by < 0), pa.array(self.names, pa.string()))
        table = pa.table(
            {
                "index": pa.array(np.arange(n)),
                "failure": pa.array(self.failure),
                "labelled_by": by,
                "labelled_at": pa.array(self.at, pa.timestamp("us", "UTC"), mask=self.at == 0),
            }
        ).replace_schema_metadata({METADATA: described.as_json()})
        with replacing(path) as partial:
            pq.write_table(
                table,
                partial,
                use_dictionary=["labelled_by", "labelled_at"],
                column_encoding={"index": "DELTA_BINARY_PACKED"},
                compression="zstd",
                write_page_checksum=True,
            )


def _knows_little(written: Written | None, content: Content) -> bool:
    """Whether nothing in a label file but lengths tells of which episodes it is."""
    if written is None or written.schema != SCHEMA:
        return written is None or "action" not in content.frames
    return by_length_alone(written.columns)


def labelled_nearby(specification: str, content: Content) -> list[Path]:
    """Folders with labels of other datasets that hold some of the same episodes, as after a merge or a deletion."""
    found = []
    for folder in label_folders_nearby(content.root):
        try:
            Sidecar.read(folder / f"{specification}.parquet", content, by_place=False)
        except (LabelFileError, OSError):
            continue
        found.append(folder)
    return found


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
    def load(
        cls, root: str | Path, specification: str = "failure", repo_id: str | None = None, both: bool = True
    ) -> "FailureLabels":
        """Read labels of a dataset on disk.

        They come from the column `specification`, or from the sidecar `labels/<specification>.parquet` with the
        columns `index` and `failure`, which wins where both exist. It lies in the dataset's folder, or in LeRobot's
        home; see `label_folders`.

        Args:
            repo_id: the dataset's id, where it is known.
            both: refuse labels that lack failing or safe frames, of which no margin can be fitted.

        Raises:
            UnlabelledDatasetError: neither exists, a sidecar does not match the frames, or one class is missing.
        """
        root = Path(root)
        content = Content(root, [specification, "next.done"])
        data, n = content.frames, len(content)
        episode, terminal = data["episode_index"].astype(np.int64), np.full(n, UNLABELLED, np.int8)
        if "next.done" in data:
            terminal = as_labels(data["next.done"], n, f"column 'next.done' of {root}")
        sidecar = Sidecar.find(root, specification, content, repo_id)
        if sidecar is not None:
            failure = sidecar.failure
        elif specification in data:
            failure = as_labels(data[specification], n, f"column {specification!r} of {root}")
        else:
            raise UnlabelledDatasetError(_no_labels(content, specification, repo_id))
        labels = cls(failure, terminal, episode)
        if both:
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


def _no_labels(content: Content, specification: str, repo_id: str | None) -> str:
    columns = pq.ParquetFile(next(content.root.glob("data/*/*.parquet"))).schema_arrow.names
    known = ", ".join(specifications_of(content.root, repo_id)) or "none"
    said = (
        f"{content.root} has no failure labels: expected a column {specification!r} (1 failing, 0 safe, -1 unlabelled) "
        f"or the file {sidecar_path(content.root, specification, repo_id)}, which latentsafe label makes; its columns "
        f"are {', '.join(sorted(columns))}, its label files {known}"
    )
    if near := labelled_nearby(specification, content):
        said += f". {carry_hint(near)}"
    return said


def carry_hint(folders: list[Path]) -> str:
    """Where episodes of a dataset are labelled, and how to carry the labels over."""
    return (
        f"Episodes of it are labelled in {', '.join(map(str, folders))}; carry the labels over with latentsafe "
        f"carry-labels --sources='[{','.join(map(str, folders))}]'"
    )


def all_labels(root: str | Path, features: dict[str, dict], repo_id: str | None = None) -> dict[str, np.ndarray]:
    """The labels of all specifications that a dataset has, name -> int8 (N,).

    Args:
        features: of the dataset. `failure` must hold labels; others do if their name is fit and all values are labels.
        repo_id: of the dataset, for label files that do not lie in its folder.

    Raises:
        LabelFileError: a label file of another dataset, or values that are no labels.
    """
    numbers = [name for name, f in features.items() if f["dtype"].startswith(("bool", "int", "uint", "float"))]
    columns, found = [name for name in ["failure", *numbers] if NAME.fullmatch(name)], {}
    content = Content(root, columns)
    for name in sorted(set(columns) & set(content.frames)):
        try:
            found[name] = as_labels(content.frames[name], len(content), f"column {name!r} of {root}")
        except LabelFileError:
            if name == "failure":
                raise
    for name in specifications_of(root, repo_id):
        if (sidecar := Sidecar.find(root, name, content, repo_id)) is not None:
            found[name] = sidecar.failure
    return found
