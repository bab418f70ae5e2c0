"""What two options of training change: a gradient penalty on the margin, and a hinge on V where recordings succeed.

Each filter is trained anew on one world model, on the same recordings and seed, and shields the same drivers from the
same starts under both laws.
"""

from dataclasses import replace
from itertools import batched
from pathlib import Path
from typing import Any

import torch

from lerobot_latentsafe.datasets.folder import load_metadata
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.evaluation.statistics import provenance, run_resumable, write_json
from lerobot_latentsafe.experiments.assurance import laws
from lerobot_latentsafe.experiments.bag import operators, policies
from lerobot_latentsafe.experiments.filter_settings import FilterSetting, as_job
from lerobot_latentsafe.runtime.hub import save_policy
from lerobot_latentsafe.training import fit_new_margin, frames_of_success, learn_critic, load_with_cache

OPTIONS: dict[str, dict[str, float]] = {
    "as shipped": {},
    "gradient penalty": {"gradient_penalty": 0.1},
    "hinge": {"hinge": 1.0},
    "both": {"gradient_penalty": 0.1, "hinge": 1.0},
}
"""Those that are compared."""
FIRST_SEED = 330_000
"""Of the starts."""


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
        reachability=replace(config.reachability, hinge=hinge),
        frame_cache=None,
    )
    fit_new_margin(policy.model, reader, torch.Generator().manual_seed(seed))
    succeeds = frames_of_success(meta.root, reader) if hinge else None
    learn_critic(policy, reader, seed, None, succeeds=succeeds)
    config.change(law=law)
    save_policy(policy, folder)


def run(job: dict) -> dict:
    """One episode of an operator, or of a policy, under a filter."""
    torch.set_num_threads(1)
    if "operator" in job:
        return laws.outcome(operators.run(job))
    return laws.outcome(policies.run(job))


def jobs_of(filters: dict[str, Path], behaviors: list[str], policy: str | None) -> dict[tuple[str, str, str], dict]:
    """(Who drives, options, law) -> the job of an episode but its seed; bare, and each filter under both laws."""
    settings: dict[tuple[str, str], FilterSetting | None] = {("bare", "bare"): None}
    for name, folder in filters.items():
        settings |= {(name, law): FilterSetting.of(str(folder), LawOptions(name=law)) for law in laws.LAWS}
    jobs: dict[tuple[str, str, str], dict] = {}
    for made, setting in settings.items():
        jobs |= {(who, *made): {"operator": who, "filter": as_job(setting)} for who in behaviors}
        jobs |= {("policy", *made): policies.as_policy_job(policy, setting)} if policy else {}
    return jobs


def study(
    base: str, dataset_root: Path, options: list[str], behaviors: list[str], policy: str | None, n: int, seed: int,
    folder: Path, output: Path, workers: int = 1,
) -> None:  # fmt: skip
    """Train each filter that is missing, drive, and write the table.

    Args:
        base: the filter whose world model and law are used.
        options: names in OPTIONS.
        behaviors: of operators of the bag.
        policy: path of a policy of the bag, or none.
        n: starts of each.
        folder: where filters are kept.
    """
    meta = load_metadata("latentsafe/bag_cache", dataset_root)
    filters = {name: folder / f"{name.replace(' ', '_')}_{seed}" for name in options}
    for name, made in filters.items():
        if not made.exists():
            train(base, meta, OPTIONS[name], seed, made)
    jobs = jobs_of(filters, behaviors, policy)
    every = [{**job, "seed": FIRST_SEED + i} for job in jobs.values() for i in range(n)]
    rows = run_resumable(output.with_suffix(".jsonl"), every, run, workers)
    summary: dict[str, dict] = {}
    for (who, name, law), of in zip(jobs, batched(rows, n)):
        summary.setdefault(who, {}).setdefault(name, {})[law] = laws.cell([*of])
    minutes = sum(row["cpu_s"] for row in rows) / 60
    write_json(output, {"summary": summary, "options": OPTIONS, **provenance([seed], minutes)})
