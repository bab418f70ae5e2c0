#!/usr/bin/env python
"""Unsafe recordings are replayed on bags that the filter never saw: other colours, table, stiffness, weight.

    scripts/bag_out_of_distribution.py --filters <filter> ... --n=50

From each start a careless operator lifts the red bag by its closed end, unfiltered. What they commanded is then
replayed, as it is, on every variant, bare and under each filter. Writes results/bag/out_of_distribution.json: spills,
candies lost, steps overridden, step of the first override; and out_of_distribution.png beside it, V along the first
starts under the first filter. Each run is kept in a .jsonl beside the output: a killed experiment goes on.
"""

import argparse
from collections.abc import Iterator
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import torch

from lerobot_latentsafe.configuration_latentsafe import LAWS
from lerobot_latentsafe.evaluation.statistics import write_json
from lerobot_latentsafe.experiments.bag.runs import (
    FilterSetting,
    add_filter_options,
    against_bare,
    as_job,
    drive,
    in_short,
    in_use,
    run_cells,
    summary,
    traces,
)
from lerobot_latentsafe.franka.bag import VARIANTS, BagScene
from lerobot_latentsafe.franka.behaviors import Actions, begin
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reports.figures import save, value_profiles

SEEN = "red"
UNSEEN = [name for name in VARIANTS if name not in (SEEN, "sealed")]

scene = cache(BagScene)


@lru_cache(maxsize=2)
def load(setting: FilterSetting) -> LatentSafePolicy:
    torch.set_num_threads(1)
    return setting.load()


@lru_cache(maxsize=128)
def recording(seed: int) -> tuple[np.ndarray, ...]:
    """The actions of an unfiltered operator on the bag that the filter knows."""
    red, actions = scene(SEEN), []
    red.reset(seed)
    drive(red, None, _noted(begin("closed_end", red, None, np.random.default_rng([0, seed])), actions))
    return tuple(actions)


def _noted(operator: Actions, actions: list[np.ndarray]) -> Iterator[np.ndarray]:
    for action in operator:
        actions.append(action)
        yield action


def run(job: dict) -> dict:
    """One replay, see `drive`."""
    policy = load(FilterSetting(**job["filter"])) if job["filter"] else None
    actions = iter(recording(job["seed"]))
    scene(job["variant"]).reset(job["seed"])
    return drive(scene(job["variant"]), policy, actions)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_filter_options(parser, 50)
    parser.add_argument("--law", choices=LAWS, default=LAWS[0])
    parser.add_argument("--output", type=Path, default=Path("results/bag/out_of_distribution.json"))
    arguments = parser.parse_args()
    settings = FilterSetting.all(arguments.filters, [arguments.law], arguments)
    cells = {
        (variant, setting): {"variant": variant, "filter": as_job(setting)}
        for setting in (None, *settings)
        for variant in (SEEN, *UNSEEN)
    }
    runs, made_by = run_cells(arguments.output, cells, arguments.n, run, arguments.workers)

    table, n_candies = {}, scene(SEEN).n_candies
    for variant in (SEEN, *UNSEEN):
        bare, shielded = runs[variant, None], {setting.path: runs[variant, setting] for setting in settings}
        table[variant] = {"bare": summary(bare, n_candies), **against_bare(bare, shielded, n_candies)}
        for name, cell in table[variant].items():
            print(f"{variant}, {name}: {in_short(cell)}")
    panels = {variant: traces(runs[variant, settings[0]]) for variant in table}
    save(value_profiles(panels, settings[0].epsilon, scene(SEEN).fps), arguments.output.with_suffix(".png"))
    write_json(arguments.output, {**table, "law": arguments.law, "filters": in_use(settings), **made_by})


if __name__ == "__main__":
    main()
