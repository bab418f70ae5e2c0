"""A scripted operator lifts or swings the bag, bare and under filters and their baselines, from the same starts."""

from pathlib import Path

import numpy as np

from lerobot_latentsafe.evaluation.statistics import write_json
from lerobot_latentsafe.experiments.bag.runs import (
    FIRST_SEED,
    bag_scene,
    drive,
    in_short,
    load,
    run_cells,
    tabulate,
    traces,
)
from lerobot_latentsafe.experiments.filter_settings import FilterSetting, as_job, in_use
from lerobot_latentsafe.franka.behaviors import begin
from lerobot_latentsafe.reports.figures import save, value_profiles

OPERATORS = {
    "closed_end": ("closed_end", None),
    "open_end": ("open_end", None),
    "middle": ("middle", None),
    "side_to_side_0.04": ("side_to_side", 0.04),
    "side_to_side_0.15": ("side_to_side", 0.15),
    "side_to_side_0.30": ("side_to_side", 0.30),
}
"""Name -> behaviour and its speed, m/s."""


def run(job: dict) -> dict:
    """One episode, see `drive`."""
    (behavior, speed), scene = OPERATORS[job["operator"]], bag_scene()
    scene.reset(job["seed"])
    operator = begin(behavior, scene, speed, np.random.default_rng([0, job["seed"]]))
    return drive(scene, load(FilterSetting.from_job(job["filter"])), operator)


def compare_operators(
    settings: list[FilterSetting], operators: list[str], n: int, output: Path, workers: int = 1,
    first_seed: int = FIRST_SEED,
) -> None:  # fmt: skip
    """Run each operator bare and under each filter, and write the table and a picture beside it.

    Args:
        settings: the first one's values are drawn.
        operators: names in OPERATORS.
        n: starts.
        output: of the table, .json.
    """
    cells = {
        (who, setting): {"operator": who, "filter": as_job(setting)}
        for who in operators
        for setting in (None, *settings)
    }
    runs, made_by = run_cells(output, cells, n, run, workers, first_seed)
    table, first = {}, settings[0]
    for who in operators:
        table[who] = tabulate(runs[who, None], {s: runs[who, s] for s in settings}, bag_scene().n_candies)
        print(f"{who}, bare: {in_short(table[who]['bare'])}")
        for setting in settings:
            print(f"{who}, {setting.law} of {setting.path}: {in_short(table[who][setting.law][setting.path])}")
        table[who]["traces"] = traces(runs[who, first])
    panels = {who: table[who]["traces"] for who in operators}
    save(value_profiles(panels, first.epsilon, bag_scene().fps), output.with_suffix(".png"))
    write_json(output, {**table, "filters": in_use(settings), **made_by})
