"""Unsafe recordings are replayed on bags that the filter never saw: other colours, table, stiffness, weight."""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from lerobot_latentsafe.evaluation.statistics import write_json
from lerobot_latentsafe.experiments.bag.runs import (
    against_bare,
    bag_scene,
    drive,
    in_short,
    load,
    run_cells,
    summary,
    traces,
)
from lerobot_latentsafe.experiments.filter_settings import FilterSetting, as_job, in_use
from lerobot_latentsafe.franka.bag import VARIANTS, Variant
from lerobot_latentsafe.franka.behaviors import Actions, begin
from lerobot_latentsafe.reports.figures import save, value_profiles

SEEN = "red"
UNSEEN = [name for name in VARIANTS if name not in (SEEN, "sealed")]
MECHANICS = {
    "stiffness .05": Variant(stiffness=0.05),
    "stiffness .12": Variant(stiffness=0.12),
    "stiffness .20": Variant(stiffness=0.20),
    "stiffness .0075": Variant(stiffness=0.0075),
    "candies of 3 g": Variant(candy_mass=0.003),
    "candies of 4.5 g": Variant(candy_mass=0.0045),
    "friction .2": Variant(friction=0.2),
    "friction .05": Variant(friction=0.05),
}
"""Bags that look like the red one. Of stiffness, weight and friction the first, fifth and seventh lie within what
`bag_varied` shows, the others beyond."""


@lru_cache(maxsize=128)
def recording(seed: int) -> tuple[np.ndarray, ...]:
    """The actions of an unfiltered operator on the bag that the filter knows."""
    red = bag_scene(SEEN)
    actions: list[np.ndarray] = []
    red.reset(seed)
    drive(red, None, _noted(begin("closed_end", red, None, np.random.default_rng([0, seed])), actions))
    return tuple(actions)


def _noted(operator: Actions, actions: list[np.ndarray]) -> Iterator[np.ndarray]:
    for action in operator:
        actions.append(action)
        yield action


def run(job: dict) -> dict:
    """One replay, see `drive`."""
    variant = job["variant"]
    policy, scene = load(FilterSetting.from_job(job["filter"])), bag_scene(MECHANICS.get(variant, variant))
    actions = iter(recording(job["seed"]))
    scene.reset(job["seed"])
    return drive(scene, policy, actions)


def compare_variants(
    settings: list[FilterSetting], n: int, output: Path, workers: int = 1, unseen: Sequence[str] = UNSEEN
) -> None:
    """Replay on the red bag and others, bare and under each filter; write the table and a picture beside it.

    Args:
        settings: filters under one law; the first one's values are drawn.
        n: starts.
        output: of the table, .json.
        unseen: the other bags, of UNSEEN or MECHANICS.
    """
    cells = {
        (variant, setting): {"variant": variant, "filter": as_job(setting)}
        for setting in (None, *settings)
        for variant in (SEEN, *unseen)
    }
    runs, made_by = run_cells(output, cells, n, run, workers)
    table, n_candies, first = {}, bag_scene(SEEN).n_candies, settings[0]
    for variant in (SEEN, *unseen):
        bare, shielded = runs[variant, None], {setting.path: runs[variant, setting] for setting in settings}
        table[variant] = {"bare": summary(bare, n_candies), **against_bare(bare, shielded, n_candies)}
        for name, cell in table[variant].items():
            print(f"{variant}, {name}: {in_short(cell)}")
    panels = {variant: traces(runs[variant, first]) for variant in table}
    save(value_profiles(panels, first.epsilon, bag_scene(SEEN).fps), output.with_suffix(".png"))
    write_json(output, {**table, "law": first.law, "filters": in_use(settings), **made_by})
