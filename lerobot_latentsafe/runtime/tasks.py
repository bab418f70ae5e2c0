"""Work that is cut into tasks: on this machine's cores, or on a cluster's nodes. A task that was done stays done.

Tasks run through datatrove, which LeRobot uses to port its largest datasets. It is an extra: this module loads without.
"""

import importlib
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from lerobot_latentsafe.runtime.options import require_at_least

EXECUTORS = ("local", "slurm", "ray")
INSTALL = "pip install 'lerobot_policy_latentsafe[cluster]'"


class TasksFailedError(RuntimeError):
    """Some tasks failed; the others are done."""


@dataclass(frozen=True)
class Job:
    """What is cut into tasks. All of it is pickled, and nodes see the same folders.

    Attributes:
        name: a word for it.
        work: does a task, given its number; it does nothing if that is done.
        done: tells whether a task is done.
        finish: what is done once all tasks are.
        logs: folder for logs, on the disk that nodes share.
    """

    name: str
    work: Callable[[int], None]
    done: Callable[[int], bool]
    finish: Callable[[], None]
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

    def run(self, job: Job) -> bool:
        """Do what is not done yet.

        Returns:
            Whether all is done; False: it was submitted, and the last task finishes it.

        Raises:
            TasksFailedError: some tasks failed; the others are done. The same again does those that failed.
        """
        self.require_executor()
        return _executors().EXECUTE[self.executor](job, self.number, self.workers, self.options)


def _executors() -> Any:
    """The module that loads datatrove."""
    return importlib.import_module("lerobot_latentsafe.runtime.executors")
