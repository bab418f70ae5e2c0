"""Work that is cut into tasks: on this machine's cores, or on a cluster's nodes. A task that was done stays done.

Tasks run through datatrove, which LeRobot uses to port its largest datasets. It is an extra: this module loads without.
"""

import importlib
import pickle
import shutil
import socket
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

from lerobot_latentsafe.runtime.files import OtherRunError, claim, differing, discard, locked_folder, replacing
from lerobot_latentsafe.runtime.options import require_at_least

EXECUTORS = ("local", "slurm", "ray")
INSTALL = "pip install 'lerobot_policy_latentsafe[cluster]'"
OPTIONS = "options.json"
"""In a folder of what tasks have finished: what that is of."""


class TasksFailedError(RuntimeError):
    """Some tasks failed; the others are done."""


class UnseenFolderError(OSError):
    """A computer does not see what another one has written."""


@dataclass(frozen=True)
class Job:
    """What is cut into tasks. All of it is pickled, and nodes see the same folders.

    Attributes:
        name: a word for it.
        work: does a task, given its number; it does nothing if that is done.
        done: tells whether a task is done.
        finish: what is done once all tasks are; what it returns is not None.
        logs: folder for logs, on the disk that nodes share.
    """

    name: str
    work: Callable[[int], None]
    done: Callable[[int], bool]
    finish: Callable[[], Any]
    logs: Path


@dataclass
class Tasks:
    """How work is cut into tasks, and who does them."""

    number: int | None = None
    """Tasks that the episodes are shared among; by default the work is not cut. It takes the extra `cluster`."""
    workers: int = 1
    """Tasks that run at once."""
    executor: str = "local"
    """Who runs them: local (processes of this machine), slurm, or ray."""
    options: dict[str, Any] = field(default_factory=dict)
    """Of datatrove's executor for Slurm or Ray, by their names there: '{partition: gpu, time: "4:00:00"}'."""

    def __post_init__(self) -> None:
        require_at_least("--tasks.number", self.number, 1)
        require_at_least("--tasks.workers", self.workers, 1)
        if self.executor not in EXECUTORS:
            raise ValueError(f"--tasks.executor is {self.executor!r}; expected {', '.join(EXECUTORS)}")
        if self.number is None and (self.workers, self.executor, self.options) != (1, "local", {}):
            raise ValueError("--tasks.number is not given; say into how many tasks the work is cut, such as 4")
        if self.executor == "local" and self.options:
            raise ValueError(f"--tasks.options is {self.options}; processes of this machine take none, leave it out")

    def require_executor(self) -> None:
        """Refuse an executor that cannot run here, before any work.

        Raises:
            ImportError: datatrove or ray is not installed.
            OSError: this machine cannot submit to Slurm.
            ValueError: options that the executor does not have, or lacks.
        """
        if not find_spec("datatrove"):
            raise ImportError(f"--tasks.number needs datatrove, which is not installed: {INSTALL}")
        if self.executor == "ray" and not find_spec("ray"):
            raise ImportError("--tasks.executor=ray needs ray, which is not installed: pip install ray")
        if self.executor == "slurm" and not shutil.which("sbatch"):
            raise OSError(
                "--tasks.executor=slurm needs sbatch, which is not on this machine's path; start it on the cluster's "
                "login node, or give --tasks.executor=local"
            )
        _executors().check_options(self.executor, self.options)

    def require_work(self, n: int, what: str) -> None:
        """Refuse more tasks than there is work for.

        Args:
            n: of what is shared among tasks; what: its name.

        Raises:
            ValueError: naming both numbers.
        """
        if self.number > n:
            raise ValueError(f"--tasks.number is {self.number}, and there are {n} {what}; give fewer")

    def run(self, job: Job) -> Any:
        """Do what is not done yet.

        Returns:
            What the job's `finish` returns; None: it was submitted, and the last task finishes it.

        Raises:
            TasksFailedError: some tasks failed; the others are done. The same again does those that failed.
        """
        self.require_executor()
        return _executors().EXECUTE[self.executor](job, self.number, self.workers, self.options)


