"""Tasks by datatrove's executors. Whoever imports this needs datatrove; `tasks.py` says so in time."""

import inspect
import io
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import redirect_stderr
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from pathlib import Path
from threading import Thread
from typing import Any

from datatrove.executor import LocalPipelineExecutor, RayPipelineExecutor, SlurmPipelineExecutor
from loguru import logger
from tqdm import tqdm

from lerobot_latentsafe.runtime.files import discard
from lerobot_latentsafe.runtime.tasks import Job, TasksFailedError

CLUSTERS = {"slurm": SlurmPipelineExecutor, "ray": RayPipelineExecutor}
OURS = {"self", "pipeline", "tasks", "workers", "logging_dir", "skip_completed", "depends", "job_name"}
"""Options of these executors that are not a user's to give."""
SHOWN = 3
"""Failed tasks that are named."""


@dataclass(frozen=True)
class Step:
    """A step of datatrove's pipeline that does a task of a job."""

    job: Job

    def __call__(self, data: Any, rank: int, world_size: int) -> None:
        self.job.work(rank)


@dataclass(frozen=True)
class Last:
    """A step of datatrove's pipeline that finishes a job."""

    job: Job

    def __call__(self, data: Any, rank: int, world_size: int) -> None:
        self.job.finish()


def check_options(executor: str, options: dict[str, Any]) -> None:
    """Refuse options that an executor does not have, or lacks.

    Raises:
        ValueError: naming those that it has.
    """
    if executor not in CLUSTERS:
        return
    known = {n: p for n, p in inspect.signature(CLUSTERS[executor].__init__).parameters.items() if n not in OURS}
    if strange := [name for name in options if name not in known]:
        raise ValueError(f"--tasks.options has {', '.join(strange)}; those of {executor} are {', '.join(known)}")
    needed = [name for name, p in known.items() if p.default is p.empty and name not in options]
    if needed:
        raise ValueError(f"--tasks.options lacks {', '.join(needed)}, which {executor} needs")


def run_here(job: Job, number: int, workers: int, options: dict[str, Any]) -> Any:
    """Do a job's tasks in processes of this machine, or with one worker in this process; then finish it."""
    _forget_undone(job, number)
    executor = LocalPipelineExecutor([Step(job)], number, workers, str(job.logs))
    missing = executor.get_incomplete_ranks()
    failed: dict[int, BaseException] = {}
    with tqdm(desc=job.name, total=number, initial=number - len(missing), unit="task") as progress:
        for task, error in _alone(executor, missing) if workers == 1 else _together(executor, missing, workers):
            progress.update(error is None)
            if error is not None:
                failed[task] = error
    if failed:
        _refuse(failed, number, job.logs)
    made = job.finish()
    discard(job.logs)
    return made


def run_on_cluster(executor: type, job: Job, number: int, workers: int, options: dict[str, Any]) -> Any:
    """Hand a job's tasks to Slurm, with a last one that finishes it; or have Ray do them, and finish it."""
    _forget_undone(job, number)
    if executor is RayPipelineExecutor:
        RayPipelineExecutor([Step(job)], number, workers, logging_dir=str(job.logs), **options).run()
        return job.finish()
    activate = Path(sys.prefix) / "bin" / "activate"
    given = {"qos": "", **({"venv_path": str(activate)} if activate.exists() else {}), **options}
    first = SlurmPipelineExecutor(
        [Step(job)], number, workers=workers, job_name=job.name, logging_dir=str(job.logs), **given
    )
    (job.logs / "last" / "completions" / "00000").unlink(missing_ok=True)
    SlurmPipelineExecutor(
        [Last(job)], 1, job_name=f"{job.name}_last", logging_dir=str(job.logs / "last"), depends=first, **given
    ).run()
    return None


EXECUTE: dict[str, Callable[[Job, int, int, dict[str, Any]], Any]] = {
    "local": run_here,
    "slurm": lambda *given: run_on_cluster(SlurmPipelineExecutor, *given),
    "ray": lambda *given: run_on_cluster(RayPipelineExecutor, *given),
}


def _forget_undone(job: Job, number: int) -> None:
    """Remove datatrove's marks of tasks whose result is not there any more."""
    job.logs.mkdir(parents=True, exist_ok=True)
    for task in range(number):
        if not job.done(task):
            (job.logs / "completions" / f"{task:05d}").unlink(missing_ok=True)


Ended = tuple[int, BaseException | None]
"""A task's number, and what it raised."""


def _alone(executor: LocalPipelineExecutor, missing: list[int]) -> Iterator[Ended]:
    for task in missing:
        yield task, _error_of(executor, task)


def _together(executor: LocalPipelineExecutor, missing: list[int], workers: int) -> Iterator[Ended]:
    """datatrove's own pool waits forever for a worker that was killed; this one tells."""
    cores = max(1, (os.cpu_count() or 1) // workers)
    with ProcessPoolExecutor(workers, get_context("spawn"), _begin_work, (cores,)) as pool:
        running: dict[Future, int] = {pool.submit(_error_of, executor, task): task for task in missing}
        for future in as_completed(running):
            try:
                yield running[future], future.result()
            except BrokenProcessPool as e:
                yield running[future], e


def _error_of(executor: LocalPipelineExecutor, task: int) -> Exception | None:
    """What a task raises; its log goes to a file alone."""
    logger.remove()
    try:
        with redirect_stderr(io.StringIO()):
            executor._run_for_rank(task, local_rank=1)
    except Exception as e:
        return e
    finally:
        logger.remove()
    return None


def _begin_work(cores: int) -> None:
    """Be a worker: take a share of the cores, and end with the process that started it, however that ends."""
    os.environ.setdefault("OMP_NUM_THREADS", str(cores))
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    wait([parent_process().sentinel])
    os._exit(1)


def _refuse(failed: dict[int, BaseException], number: int, logs: Path) -> None:
    killed = all(isinstance(error, BrokenProcessPool) for error in failed.values())
    why = "a worker was killed; was there too little memory?" if killed else ""
    some = [f"task {task}: {error}" for task, error in failed.items() if not isinstance(error, BrokenProcessPool)]
    raise TasksFailedError(
        f"{len(failed)} of {number} tasks failed, the others are done and stay: {why or '; '.join(some[:SHOWN])}. Logs "
        f"are in {logs / 'logs'}. The same command does what is missing"
    ) from next(iter(failed.values()))
