"""How early a filter of the blocks warns, and how often it warns of nothing, by its threshold."""

from pathlib import Path

import numpy as np

from lerobot_latentsafe.evaluation.statistics import provenance, run_resumable, wilson, write_json
from lerobot_latentsafe.experiments.blocks.study import lead, run, world_model_of
from lerobot_latentsafe.experiments.filter_settings import fingerprint

FIRST_SEED = 400_000
"""Of the starts, those of Table 2."""
EPSILONS = (0.0, 0.2, 0.4, 0.6)
VALUES = {"value": "of what is seen", "foreseen": "of the proposal, as the law reads it"}
"""Columns of `run` -> which V they hold."""


def warnings_of(rows: list[dict], column: str, epsilon: float) -> dict:
    """Lead of a V over l in failing runs, and how many of the others it falls in nevertheless.

    Args:
        rows: of `run`, looked on at.
        column: of `VALUES`.

    Returns:
        median, quartiles and share_of_3_or_more of the leads in steps, n of them; false_alarms {k, n, low, high}, or
        None where all runs fail.
    """
    failing, fine = ([row for row in rows if row["violation"] == failed] for failed in (True, False))
    leads = [lead(np.array(row["margin"]), np.array(row[column]), epsilon) for row in failing]
    found = np.array([steps for steps in leads if steps is not None])
    alarms = sum(bool((np.array(row[column]) <= epsilon).any()) for row in fine)
    row: dict = {"n": len(found), "false_alarms": wilson(alarms, len(fine)) if fine else None}
    if len(found):
        row |= {"median": float(np.median(found)), "quartiles": np.quantile(found, (0.25, 0.75)).tolist()}
        row |= {"share_of_3_or_more": float((found >= 3).mean())}
    return row


def watch(dreamer: str, filter: str, n: int, output: Path, workers: int = 1) -> None:
    """Run a task policy while a filter looks on, and write how early it warns.

    Args:
        dreamer, filter: paths of the task policy and of the filter.
        n: starts.
        output: the table; the file of finished episodes is beside it.
    """
    made_of = [fingerprint(path) for path in (dreamer, world_model_of(dreamer), filter)]
    job = {"dreamer": dreamer, "filter": filter, "mode": "monitor", "epsilon": EPSILONS[0], "made_of": made_of}
    seeds = range(FIRST_SEED, FIRST_SEED + n)
    rows = run_resumable(output.with_suffix(".jsonl"), [{**job, "seed": seed} for seed in seeds], run, workers)
    table = {
        name: {"is": meaning, "warnings": {f"{epsilon:g}": warnings_of(rows, name, epsilon) for epsilon in EPSILONS}}
        for name, meaning in VALUES.items()
    }
    minutes = sum(row["cpu_s"] for row in rows) / 60
    write_json(output, {"filter": filter, "policy": dreamer, **table, **provenance([seeds[0], seeds[-1]], minutes)})
    for name in VALUES:
        for epsilon in EPSILONS:
            row = warnings_of(rows, name, epsilon)
            alarms = row["false_alarms"] or {"k": 0, "n": 0}
            print(f"{name:9} {epsilon:4} median {row.get('median')}  false alarms {alarms['k']} of {alarms['n']}")
