#!/usr/bin/env python
"""A tick of several filters in turn, on the same recorded frames: CPU milliseconds of one thread.

    OMP_NUM_THREADS=1 scripts/bench_filters.py --filters gru=bag dino_wm=outputs/bag/final_0 --root=data/bag_lifts

Writes results/bag/bench_filters.json; the ratios are to the first filter, of medians and 99th percentiles.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_latentsafe.encoders.perception import Perception
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.guard_study import observations, recorded
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.shield import Shield

QUANTILES = {"median": 0.5, "p99": 0.99}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--filters", nargs="+", required=True, metavar="NAME=PATH")
    parser.add_argument("--root", type=Path, required=True, help="a recording")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--output", type=Path, default=Path("results/bag/bench_filters.json"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    paths = dict(pair.split("=", 1) for pair in given.filters)
    shields = {name: Shield(load_filter(path).model, clock=standing_still) for name, path in paths.items()}
    cameras = next(iter(shields.values())).model.world_model.image_keys
    took: dict[str, list[float]] = {name: [] for name in shields}
    meta = LeRobotDatasetMetadata("local/recorded", root=given.root)
    for episode in recorded(meta, list(range(given.episodes)), cameras):
        for shield in shields.values():
            shield.reset()
        for seen, action in zip(observations(episode), episode.action[:, None]):
            for name, shield in shields.items():
                Perception.forget()  # or the second filter would look at the tokens of the first
                began = time.thread_time()
                shield(seen, action)
                took[name].append(1e3 * (time.thread_time() - began))
    rows = {
        name: {q: float(np.quantile(times, share)) for q, share in QUANTILES.items()} for name, times in took.items()
    }
    first = next(iter(rows.values()))
    ratios = {name: {q: row[q] / first[q] for q in QUANTILES} for name, row in rows.items()}
    print(rows, ratios)
    write_json(given.output, {"milliseconds": rows, "to_the_first": ratios, **provenance(seeds=[])})


if __name__ == "__main__":
    main()
