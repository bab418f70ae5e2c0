#!/usr/bin/env python
"""A weak and a strong diffusion policy lift the bag, bare and under the same filters, from the same starts.

    scripts/bag_policies.py --weak=bag_diffusion_weak --strong=bag_diffusion_strong --filters <filter> ... --n=100

Writes results/bag/policies.json: for each policy bare, under each filter, and under the laws that the first filter is
compared with, runs that spill, candies lost, success, steps overridden, step of the first override, CPU time of a
decision; and a picture beside it (.png), how many runs spill at least p% of the candies. Each run is kept in a .jsonl
beside the output: a killed experiment goes on.
"""

import argparse
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import torch

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.evaluation.statistics import write_json
from lerobot_latentsafe.experiments.bag.runs import (
    FIRST_SEED,
    FilterSetting,
    add_filter_options,
    add_laws,
    as_job,
    drive,
    fingerprint,
    in_short,
    in_use,
    run_cells,
    tabulate,
)
from lerobot_latentsafe.franka.bag import BagScene
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reports.figures import save, severity, write_side_by_side

STEPS = 150
"""Policies take their time: one that learned to correct itself grasps after 4 to 9 s."""

scene = cache(BagScene)


@lru_cache(maxsize=2)
def actor(base: str, setting: FilterSetting | None) -> BasePolicy | LatentSafePolicy:
    """A policy, bare or under a filter."""
    torch.set_num_threads(1)
    return setting.load(base) if setting else BasePolicy(base, "cpu")


def job(base: str, setting: FilterSetting | None) -> dict:
    """All that a run depends on but its seed."""
    return {"steps": STEPS, "base": base, "base_fingerprint": fingerprint(base), "filter": as_job(setting)}


def run(job: dict, frames: list[np.ndarray] | None = None) -> dict:
    """One episode, see `drive`."""
    acting = actor(job["base"], FilterSetting(**job["filter"]) if job["filter"] else None)
    scene().reset(job["seed"])
    torch.manual_seed(job["seed"])  # a diffusion policy samples
    return drive(scene(), acting, frames=frames, steps=STEPS)


def film(name: str, bare: dict, shielded: dict, folder: Path) -> Path:
    """Two runs side by side, driven once more."""
    columns = {}
    for column, one in (("bare", bare), ("shielded", shielded)):
        frames: list[np.ndarray] = []
        columns[column] = (frames, run(one, frames)["intervened"])
    return write_side_by_side(columns, folder / f"{name}_{bare['seed']}.mp4", scene().fps)


def draw(table: dict[str, dict], law: str, path: Path) -> None:
    """How many runs spill at least p%, bare and under the filters of a law together."""
    lost = {}
    for who, cells in table.items():
        lost |= {who: cells["bare"]["lost"], f"{who}, shielded": cells[law]["pooled"]["lost"]}
    save(severity(lost, scene().n_candies), path)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weak", help="policy that learnt from careless demonstrations")
    parser.add_argument("--strong", help="policy that learnt from careful ones")
    add_filter_options(parser, 100)
    add_laws(parser)
    parser.add_argument(
        "--n_videos", type=int, default=0, help="starts to film, bare and under the first law and filter"
    )
    parser.add_argument("--output", type=Path, default=Path("results/bag/policies.json"))
    arguments = parser.parse_args()
    if not (arguments.weak or arguments.strong):
        parser.error("no policy to shield: give --weak, --strong or both")
    return arguments


def main() -> None:
    arguments = parse()
    bases = {name: path for name in ("weak", "strong") if (path := getattr(arguments, name))}
    settings = FilterSetting.all(arguments.filters, arguments.laws, arguments)
    cells = {(who, setting): job(bases[who], setting) for who in bases for setting in (None, *settings)}
    runs, made_by = run_cells(arguments.output, cells, arguments.n, run, arguments.workers)

    n_candies = scene().n_candies
    table = {who: tabulate(runs[who, None], {s: runs[who, s] for s in settings}, n_candies) for who in bases}
    for who, laws in table.items():
        print(f"{who}, bare: {in_short(laws['bare'])}")
        for setting in settings:
            print(f"{who}, {setting.law} of {setting.path}: {in_short(laws[setting.law][setting.path])}")
    draw(table, arguments.laws[0], arguments.output.with_suffix(".png"))
    write_json(arguments.output, {**table, "filters": in_use(settings), **made_by})
    for who in bases:
        for seed in range(FIRST_SEED, FIRST_SEED + arguments.n_videos):
            bare, shielded = ({**cells[who, setting], "seed": seed} for setting in (None, settings[0]))
            print(film(who, bare, shielded, arguments.output.parent / "videos"))


if __name__ == "__main__":
    main()
