"""Throughput of two ranks against one, each on a single thread and with a batch of the same size a rank.

    world_model     gradient steps on clips from a token cache, with DistributedDataParallel as LeRobot sets it up
    reachability    `refresh` updates of the critic and the imagination of a part of its pool, as in
                    `latentsafe train-reachability`; two ranks have a batch and a pool of twice the size. With the
                    batch of the configuration, and with one of 2048 states a rank: an update is over in a few
                    milliseconds, and gradients must travel after each

Three teams wait in processes of their own and work in turn: one process alone; two ranks of gloo; and, as the ceiling
that this machine sets (shared caches, memory and clock), two processes that know nothing of each other. What counts is
wall time, so run it on a machine that does nothing else; the load before the run is noted. `fastest` compares the
fastest rounds, which others on the machine have disturbed least.

    OMP_NUM_THREADS=1 python scripts/bench_ranks.py --policy=data/margin_gru_0 --cache=data/held_branches_tokens \\
        --json=results/bag/bench_ranks.json
"""

import argparse
import os
import socket
import statistics
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch.nn.parallel import DistributedDataParallel

from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.reachability import LatentReachability
from lerobot_latentsafe.runtime import distributed
from lerobot_latentsafe.runtime.malloc import keep_freed_memory
from lerobot_latentsafe.training import encoded_starts, load_with_cache

TASKS = ("world_model", "reachability", "reachability_2048")
TEAMS = {"one": 1, "two": 2, "two_alone": 2}
"""Team -> its processes."""


def training_steps(args: argparse.Namespace) -> Callable[[], int]:
    """Some gradient steps of the world model; returns the clips that all ranks learned from."""
    policy, policy.reader = load_with_cache(args.policy, metadata(args))
    policy.train()
    distributed = distributed.world_size() > 1
    model = DistributedDataParallel(policy, find_unused_parameters=True) if distributed else policy
    optimizer = torch.optim.Adam(policy.get_optim_params(), 1e-4, fused=True)
    n = len(policy.reader.labels.failure)

    def work() -> int:
        for _ in range(args.steps):
            loss, _ = model({"index": torch.randint(n, (args.batch,))})
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
            optimizer.step()
        return args.steps * args.batch * distributed.world_size()

    return work


def reachability_steps(args: argparse.Namespace, batch_size: int | None = None) -> Callable[[], int]:
    """Updates of the critic, imagining anew a part of its pool; returns the states that all ranks backed up.

    Args:
        batch_size: of a rank; None takes the configuration's.
    """
    policy, reader = load_with_cache(args.policy, metadata(args))
    config = policy.config.reachability
    config.batch_size = (batch_size or config.batch_size) * distributed.world_size()
    config.pool = config.kept * 1024 * distributed.world_size()  # a chunk of 1024 starts a rank
    generator = torch.Generator().manual_seed(0)
    starts = encoded_starts(policy, reader, generator, max_frames=5000)
    learner = LatentReachability(policy.imagination, policy.critic, starts, config, generator)

    def work() -> int:
        for _ in range(config.refresh):
            learner.update()
        return config.refresh * config.batch_size

    return work


def metadata(args: argparse.Namespace) -> LeRobotDatasetMetadata:
    return LeRobotDatasetMetadata("local/cache", root=args.cache)


def process(orders: Connection, args: argparse.Namespace, team: str, rank: int, port: int) -> None:
    """Set up, then do a round of a task whenever its name is heard, and say how much was done."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    keep_freed_memory()
    if team == "two":
        dist.init_process_group("gloo", init_method=f"tcp://127.0.0.1:{port}", rank=rank, world_size=2)
    work = (training_steps(args), reachability_steps(args), reachability_steps(args, 2048))
    tasks = dict(zip(TASKS, work))
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


def spread(values: list[float]) -> dict[str, float]:
    return {"median": statistics.median(values), "low": min(values), "high": max(values)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", type=Path, required=True, help="a filter with a trained gru world model")
    parser.add_argument("--cache", type=Path, required=True, help="a token cache that fits it")
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--steps", type=int, default=20, help="gradient steps of the world model a round")
    parser.add_argument("--batch", type=int, default=96, help="clips a rank and step")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    load = os.getloadavg()[0]
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    teams: dict[str, list[Connection]] = {}
    context = mp.get_context("spawn")
    for team, size in TEAMS.items():
        teams[team] = []
        for rank in range(size):
            ours, theirs = context.Pipe()
            context.Process(target=process, args=(theirs, args, team, rank, port), daemon=True).start()
            teams[team].append(ours)
    for team in teams.values():
        for orders in team:
            orders.recv()  # ready
    rates: dict[str, dict[str, list[float]]] = {task: {team: [] for team in TEAMS} for task in TASKS}
    for _ in range(args.rounds + 1):
        for task in TASKS:
            for team, processes in teams.items():
                rates[task][team].append(throughput(processes, task) * (2 if team == "two_alone" else 1))
    for team in teams.values():
        for orders in team:
            orders.send(None)
    row = {
        "what": "clips (world model) or backed-up states (reachability) a second of wall time, and ratios to one rank",
        "rounds": args.rounds,
        "threads_a_rank": 1,
        "load_before": load,
    }
    for task in TASKS:
        rate = {team: values[1:] for team, values in rates[task].items()}  # the first round warms up
        for team in ("two", "two_alone"):
            ratios = spread([a / b for a, b in zip(rate[team], rate["one"])])
            row[f"{task}_{team}_over_one"] = {**ratios, "fastest": max(rate[team]) / max(rate["one"])}
            print(f"{task:17s} {team:10s}", *(f"{k} {v:.2f}" for k, v in row[f"{task}_{team}_over_one"].items()))
        row[f"{task}_a_second"] = {team: spread(values) for team, values in rate.items()}
    if args.json:
        write_json(args.json, {**row, "torch": torch.__version__, **provenance([0])})


if __name__ == "__main__":
    main()
