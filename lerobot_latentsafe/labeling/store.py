"""The labels of one dataset while people work on them: in memory, and on disk after every key.

A verdict on an episode is one number, the first failing frame (all later frames fail); the episode's length means that
it never fails, None that nobody has said. Every state of an episode carries the time it was set, in microseconds: a
change names the state it was made on, so that two tabs cannot overwrite each other unseen.
"""

import hashlib
import logging
import threading
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout

from lerobot_latentsafe.datasets.label_places import label_folders, sidecar_path, specifications_of
from lerobot_latentsafe.datasets.labels import (
    FAILING,
    SAFE,
    UNLABELLED,
    Content,
    LabelFileError,
    Sidecar,
    as_labels,
    carry_hint,
    labelled_nearby,
)
from lerobot_latentsafe.runtime.files import replacing

logger = logging.getLogger(__name__)

UNDO_DEPTH = 1000


class ConflictError(RuntimeError):
    """Somebody else changed the episode meanwhile."""


@dataclass(frozen=True)
class Verdict:
    """What is known about one episode.

    Attributes:
        first: first failing frame; the length if it never fails; None if unlabelled or mixed.
        mixed: labels that are not "safe, then failing" (from a column or another tool).
        by: who said so. at: when, microseconds since 1970 UTC; 0 before anybody did.
    """

    first: int | None
    mixed: bool
    by: str | None
    at: int