class Pieces[Tool, Result](ABC):
    """Work on many pieces. What comes of each is kept in a file at once, and stays until all is there.

    A piece never depends on the number of tasks, so that what was finished serves another number, too. Subclasses are
    dataclasses; all of it is pickled.

    Attributes:
        name: a word for it.
        output: what is made in the end, on the disk that nodes share. Pieces are kept in `<output>.parts`, logs in
            `<output>.tasks`.
    """

    name: str
    output: Path

    @property
    @abstractmethod
    def numbers(self) -> Sequence[int]:
        """Of the pieces; neighbours are done by one task."""

    @abstractmethod
    def begin(self) -> Tool:
        """Load what the work takes."""

    @abstractmethod
    def made_of(self, tool: Tool) -> dict[str, Any]:
        """All that results depend on, as this computer sees it; JSON-able."""

    @abstractmethod
    def do(self, tool: Tool, numbers: Sequence[int]) -> Iterator[Result]:
        """Results of some pieces, one after the other."""

    @abstractmethod
    def finish(self, results: list[Result]) -> Any:
        """Make the output of the results of all pieces, in their order; what it returns is not None."""

    @property
    def folder(self) -> Path:
        """Where results are kept."""
        return self.output.with_name(f"{self.output.name}.parts")

    def run(self, tasks: Tasks) -> Any:
        """Do what is not done yet.

        Returns:
            What `finish` returns; None: it was submitted, and the last task finishes it.

        Raises:
            TasksFailedError: some tasks failed; what they and the others have finished stays.
            OtherRunError: the folder is of an unfinished run with other options, which are named.
            FolderInUseError: another process does the same.
            ImportError, OSError, ValueError: the tasks cannot be run so; see `Tasks.require_executor`.
        """
        tasks.require_executor()
        with locked_folder(self.folder):
            claim(self.folder / OPTIONS, self.made_of(self.begin()), "remove that folder to begin anew")
            logs = self.output.with_name(f"{self.output.name}.tasks")
            work, is_done = partial(self.work, tasks.number), partial(self.is_done, tasks.number)
            return tasks.run(Job(self.name, work, is_done, self.end, logs))

    def work(self, number: int, task: int) -> None:
        """Do what is missing of one of so many tasks.

        Raises:
            UnseenFolderError, OtherRunError: this computer does not see what others do.
            OSError: the disk is full.
        """
        missing = [piece for piece in share(self.numbers, number)[task] if not self._file(piece).exists()]
        if not missing:
            return
        tool = self.begin()
        self._require_same(tool)
        for piece, result in zip(missing, self.do(tool, missing)):
            with replacing(self._file(piece)) as file:
                file.write_bytes(pickle.dumps(result))

    def is_done(self, number: int, task: int) -> bool:
        """Whether all pieces of a task are there."""
        return all(self._file(piece).exists() for piece in share(self.numbers, number)[task])

    def end(self) -> Any:
        """Finish, and remove the pieces.

        Raises:
            UnseenFolderError: a piece is not there.
        """
        made = self.finish([self._result(piece) for piece in self.numbers])
        discard(self.folder)
        return made

    def _file(self, piece: int) -> Path:
        return self.folder / f"{piece:06d}.pickle"

    def _result(self, piece: int) -> Result:
        file = self._file(piece)
        require_seen(file)
        try:
            return pickle.loads(file.read_bytes())
        except Exception as e:  # pickle raises whatever it meets
            raise ValueError(f"{file} is torn ({e}); remove it: the same command makes it anew") from e

    def _require_same(self, tool: Tool) -> None:
        require_seen(self.folder / OPTIONS)
        if names := differing(self.folder / OPTIONS, self.made_of(tool)):
            raise OtherRunError(
                f"{socket.gethostname()} sees something else than the process that began {self.folder} "
                f"({', '.join(names)}): all computers must see the same files at the same paths"
            )


def share[Item](items: Sequence[Item], number: int) -> list[Sequence[Item]]:
    """Items cut into so many runs of neighbours, some of which may be empty."""
    ends = [len(items) * task // number for task in range(number + 1)]
    return [items[start:end] for start, end in pairwise(ends)]


def require_seen(path: Path, where: str = "folder") -> None:
    """Refuse to go on where a computer does not see what another one has written.

    Args:
        where: the option that names the folder, if one does.

    Raises:
        UnseenFolderError: with the remedy.
    """
    if not path.exists():
        raise UnseenFolderError(
            f"{socket.gethostname()} does not see {path}, which another process has written. All computers must see "
            f"the same {where}: give one on storage that they share"
        )


def _executors() -> Any:
    """The module that loads datatrove."""
    return importlib.import_module("lerobot_latentsafe.runtime.executors")
