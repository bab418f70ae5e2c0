"""Recording in parts: a run that was killed goes on with those that are missing, and never leaves a broken dataset.

Each part is a finished dataset of some episodes in `<root>.parts`, recorded by one process or several. At the end they
are put together.
"""

import errno
import shutil
from collections.abc import Callable, Iterator
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
    replacing_folder,
)
from lerobot_latentsafe.runtime.options import require_at_least

OPTIONS = "options.json"
LITTLE = 2**23
"""Bytes left on a disk on which nothing can be recorded any more."""

Record = Callable[[range, Path], Iterator[None]]
"""Writes the dataset of some episodes into a folder, which it makes; yields after each episode."""
Tell = Callable[[None], None]
"""Hears of each episode that is recorded."""


def record_in_parts(
    repo_id: str, root: str | Path, options: dict, n_episodes: int, record: Record, at_once: int, workers: int = 1
) -> LeRobotDataset:
    """Record a dataset, or go on recording it.

    Args:
        options: all that an episode depends on, beside its number.
        record: picklable, if there are several workers.
        at_once: episodes of a part, at most; fewer, if workers would have nothing to do.
        workers: processes that record.

    Raises:
        ValueError: no episodes, no workers, or an unfinished recording with other options.
        FileExistsError: root holds something else.
        FolderInUseError: another process records it.
    """
    require_at_least("--dataset.num_episodes", n_episodes, 1)
    require_at_least("--workers", workers, 1)
    root = Path(root).absolute()
    parts = root.with_name(f"{root.name}.parts")
    with locked_folder(root):
        if not _is_finished(root, repo_id, n_episodes, parts, options):
            with replacing_folder(root, "--dataset.root") as whole:
                claim(parts / OPTIONS, options)
                missing = list(_missing(parts, n_episodes, min(at_once, -(-n_episodes // workers))))
                _record_all(partial(_record_part, record, parts), missing, workers)
                folders = [_folder(parts, part) for part in _kept(parts, n_episodes)]
                _put_together(repo_id, folders, whole)
        discard(parts)
    return LeRobotDataset(repo_id, root=root)


def _is_finished(root: Path, repo_id: str, n_episodes: int, parts: Path, options: dict) -> bool:
    """Whether all was recorded and put together, and the process was killed before it had removed the parts."""
    if not root.exists() or not (parts / OPTIONS).exists() or differing(parts / OPTIONS, options):
        return False
    return (root / "meta").exists() and LeRobotDatasetMetadata(repo_id, root=root).total_episodes == n_episodes


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
