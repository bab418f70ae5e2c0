"""Time of a cache in shards: by one process, and by two workers."""

import json
import os
import shutil
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lerobot_latentsafe.datasets.cache_recipes import Tokens
from lerobot_latentsafe.datasets.cache_tasks import ShardedBuild
from lerobot_latentsafe.datasets.frame_cache import FrameCache
from lerobot_latentsafe.encoders.perception import PerceptionConfig
from lerobot_latentsafe.evaluation.statistics import provenance
from lerobot_latentsafe.experiments.timing import ratio, spread
from lerobot_latentsafe.runtime.tasks import Job, Tasks

N_TASKS = 4


@dataclass(frozen=True)
class Timed:
    """A build whose tasks note which process took how many CPU seconds, of those since it began."""

    build: ShardedBuild
    notes: Path

    def make(self, number: int) -> None:
        """Make a shard."""
        began = time.process_time()
        self.build.make(number)
        took = {"process": os.getpid(), "before": began, "cpu_s": time.process_time() - began}
        (self.notes / f"{number}.json").write_text(json.dumps(took))


def run(build: ShardedBuild, workers: int, episodes: list[int]) -> dict[str, float]:
    """Seconds of one build: `wall_s`; `alone_s`, CPU time of what one process does before and after the tasks;
    `tasks_s`, CPU time of all tasks, and of the busiest worker; and of starting a worker."""
    notes = build.output_dir.with_name("notes")
    notes.mkdir()
    wall, cpu = time.perf_counter(), time.process_time()
    build.lay_out(N_TASKS, episodes)
    timed = Timed(build, notes)
    Tasks(N_TASKS, workers).run(Job("cache", timed.make, build.is_made, build.finish, notes.with_name("logs")))
    rows = [json.loads(file.read_text()) for file in notes.glob("*.json")]
    cpu_of = {row["process"]: 0.0 for row in rows}
    for row in rows:
        cpu_of[row["process"]] += row["cpu_s"]
    shutil.rmtree(notes)
    here = time.process_time() - cpu
    return {
        "wall_s": time.perf_counter() - wall,
        "alone_s": here - cpu_of.get(os.getpid(), 0.0),
        "tasks_s": sum(cpu_of.values()),
        "busiest_worker_s": max(cpu_of.values()),
        "worker_start_s": 0.0 if workers == 1 else min(row["before"] for row in rows),
    }


def compare(root: Path, basis_from: Path, scratch: Path, n_episodes: int, rounds: int) -> dict:
    """Both in turn, on the same episodes; what they write is compared."""
    config = PerceptionConfig(encoder="efficientnet_lite0", token_components=0)
    recipe = partial(Tokens, config=config, basis_from=basis_from.absolute())
    found: dict[int, list[dict[str, float]]] = {1: [], 2: []}
    for number in range(rounds):
        arrays = []
        for workers, rows in found.items():
            output_dir = scratch.absolute() / f"{number}_{workers}"
            build = ShardedBuild(f"local/{root.name}", root.absolute(), output_dir, None, recipe)
            rows.append(run(build, workers, list(range(n_episodes))))
            print(workers, rows[-1], flush=True)
            arrays.append({name: np.asarray(a) for name, a in FrameCache.open(output_dir).percepts.items()})
        if not all(np.array_equal(arrays[0][name], arrays[1][name]) for name in arrays[0]):
            raise SystemExit("two workers wrote other tokens than one process")
        for workers in found:
            shutil.rmtree(scratch / f"{number}_{workers}")
    return {
        "episodes": n_episodes,
        "frames": len(arrays[0]["tokens"]),
        "tasks": N_TASKS,
        "rounds": rounds,
        "equal": True,
        "load_average": os.getloadavg()[1],
        "one_process_over_two_workers": _speedups(found[1], found[2]),
        **{f"{workers}_workers": _spreads(rows) for workers, rows in found.items()},
        **provenance([0], cpu_minutes=sum(r["alone_s"] + r["tasks_s"] for rows in found.values() for r in rows) / 60),
    }


def _speedups(one: list[dict[str, float]], two: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """By the clock; and by CPU time, which is what two free cores would show: all of one process over what one process
    does alone and the busiest worker. `with_start` also counts that a worker loads the package."""
    whole = [row["alone_s"] + row["tasks_s"] for row in one]
    shared = [row["alone_s"] + row["busiest_worker_s"] for row in two]
    started = [row["worker_start_s"] + seconds for row, seconds in zip(two, shared)]
    wall = ratio([row["wall_s"] for row in one], [row["wall_s"] for row in two])
    return {
        "wall": wall, "cpu": ratio(whole, shared), "cpu_with_start": ratio(whole, started),
        "cpu_of_tasks": ratio([row["tasks_s"] for row in one], [row["busiest_worker_s"] for row in two]),
    }  # fmt: skip


def _spreads(rows: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    return {name: spread([row[name] for row in rows]) for name in rows[0]}
