"""Throughput of two ranks against one, each on a single thread and with a batch of the same size a rank."""

import os
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch.nn.parallel import DistributedDataParallel

from lerobot_latentsafe.evaluation.statistics import provenance
from lerobot_latentsafe.experiments.timing import ratio, spread
from lerobot_latentsafe.reachability import LatentReachability
from lerobot_latentsafe.runtime.distributed import world_size
from lerobot_latentsafe.runtime.malloc import keep_freed_memory
from lerobot_latentsafe.training import encoded_starts, load_with_cache

LOCAL_UPDATES = 8
"""Of ranks that learn apart."""
TEAMS = {"one": 1, "two": 2, "two_alone": 2}
"""Team -> its processes."""


@dataclass(frozen=True)
class Work:
    """What a round is.

    Attributes:
        policy, cache: folders of a filter with a trained world model, and of a token cache that fits it.
        steps: gradient steps of the world model; a multiple of LOCAL_UPDATES.
        batch: clips of a rank and step.
    """

    policy: Path
    cache: Path
    steps: int
    batch: int


def training_steps(work: Work, local_updates: int = 1) -> Callable[[], int]:
    """Some gradient steps of the world model; returns the clips that all ranks learned from.

    Args:
        local_updates: after which ranks average their weights; 1: they average gradients at each.
    """
    policy, reader = load_with_cache(work.policy, metadata(work))
    policy.config.change(local_updates=local_updates)
    policy.reader = reader
    policy.train()
    several = world_size() > 1
    model = DistributedDataParallel(policy, find_unused_parameters=True) if several else policy
    optimizer = torch.optim.Adam(policy.get_optim_params(), 1e-4, fused=True)
    n = len(reader.labels.failure)

    def train() -> int:
        for _ in range(work.steps):
            loss, _ = model({"index": torch.randint(n, (work.batch,))})
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
            optimizer.step()
            policy.update()  # as lerobot-train does
        return work.steps * work.batch * world_size()

    return train


def reachability_steps(work: Work, batch_size: int | None = None, local_updates: int = 1) -> Callable[[], int]:
    """Updates of the critic, imagining anew a part of its pool; returns the states that all ranks backed up.

    Args:
        batch_size: of a rank; None takes the configuration's.
        local_updates: after which ranks average their weights; 1: they sum gradients at each.
    """
    policy, reader = load_with_cache(work.policy, metadata(work))
    model, own = policy.model, policy.config.reachability
    config = replace(
        own,
        batch_size=(batch_size or own.batch_size) * world_size(),
        pool=own.learned_steps * 1024 * world_size(),  # a chunk of 1024 starts a rank
        local_updates=local_updates,
    )
    generator = torch.Generator().manual_seed(0)
    starts = encoded_starts(model, reader, generator, max_frames=5000)
    learner = LatentReachability(model.imagination, model.critic, starts, config, generator)

    def learn() -> int:
        for _ in range(config.refresh):
            learner.update()
        return config.refresh * config.batch_size

    return learn


TASKS: dict[str, Callable[[Work], Callable[[], int]]] = {
    "world_model": training_steps,
    "world_model_apart": partial(training_steps, local_updates=LOCAL_UPDATES),
    "reachability": reachability_steps,
    "reachability_2048": partial(reachability_steps, batch_size=2048),
    "reachability_apart": partial(reachability_steps, local_updates=LOCAL_UPDATES),
}
"""Task -> what prepares it."""


def metadata(work: Work) -> LeRobotDatasetMetadata:
    """Of the cached dataset."""
    return LeRobotDatasetMetadata("local/cache", root=work.cache)


def process(orders: Connection, work: Work, team: str, rank: int, port: int) -> None:
    """Set up, then do a round of a task whenever its name is heard, and say how much was done."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    keep_freed_memory()
    if team == "two":
        dist.init_process_group("gloo", init_method=f"tcp://127.0.0.1:{port}", rank=rank, world_size=2)
    tasks = {task: prepared(work) for task, prepared in TASKS.items()}
    orders.send(0)
    while (task := orders.recv()) is not None:
        orders.send(tasks[task]())


def throughput(team: list[Connection], task: str) -> float:
    """What a team's processes do in a second of wall time."""
    started = time.perf_counter()
    for orders in team:
        orders.send(task)
    done = [orders.recv() for orders in team]
    return done[0] / (time.perf_counter() - started)


def start_teams(work: Work) -> dict[str, list[Connection]]:
    """Wires to the processes of each team, which wait for orders."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    teams: dict[str, list[Connection]] = {}
    context = mp.get_context("spawn")
    for team, size in TEAMS.items():
        teams[team] = []
        for rank in range(size):
            ours, theirs = context.Pipe()
            context.Process(target=process, args=(theirs, work, team, rank, port), daemon=True).start()
            teams[team].append(ours)
    for orders in _all(teams):
        orders.recv()  # ready
    return teams


def _all(teams: dict[str, list[Connection]]) -> list[Connection]:
    return [orders for team in teams.values() for orders in team]


def measure(work: Work, rounds: int) -> dict:
    """Work a second of wall time, and ratios to one rank; the first round warms up."""
    load, teams = os.getloadavg()[0], start_teams(work)
    rates: dict[str, dict[str, list[float]]] = {task: {team: [] for team in TEAMS} for task in TASKS}
    for _ in range(rounds + 1):
        for task in TASKS:
            for team, processes in teams.items():
                rates[task][team].append(throughput(processes, task) * (2 if team == "two_alone" else 1))
    for orders in _all(teams):
        orders.send(None)
    row: dict[str, Any] = {
        "what": "clips (world model) or backed-up states (reachability) a second of wall time, and ratios to one rank",
        "rounds": rounds,
        "threads_a_rank": 1,
        "load_before": load,
    }
    for task in TASKS:
        rate = {team: values[1:] for team, values in rates[task].items()}
        for team in ("two", "two_alone"):
            fastest = max(rate[team]) / max(rate["one"])
            row[f"{task}_{team}_over_one"] = {**ratio(rate[team], rate["one"]), "fastest": fastest}
            print(f"{task:17s} {team:10s}", *(f"{k} {v:.2f}" for k, v in row[f"{task}_{team}_over_one"].items()))
        row[f"{task}_a_second"] = {team: spread(values) for team, values in rate.items()}
    return {**row, "torch": torch.__version__, **provenance([0])}
