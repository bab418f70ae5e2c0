#!/usr/bin/env python
"""What all checks of a guard cost in a tick: CPU milliseconds of one thread, at the median.

    OMP_NUM_THREADS=1 scripts/bench_checks.py --filter=bag --root=data/bag_lifts

Replays recorded episodes. Every filter averages pictures to its own size, checks or none; that is timed by itself, tick
by tick, and what is left of a tick of law `guard` is the cost of the checks. Writes results/guard/cost.json.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.guard_study import observations, recorded
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.shield import Shield


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--filter", default="bag")
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--output", type=Path, default=Path("results/guard/cost.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    model = load_filter(arguments.filter, law=LawOptions(name="guard")).model
    shield, cameras = Shield(model, clock=standing_still), model.world_model.image_keys
    meta = LeRobotDatasetMetadata("local/recorded", root=arguments.root)
    averaging = timed(model, "images")
    ticks: list[float] = []
    for episode in recorded(meta, list(range(arguments.episodes)), cameras):
        shield.reset()
        for seen, action in zip(observations(episode), episode.action[:, None]):
            averaging.clear()
            began = time.thread_time()
            shield(seen, action)
            ticks.append(time.thread_time() - began - sum(averaging))
    shape = list(model.config.input_features[cameras[0]].shape)
    quantiles = {f"{name}_ms": 1e3 * float(np.quantile(ticks, q)) for name, q in (("median", 0.5), ("p99", 0.99))}
    row = {"filter": arguments.filter, "cameras": len(cameras), "shape": shape, "ticks": len(ticks), **quantiles}
    print(row)
    write_json(arguments.output, {**row, **provenance(seeds=[])})


def timed(holder: object, name: str) -> list[float]:
    """CPU seconds that each call of a method of an object takes from now on."""
    method: Callable = getattr(holder, name)
    took: list[float] = []

    def call(*arguments: object) -> object:
        began = time.thread_time()
        result = method(*arguments)
        took.append(time.thread_time() - began)
        return result

    setattr(holder, name, call)
    return took


if __name__ == "__main__":
    main()
