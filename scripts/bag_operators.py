#!/usr/bin/env python
"""A scripted operator lifts or swings the bag, bare and under filters and their baselines, from the same starts.

    scripts/bag_operators.py --filters <filter> ... --operators closed_end open_end --n=100

Writes results/bag/operators.json: for each operator bare, under each filter, and under the laws that the first one is
compared with, the episodes that spill, the share of candies lost, steps overridden, the step of the first override, the
CPU time of a decision, and of the first law and filter the values of a few episodes step by step; operators.png beside
it draws those. Each run is kept in a .jsonl beside the output: a killed experiment goes on.
"""

import argparse
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import torch

from lerobot_latentsafe.evaluation.statistics import write_json
from lerobot_latentsafe.experiments.bag.runs import (
    FIRST_SEED,
    FilterSetting,
    add_filter_options,
    add_laws,
    as_job,
    drive,
    in_short,
    in_use,
    run_cells,
    tabulate,
    traces,
)
from lerobot_latentsafe.franka.bag import BagScene
from lerobot_latentsafe.franka.behaviors import begin
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reports.figures import save, value_profiles

OPERATORS = {
    "closed_end": ("closed_end", None),
    "open_end": ("open_end", None),
    "middle": ("middle", None),
    "side_to_side_0.04": ("side_to_side", 0.04),
    "side_to_side_0.15": ("side_to_side", 0.15),
    "side_to_side_0.30": ("side_to_side", 0.30),
}

scene = cache(BagScene)


@lru_cache(maxsize=2)
def load(setting: FilterSetting) -> LatentSafePolicy:
    torch.set_num_threads(1)
    return setting.load()


def run(job: dict) -> dict:
    """One episode, see `drive`."""
    behavior, speed = OPERATORS[job["operator"]]
    scene().reset(job["seed"])
    operator = begin(behavior, scene(), speed, np.random.default_rng([0, job["seed"]]))
    return drive(scene(), load(FilterSetting(**job["filter"])) if job["filter"] else None, operator)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_filter_options(parser, 100)
    add_laws(parser)
    parser.add_argument("--operators", nargs="+", choices=OPERATORS, default=list(OPERATORS))
    parser.add_argument("--first_seed", type=int, default=FIRST_SEED, help="smaller ones are for choosing settings")
    parser.add_argument("--output", type=Path, default=Path("results/bag/operators.json"))
    arguments = parser.parse_args()
    settings = FilterSetting.all(arguments.filters, arguments.laws, arguments)
    cells = {
        (who, setting): {"operator": who, "filter": as_job(setting)}
        for who in arguments.operators
        for setting in (None, *settings)
    }
    runs, made_by = run_cells(arguments.output, cells, arguments.n, run, arguments.workers, arguments.first_seed)

    table, first = {}, settings[0]
    for who in arguments.operators:
        table[who] = tabulate(runs[who, None], {s: runs[who, s] for s in settings}, scene().n_candies)
        print(f"{who}, bare: {in_short(table[who]['bare'])}")
        for setting in settings:
            print(f"{who}, {setting.law} of {setting.path}: {in_short(table[who][setting.law][setting.path])}")
        table[who]["traces"] = traces(runs[who, first])
    panels = {who: table[who]["traces"] for who in arguments.operators}
    save(value_profiles(panels, first.epsilon, scene().fps), arguments.output.with_suffix(".png"))
    write_json(arguments.output, {**table, "filters": in_use(settings), **made_by})


if __name__ == "__main__":
    main()
