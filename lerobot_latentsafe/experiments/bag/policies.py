"""Diffusion policies lift the bag, bare and under the same filters, from the same starts."""

import json
from pathlib import Path

import numpy as np
import torch

from lerobot_latentsafe.evaluation.statistics import write_json
from lerobot_latentsafe.experiments.bag.runs import FIRST_SEED, bag_scene, drive, in_short, load, run_cells, tabulate
from lerobot_latentsafe.experiments.filter_settings import FilterSetting, as_job, fingerprint, in_use
from lerobot_latentsafe.reports.figures import save, severity, write_side_by_side

STEPS, MIXED_STEPS = 150, 225
"""Policies take their time: one that learned to correct itself grasps after 4 to 9 s. The mixed one may grasp twice."""


def as_policy_job(who: str, base: str, setting: FilterSetting | None) -> dict:
    """All that a run depends on but its seed."""
    steps = MIXED_STEPS if who == "mixed" else STEPS
    return {"steps": steps, "base": base, "base_fingerprint": fingerprint(base), "filter": as_job(setting)}


def run(job: dict, frames: list[np.ndarray] | None = None) -> dict:
    """One episode, see `drive`."""
    policy, scene = load(FilterSetting.from_job(job["filter"]), job["base"]), bag_scene()
    scene.reset(job["seed"])
    torch.manual_seed(job["seed"])  # a diffusion policy samples
    return drive(scene, policy, frames=frames, n_steps=job["steps"])


def film(name: str, bare: dict, shielded: dict, folder: Path) -> Path:
    """Two runs side by side, driven once more."""
    columns = {}
    for column, job in (("bare", bare), ("shielded", shielded)):
        frames: list[np.ndarray] = []
        columns[column] = (frames, run(job, frames)["intervened"])
    return write_side_by_side(columns, folder / f"{name}_{bare['seed']}.mp4", bag_scene().fps)


def draw(table: dict[str, dict], law: str, path: Path) -> None:
    """How many runs spill at least p%, bare and under the filters of a law together."""
    lost: dict[str, list[int]] = {}
    for who, cells in table.items():
        lost |= {who: cells["bare"]["lost"], f"{who}, shielded": cells[law]["pooled"]["lost"]}
    save(severity(lost, bag_scene().n_candies), path)


def compare_policies(
    bases: dict[str, str], settings: list[FilterSetting], n: int, output: Path, workers: int = 1, n_videos: int = 0
) -> None:
    """Run each policy bare and under each filter, and write the table, a picture beside it, and videos.

    Policies that the table held before, and that are not run now, stay in it as they are.

    Args:
        bases: `weak`, `strong` or `mixed` -> path of the policy.
        settings: the first one, and its law, are drawn and filmed.
        n: starts.
        output: of the table, .json.
        n_videos: starts to film.
    """
    cells = {(who, setting): as_policy_job(who, bases[who], setting) for who in bases for setting in (None, *settings)}
    runs, made_by = run_cells(output, cells, n, run, workers)
    n_candies = bag_scene().n_candies
    table = {who: tabulate(runs[who, None], {s: runs[who, s] for s in settings}, n_candies) for who in bases}
    for who, laws in table.items():
        print(f"{who}, bare: {in_short(laws['bare'])}")
        for setting in settings:
            print(f"{who}, {setting.law} of {setting.path}: {in_short(laws[setting.law][setting.path])}")
    kept = json.loads(output.read_text()) if output.exists() else {}
    stem = output.stem if {*kept} <= {*bases} else "_".join([output.stem, *bases])
    draw(table, settings[0].law, output.with_name(f"{stem}.png"))
    made_by = {"filters": in_use(settings), **made_by}
    write_json(output, {**made_by, **kept, **{who: {**rows, **made_by} for who, rows in table.items()}})
    for who in bases:
        for seed in range(FIRST_SEED, FIRST_SEED + n_videos):
            bare, shielded = ({**cells[who, setting], "seed": seed} for setting in (None, settings[0]))
            print(film(who, bare, shielded, output.parent / "videos"))