class LabelStore:
    """All specifications of one dataset.

    Args:
        root: the dataset's folder; labels go to `labels/` in it, or to LeRobot's home (see `label_folders`).
        repo_id: its id, written into label files.
        specifications: names to offer besides those that have a file already.

    Raises:
        LabelFileError: a file of another dataset or schema, or an unusable name; nothing is touched.
        OSError: the folder cannot be written, or another process labels this dataset.
    """

    def __init__(self, root: str | Path, repo_id: str, specifications: list[str]):
        self.root, self.repo_id = Path(root), repo_id
        names = [*specifications, *specifications_of(root, repo_id)]
        self._paths = {name: sidecar_path(root, name, repo_id) for name in names}
        self.content = Content(root, self._paths)
        self.identity, (self.start, self.length) = self.content.identity, self.content.spans
        self._lock = threading.RLock()
        self._known: dict[str, tuple[int, ...] | None] = {}  # what each file was when it was last read or written
        self._undo: dict[tuple[str, str], list] = defaultdict(list)
        self._guard = own_folder(label_folders(root, repo_id)[0], self.root)
        try:  # what another process saved until now is read, and nothing that it still would
            self._files = {name: self._open(name, path) for name, path in self._paths.items()}
        except BaseException:
            self._guard.release()
            raise

    @property
    def specifications(self) -> list[str]:
        """Names of what can fail."""
        return list(self._files)

    def __len__(self) -> int:
        return len(self.length)

    def _open(self, name: str, path: Path) -> Sidecar:
        """Labels that there are, carried to where new ones go."""
        self._known[name] = _mark(path)
        found = Sidecar.find(self.root, name, self.content, self.repo_id)
        if found is None:
            return self._of_column(name)
        if not path.exists():
            self._write_file(name, found)
            logger.warning("the labels %r of %s were carried over to %s", name, self.repo_id, path)
        elif found.left:
            aside = _keep_aside(path)
            self._write_file(name, found)
            logger.warning(
                "%s has labels of %d episodes that this dataset lacks or that look alike; they are kept in %s, and "
                "the labels of all other episodes were carried over", path, found.left, aside,
            )  # fmt: skip
        return found

    def _of_column(self, name: str) -> Sidecar:
        """What the dataset says already is where labelling starts."""
        sidecar, frames = Sidecar.empty(len(self.content)), self.content.frames
        if name in frames:
            sidecar.failure = as_labels(frames[name], len(sidecar.failure), f"column {name!r} of {self.root}")
            sidecar.names, sidecar.by[sidecar.failure != UNLABELLED] = [f"column {name}"], 0
        elif near := labelled_nearby(name, self.content):
            logger.warning("%s has no labels %r yet. %s", self.repo_id, name, carry_hint(near))
        return sidecar

    def close(self) -> None:
        """Let other processes label."""
        self._guard.release()

    def verdict(self, specification: str, episode: int) -> Verdict:
        """What is known about an episode."""
        sidecar, span = self._files[specification], self._span(episode)
        failure, by = sidecar.failure[span], sidecar.by[span.start]
        first = first_failing(failure)
        mixed = first is None and bool((failure != UNLABELLED).any())
        return Verdict(first, mixed, sidecar.names[by] if by >= 0 else None, int(sidecar.at[span.start]))

    def labels(self, specification: str, episode: int) -> np.ndarray:
        """int8 (T,), 1 failing, 0 safe, -1 unlabelled."""
        return self._files[specification].failure[self._span(episode)].copy()

    def label(
        self, specification: str, episode: int, first: int | None, by: str, seen: int | None = None, tab: str = ""
    ) -> Verdict:
        """Set a verdict and save. It is on disk when this returns.

        Args:
            first: first failing frame, the episode's length for "never fails", None to clear.
            seen: `at` of the state this was decided on; None overwrites whatever is there.
            tab: whose undo it goes to.

        Raises:
            ConflictError: the state is no longer the one seen.
            OSError: not saved (disk full, folder gone); the labels are as before, in memory and on disk.
        """
        length = int(self.length[episode])
        if first is not None and not 0 <= first <= length:
            raise ValueError(f"first failing frame is {first}; expected 0 to {length} ({length}: never fails)")
        failure = np.full(length, UNLABELLED, np.int8)
        if first is not None:
            failure[:first], failure[first:] = SAFE, FAILING
        with self._lock:
            self._catch_up(specification)
            now = self.verdict(specification, episode)
            if seen is not None and seen != now.at and now.first == first and not now.mixed:
                return now  # saved before, and only the answer was lost
            return self._change(specification, episode, failure, by if first is not None else None, seen, tab)

    def _change(
        self, specification: str, episode: int, failure: np.ndarray, by: str | None, seen: int | None, tab: str
    ) -> Verdict:
        """Set an episode's labels (T,) unless somebody else did meanwhile, save, and remember how to undo it."""
        now = self.verdict(specification, episode)
        if seen is not None and seen != now.at:
            raise ConflictError(f"episode {episode} was changed by {now.by or 'somebody'} meanwhile")
        before = self._state(specification, episode)
        after = self._write(specification, episode, (failure, by, None))
        stack = self._undo[specification, tab]
        stack.append((episode, before, after.at))
        del stack[:-UNDO_DEPTH]
        return after

    def mark(
        self, specification: str, episode: int, frame: int, by: str, seen: int | None = None, tab: str = ""
    ) -> Verdict:
        """Mark one frame alone as failing, or take the mark back, and save; all other frames stay as they are.

        A few marked frames are enough for a constraint (`latentsafe add-constraint`). Arguments, errors: see `label`.
        """
        length = int(self.length[episode])
        if not 0 <= frame < length:
            raise ValueError(f"frame is {frame}; expected 0 to {length - 1}")
        with self._lock:
            self._catch_up(specification)
            failure = self.labels(specification, episode)
            failure[frame] = UNLABELLED if failure[frame] == FAILING else FAILING
            any_left = bool((failure != UNLABELLED).any())
            return self._change(specification, episode, failure, by if any_left else None, seen, tab)

    def label_frames(self, specification: str, failure: dict[int, np.ndarray], by: str) -> None:
        """Save whole label vectors of many episodes at once, as automatic labellers make them."""
        with self._lock:
            self._catch_up(specification)
            sidecar = self._files[specification]
            saved = [array.copy() for array in (sidecar.failure, sidecar.by, sidecar.at)]
            try:
                for episode, vector in failure.items():
                    self._put(sidecar, episode, (vector, by, None))
                self._save(specification)
            except BaseException:
                sidecar.failure, sidecar.by, sidecar.at = saved
                raise

    def take(self, specification: str, labels: Sidecar) -> int:
        """Take over another file's labels on the same frames, where they are later, and save.

        Returns:
            How many episodes have other labels than before.

        Raises:
            OSError: not saved; the labels are as before, in memory and on disk.
        """
        with self._lock:
            self._catch_up(specification)
            before = self._files[specification]
            self._files[specification] = after = before.updated(labels)
            try:
                self._save(specification)
            except BaseException:
                self._files[specification] = before
                raise
            spans = map(self._span, range(len(self)))
            return sum(not np.array_equal(before.failure[span], after.failure[span]) for span in spans)

    def undo(self, specification: str, tab: str = "") -> tuple[int, Verdict] | None:
        """Take back the tab's last change; None if there is none.

        Raises:
            ConflictError: the episode was changed by somebody else since.
        """
        with self._lock:
            if not self._undo[specification, tab]:
                return None
            self._catch_up(specification)
            episode, before, after_at = self._undo[specification, tab].pop()
            now = self.verdict(specification, episode)
            if now.at != after_at:
                raise ConflictError(f"episode {episode} was changed by {now.by or 'somebody'} since; not undone")
            try:
                return episode, self._write(specification, episode, before)
            except OSError:
                self._undo[specification, tab].append((episode, before, after_at))
                raise

    def _span(self, episode: int) -> slice:
        return slice(int(self.start[episode]), int(self.start[episode] + self.length[episode]))

    def _state(self, specification: str, episode: int) -> tuple[np.ndarray, str | None, int]:
        now = self.verdict(specification, episode)
        return self.labels(specification, episode), now.by, now.at

    def _write(self, specification: str, episode: int, state: tuple) -> Verdict:
        """Set an episode's state and save; on failure, everything is as before."""
        sidecar, before = self._files[specification], self._state(specification, episode)
        self._put(sidecar, episode, state)
        try:
            self._save(specification)
        except BaseException:
            self._put(sidecar, episode, before)
            raise
        return self.verdict(specification, episode)

    def _put(self, sidecar: Sidecar, episode: int, state: tuple[np.ndarray, str | None, int | None]) -> None:
        failure, by, at = state
        span = self._span(episode)
        if by is not None and by not in sidecar.names:
            sidecar.names.append(by)
        sidecar.failure[span] = failure
        sidecar.by[span] = sidecar.names.index(by) if by is not None else -1
        # A new state has a time of its own even if the clock stands still or was set back.
        sidecar.at[span] = max(time.time_ns() // 1000, int(sidecar.at.max()) + 1) if at is None else at

    def _catch_up(self, specification: str) -> None:
        """Take in what another program wrote into the file meanwhile, in spite of the lock; the later verdict counts.

        Raises:
            OSError: what it wrote cannot be read; nothing is overwritten.
        """
        path = self._paths[specification]
        mark = _mark(path)
        if mark in (None, self._known[specification]):
            return
        try:
            written = Sidecar.read(path, self.content, self.repo_id)
        except LabelFileError as e:
            raise OSError(f"another program wrote to {path} meanwhile, and the label was not saved: {e}") from e
        logger.warning("another program wrote to %s meanwhile; its labels and these are kept, the later ones", path)
        self._files[specification] = self._files[specification].updated(written)
        self._known[specification] = mark

    def _save(self, specification: str) -> None:
        self._write_file(specification, self._files[specification])

    def _write_file(self, specification: str, labels: Sidecar) -> None:
        path = self._paths[specification]
        labels.write(path, self.repo_id, self.content)
        self._known[specification] = _mark(path)


def own_folder(folder: Path, root: Path) -> FileLock:
    """Make a folder for labels, keep other processes out, and prove that it can be written.

    Nothing in it is touched while another process has it.

    Raises:
        OSError: another process has it, or it cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / ".lock")
        lock.acquire(timeout=0)
    except Timeout:
        raise OSError(
            f"another process is labelling {root} already; close it, or use its page in another tab"
        ) from None
    except OSError as e:
        raise OSError(_cannot_write(folder, e)) from e
    try:
        for torn in folder.glob(".*.partial"):
            torn.unlink()
        probe = folder / ".probe"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as e:
        lock.release()
        raise OSError(_cannot_write(folder, e)) from e
    return lock


def _mark(path: Path) -> tuple[int, ...] | None:
    """What tells a file from the one that replaced it; None: there is none."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns


def _cannot_write(folder: Path, error: OSError) -> str:
    return (
        f"cannot write labels to {folder} ({error.strerror or error}); make it writable, or copy the dataset to a "
        "folder of your own. Nothing was changed"
    )


def _keep_aside(path: Path) -> Path:
    """A copy of a label file under a name that tells its content, such as failure.1f2e3d4c.parquet."""
    content = path.read_bytes()
    aside = path.with_name(f"{path.stem}.{hashlib.sha256(content).hexdigest()[:8]}{path.suffix}")
    with replacing(aside) as partial:
        partial.write_bytes(content)
    return aside


def first_failing(failure: np.ndarray) -> int | None:
    """First failing frame of labels (T,); T if all are safe; None if unlabelled or not "safe, then failing"."""
    first = int((failure == SAFE).sum())
    ordered = (failure[:first] == SAFE).all() and (failure[first:] == FAILING).all()
    return first if ordered else None


def in_words(first: int | None, length: int) -> str:
    """A verdict on an episode of so many frames."""
    if first is None:
        return "mixed labels"
    return "never fails" if first == length else f"fails from frame {first}"
