"""Recording in parts: a run that was killed goes on with those that are missing, and never leaves a broken dataset.

Each part is a finished dataset of some episodes in `<root>.parts`, recorded by one process or several, or by tasks on
several computers. At the end they are put together.
"""

import errno
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from threading import Thread

from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tqdm import tqdm

from lerobot_latentsafe.collection.quiet import quiet_recording
from lerobot_latentsafe.runtime.files import (
    claim,
    differing,
    discard,
    locked_folder,
    refuse_filled,
    replacing_folder,
)
from lerobot_latentsafe.runtime.options import require_at_least
from lerobot_latentsafe.runtime.tasks import OPTIONS, Job, Tasks, require_seen, share

LITTLE = 2**23
"""Bytes left on a disk on which nothing can be recorded any more."""

Record = Callable[[range, Path], Iterator[None]]
"""Writes the dataset of some episodes into a folder, which it makes; yields after each episode."""
Tell = Callable[[None], None]
"""Hears of each episode that is recorded."""


def record_in_parts(
    repo_id: str, root: str | Path, options: dict, n_episodes: int, record: Record, at_once: int, workers: int = 1,
    tasks: Tasks | None = None,
) -> LeRobotDataset | None:  # fmt: skip
    """Record a dataset, or go on recording it.

    Args:
        options: all that an episode depends on, beside its number.
        record: picklable, if there are several workers, or tasks.
        at_once: episodes of a part, at most; fewer, if workers or tasks would have nothing to do.
        workers: processes that record.
        tasks: who records, instead of these.

    Returns:
        The dataset; None if it was handed to a cluster, whose last task puts it together.

    Raises:
        ValueError: no episodes, no workers, fewer episodes than tasks, or an unfinished recording with other options.
        FileExistsError: root holds something else.
        FolderInUseError: another process records it.
        TasksFailedError: some tasks failed; the parts of the others stay.
        ImportError, OSError: the tasks cannot be run so; see `Tasks.require_executor`.
    """
    require_at_least("--dataset.num_episodes", n_episodes, 1)
    require_at_least("--workers", workers, 1)
    cut = tasks is not None and tasks.number is not None
    if cut:
        _require_tasks(tasks, n_episodes, workers)
    recording = Recording(repo_id, Path(root).absolute(), options, n_episodes, record)
    with locked_folder(recording.parts):  # not root, which a cluster's last task writes
        if recording.is_finished():
            discard(recording.parts)
            return recording.dataset()
        refuse_filled(recording.root, "--dataset.root")
        claim(recording.parts / OPTIONS, options)
        n_tasks = tasks.number if cut else workers
        missing = list(_missing(recording.parts, n_episodes, min(at_once, -(-n_episodes // n_tasks))))
        if cut:
            return tasks.run(recording.job(share(missing, n_tasks)))
        _record_all(partial(_record_part, record, recording.parts), missing, workers)
        return recording.finish()


def _require_tasks(tasks: Tasks, n_episodes: int, workers: int) -> None:
    tasks.require_executor()
    tasks.require_work(n_episodes, "episodes")
    if workers != 1:
        raise ValueError(f"--workers is {workers}, and --tasks.number is given; give --tasks.workers instead")


@dataclass(frozen=True)
class Recording:
    """A dataset that is recorded in parts: all that a computer needs to know to record one. It is pickled for tasks.

    Attributes:
        root: the folder to write.
        options, n_episodes, record: see `record_in_parts`.
    """

    repo_id: str
    root: Path
    options: dict
    n_episodes: int
    record: Record

    @property
    def parts(self) -> Path:
        """The folder of the parts."""
        return self.root.with_name(f"{self.root.name}.parts")

    def dataset(self) -> LeRobotDataset:
        """What was recorded."""
        return LeRobotDataset(self.repo_id, root=self.root)

    def is_finished(self) -> bool:
        """Whether all was put together, and the process was killed before it had removed the parts."""
        if not self.root.exists() or not (self.parts / OPTIONS).exists():
            return False
        if differing(self.parts / OPTIONS, self.options) or not (self.root / "meta").exists():
            return False
        return LeRobotDatasetMetadata(self.repo_id, root=self.root).total_episodes == self.n_episodes

    def job(self, missing: Sequence[Sequence[range]]) -> Job:
        """Tasks that record what is missing, each some parts."""
        logs = self.root.with_name(f"{self.root.name}.tasks")
        return Job("parts", partial(self.work, missing), partial(self.is_done, missing), self.finish, logs)

    def work(self, missing: Sequence[Sequence[range]], task: int) -> None:
        """Record the parts of a task that are not there.

        Raises:
            UnseenFolderError: this computer does not see what was begun.
            OSError: the disk is full.
        """
        require_seen(self.parts / OPTIONS, "--dataset.root")
        quiet_recording()
        for part in missing[task]:
            if not _folder(self.parts, part).exists():
                for _ in _record_part(self.record, self.parts, part):
                    pass

    def is_done(self, missing: Sequence[Sequence[range]], task: int) -> bool:
        """Whether all parts of a task are there."""
        return all(_folder(self.parts, part).exists() for part in missing[task])

    def finish(self) -> LeRobotDataset:
        """Put the parts together, and remove them.

        Raises:
            UnseenFolderError: some are not there.
            FileExistsError: root holds something else.
        """
        for part in _missing(self.parts, self.n_episodes, self.n_episodes):
            require_seen(_folder(self.parts, part), "--dataset.root")
        with replacing_folder(self.root, "--dataset.root") as whole:
            folders = [_folder(self.parts, part) for part in _kept(self.parts, self.n_episodes)]
            _put_together(self.repo_id, folders, whole)
        discard(self.parts)
        return self.dataset()


def _record_all(record: Callable[[range], Iterator[None]], missing: list[range], workers: int) -> None:
    with tqdm(desc="collecting", total=sum(map(len, missing)), unit="episode") as progress:
        if workers > 1:
            return _record_side_by_side(record, missing, workers, progress)
        for episodes in missing:
            for _ in record(episodes):
                progress.update()


def _record_side_by_side(
    record: Callable[[range], Iterator[None]], missing: list[range], workers: int, progress: tqdm
) -> None:
    # Spawned: a process that was forked cannot draw.
    context = get_context("spawn")
    recorded = context.SimpleQueue()
    counting = Thread(target=lambda: [progress.update() for _ in iter(recorded.get, OVER)])
    with context.Pool(workers, _begin_work, (recorded.put,)) as pool:
        counting.start()
        try:
            for _ in pool.imap(partial(_told, record), missing):
                pass
        finally:
            recorded.put(OVER)
            counting.join()


OVER = "over"
_tell: Tell | None = None
"""How a worker says that an episode is recorded."""


def _begin_work(tell: Tell) -> None:
    global _tell
    _tell = tell
    quiet_recording()


def _told(record: Callable[[range], Iterator[None]], episodes: range) -> None:
    for recorded in record(episodes):
        _tell(recorded)


def _record_part(record: Record, parts: Path, episodes: range) -> Iterator[None]:
    with replacing_folder(_folder(parts, episodes)) as part:
        try:
            yield from record(episodes, part)
        except OSError as e:
            if shutil.disk_usage(parts).free > LITTLE:
                raise
            raise OSError(
                errno.ENOSPC, f"the disk of {parts} is full; finished parts are kept. Make room and start again"
            ) from e


def _folder(parts: Path, episodes: range) -> Path:
    return parts / f"{episodes.start:06d}_{episodes.stop:06d}"


def _kept(parts: Path, n_episodes: int) -> Iterator[range]:
    """Episodes of the finished parts, in order and each once."""
    done = 0
    for folder in sorted(parts.glob("??????_??????")):
        start, stop = map(int, folder.name.split("_"))
        if done <= start < stop <= n_episodes:
            yield range(start, stop)
            done = stop


def _missing(parts: Path, n_episodes: int, size: int) -> Iterator[range]:
    """What is to be recorded, in parts of this size at most."""
    done = 0
    for kept in (*_kept(parts, n_episodes), range(n_episodes, n_episodes)):
        for start in range(done, kept.start, size):
            yield range(start, min(start + size, kept.start))
        done = kept.stop


def _put_together(repo_id: str, folders: list[Path], whole: Path) -> None:
    if len(folders) == 1:
        shutil.copytree(folders[0], whole)
        return
    # Pictures in a table would be read and written again for each part that follows.
    pictures = bool(LeRobotDatasetMetadata(repo_id, root=folders[0]).image_keys)
    aggregate_datasets([repo_id] * len(folders), repo_id, roots=folders, aggr_root=whole, concatenate_data=not pictures)
