"""What options of training change: a gradient penalty on the margin, a hinge on V where recordings succeed, and
imagination that goes on as was recorded.

Each filter is trained anew on one world model, on the same recordings and seeds, and shields the same drivers from the
same starts under both laws.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from lerobot.envs.configs import EnvConfig

from lerobot_latentsafe.datasets.folder import load_metadata
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.envs.configuration_envs import LatentSafeDubinsEnv, LatentSafeSO101Env
from lerobot_latentsafe.evaluation.statistics import provenance, run_resumable, write_rows
from lerobot_latentsafe.experiments.assurance import laws
from lerobot_latentsafe.experiments.bag import operators, policies
from lerobot_latentsafe.experiments.filter_settings import FilterSetting, as_job, fingerprint
from lerobot_latentsafe.runtime.hub import save_policy
from lerobot_latentsafe.training import fit_new_margin, frames_of_success, learn_critic, load_with_cache

OPTIONS: dict[str, dict[str, float]] = {
    "as shipped": {},
    "gradient penalty": {"gradient_penalty": 0.1},
    "hinge": {"hinge": 1.0},
    "both": {"gradient_penalty": 0.1, "hinge": 1.0},
    "as recorded": {"recorded": 0.5},
}
"""Those that are compared."""
FIRST_SEED = 330_000
"""Of the starts."""
ENVS: dict[str, type[EnvConfig]] = {"car": LatentSafeDubinsEnv, "so101": LatentSafeSO101Env}
"""Where policies drive side by side. On the bag, operators and policies move one hand."""


class Drivers(NamedTuple):
    """Who is shielded.

    Attributes:
        place: `bag`, or a name in ENVS.
        operators: of the bag, names.
        policies: name -> path.
    """

    place: str
    operators: list[str]
    policies: dict[str, str]


def train(path: str, meta: Any, options: dict[str, float], seed: int, folder: Path) -> None:
    """A margin and a critic on the world model of a filter, under its law.

    Args:
        meta: LeRobotDatasetMetadata of cached recordings.
        options: see OPTIONS.
    """
    policy, reader = load_with_cache(path, meta, seed)
    config = policy.config
    law, hinge = config.law, options.get("hinge", 0.0)
    config.change(
        margin=replace(config.margin, gradient_penalty=options.get("gradient_penalty", 0.0)),
        reachability=replace(config.reachability, hinge=hinge, recorded=options.get("recorded", 0.0)),
        frame_cache=None,
    )
    fit_new_margin(policy.model, reader, torch.Generator().manual_seed(seed))
    succeeds = frames_of_success(meta.root, reader) if hinge else None
    learn_critic(policy, reader, seed, None, succeeds=succeeds)
    config.change(law=law)
    save_policy(policy, folder)


def run(job: dict) -> dict:
    """`episodes` of an operator, or of a policy, under a filter; see `laws.run`."""
    torch.set_num_threads(1)
    if "env" in job:
        setting = FilterSetting.from_job(job["filter"])
        return {"episodes": laws.drive(ENVS[job["env"]](), job["base"], setting, job["n"], job["seed"])}
    return {"episodes": [laws.outcome((operators if "operator" in job else policies).run(job))]}


def jobs_of(settings: list[FilterSetting | None], drivers: Drivers, n: int) -> dict[str, list[dict]]:
    """Who drives -> jobs for n starts under each of these filters, or bare."""
    starts = [{"seed": FIRST_SEED + i} for i in range(n)]
    jobs: dict[str, list[dict]] = {}
    for setting in settings:
        filter = as_job(setting)
        for who in drivers.operators:
            jobs.setdefault(who, []).extend({"operator": who, "filter": filter, **start} for start in starts)
        for who, path in drivers.policies.items():
            if drivers.place == "bag":
                more = [{**policies.as_policy_job(who, path, setting), **start} for start in starts]
            else:
                made_of = {"env": drivers.place, "base": path, "base_fingerprint": fingerprint(path)}
                more = [{**made_of, "filter": filter, "seed": FIRST_SEED, "n": n}]
            jobs.setdefault(who, []).extend(more)
    return jobs


def study(
    base: str, dataset_root: Path, options: list[str], drivers: Drivers, n: int, seeds: list[int], folder: Path,
    output: Path, workers: int = 1,
) -> None:  # fmt: skip
    """Train each filter that is missing, drive, and write the table; what it held of other drivers stays.

    Args:
        base: the filter whose world model and law are used.
        dataset_root: of cached recordings.
        options: names in OPTIONS.
        n: starts of each.
        seeds: of margin and critic; a cell is of all of them.
        folder: where filters are kept.
    """
    meta = load_metadata(f"latentsafe/{drivers.place}_cache", dataset_root)
    cells: dict[tuple[str, str], list[FilterSetting | None]] = {("bare", "bare"): [None]}
    for name in options:
        made = [folder / f"{name.replace(' ', '_')}_{seed}" for seed in seeds]
        for path, seed in zip(made, seeds):
            if not path.exists():
                train(base, meta, OPTIONS[name], seed, path)
        for law in laws.LAWS:
            cells[name, law] = [FilterSetting.of(str(path), LawOptions(name=law)) for path in made]
    jobs = {cell: jobs_of(settings, drivers, n) for cell, settings in cells.items()}
    every = [job for of in jobs.values() for each in of.values() for job in each]
    kept = run_resumable(output.with_suffix(".jsonl"), every, run, workers)
    rows = iter(kept)
    summary: dict[str, dict] = {}
    for (name, law), of in jobs.items():
        for who, each in of.items():
            episodes = [row for _ in each for row in next(rows)["episodes"]]
            summary.setdefault(who, {}).setdefault(name, {})[law] = laws.cell(episodes)
    minutes = sum(row["cpu_s"] for row in kept) / 60
    write_rows(output, summary, provenance(seeds, minutes), options=OPTIONS)
