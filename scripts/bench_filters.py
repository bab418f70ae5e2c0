#!/usr/bin/env python
"""A tick of several filters in turn, on the same recorded frames: CPU milliseconds of one thread.

    OMP_NUM_THREADS=1 scripts/bench_filters.py --filters gru=outputs/gru bag=bag --old=../before --root=data/bag_lifts

Each filter decides episode by episode, with torch and with compiled graphs (law.engine), and by the code of another
checkout if one is given, which has a process of its own. Writes results/bag/bench_filters.json: milliseconds, and their
ratios to the first row, of medians and 99th percentiles.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np

from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.bag.command_line import named_paths

QUANTILES = {"median": 0.5, "p99": 0.99}
WORKER = """
import json, sys, time, torch
from pathlib import Path
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.encoders.perception import Perception
from lerobot_latentsafe.experiments.guard_study import observations, recorded
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.shield import Shield

torch.set_num_threads(1)
rows, root = json.loads(sys.argv[1]), Path(sys.argv[2])
laws = {name: {} if engine == "torch" else {"engine": engine} for name, (_, engine) in rows.items()}
shields = {
    name: Shield(load_filter(path, law=LawOptions(**laws[name])).model, clock=standing_still)
    for name, (path, _) in rows.items()
}
cameras = next(iter(shields.values())).model.world_model.image_keys
meta = LeRobotDatasetMetadata("local/recorded", root=root)
for line in sys.stdin:
    (episode,), said = recorded(meta, [int(line)], cameras), {}
    for name, shield in shields.items():
        shield.reset()
        shield.warm_up()
        took, values = [], []
        for seen, action in zip(observations(episode), episode.action[:, None]):
            Perception.forget()  # or the second filter would look at the tokens of the first
            began = time.thread_time()
            decision = shield(seen, action)
            took.append(1e3 * (time.thread_time() - began))
            values.append([float(decision.value), int(decision.reason)])
        said[name] = took, values
    print(json.dumps(said), flush=True)
"""


class Worker:
    """A process that decides with the code of a checkout.

    Args:
        rows: name -> path of a filter, and engine.
    """

    def __init__(self, checkout: Path, rows: dict[str, tuple[str, str]], root: Path):
        environment = {**os.environ, "PYTHONPATH": str(checkout.resolve()), "OMP_NUM_THREADS": "1"}
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", WORKER, json.dumps(rows), str(root)], env=environment, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip

    def decide(self, episode: int) -> dict[str, tuple[list[float], list[list[float]]]]:
        """Row -> milliseconds, and V and reason, of each tick of an episode."""
        print(episode, file=self.process.stdin, flush=True)
        for line in self.process.stdout:
            if line.startswith("{"):
                return json.loads(line)
        raise RuntimeError(f"the process that was to decide ended ({self.process.wait()}); its error stands above")

    def end(self) -> None:
        """Have it end, and wait for that."""
        self.process.stdin.close()
        self.process.wait()


def differences(values: dict[str, list], filters: list[str]) -> dict[str, dict[str, float]]:
    """How far the decisions of compiled graphs are from torch's: V at most, and how many reasons are others."""
    found = {}
    for name in filters:
        torch_says, graph_says = (np.array(values[f"{name}, {engine}"]) for engine in ("torch", "onnx"))
        apart = np.abs(torch_says[:, 0] - graph_says[:, 0])
        found[name] = {
            "value": float(np.nanmax(apart)), "reasons": int((torch_says[:, 1] != graph_says[:, 1]).sum()),
            "ticks": len(apart),
        }  # fmt: skip
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--filters", nargs="+", required=True, metavar="NAME=PATH")
    parser.add_argument("--root", type=Path, required=True, help="a recording")
    parser.add_argument("--old", type=Path, help="a checkout of the code to compare with")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--output", type=Path, default=Path("results/bag/bench_filters.json"))
    given = parser.parse_args()
    paths = named_paths(parser, "--filters", given.filters)
    own = {f"{name}, {engine}": (path, engine) for name, path in paths.items() for engine in ("torch", "onnx")}
    workers = [Worker(Path(__file__).parents[1], own, given.root)]
    if given.old:
        workers.insert(
            0, Worker(given.old, {f"{name}, before": (path, "torch") for name, path in paths.items()}, given.root)
        )
    took: dict[str, list[float]] = {}
    values: dict[str, list] = {}
    for episode in range(given.episodes):
        for worker in workers:
            for name, (times, said) in worker.decide(episode).items():
                took.setdefault(name, []).extend(times)
                values.setdefault(name, []).extend(said)
    for worker in workers:
        worker.end()
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    rows = {
        name: {q: float(np.quantile(times, share)) for q, share in QUANTILES.items()} for name, times in took.items()
    }
    first = next(iter(rows.values()))
    ratios = {name: {q: row[q] / first[q] for q in QUANTILES} for name, row in rows.items()}
    result = {"milliseconds": rows, "to_the_first": ratios, "onnx_against_torch": differences(values, list(paths))}
    print(json.dumps(result, indent=1))
    write_json(given.output, {**result, **provenance([], (spent.ru_utime + spent.ru_stime) / 60)})


if __name__ == "__main__":
    main()
