"""Table 2: the blocks' task policy bare, under SQRL, under the latent safety filter, and under the simulator itself."""

from pathlib import Path
from typing import Any

import numpy as np

from lerobot_latentsafe.evaluation.statistics import paired_p_value, provenance, run_resumable, wilson, write_json
from lerobot_latentsafe.experiments.blocks.figures import leads, trade_off, unsafe_rollout
from lerobot_latentsafe.experiments.blocks.study import lead, run, run_filmed, world_model_of
from lerobot_latentsafe.experiments.filter_settings import fingerprint
from lerobot_latentsafe.franka.scenes import SCENES
from lerobot_latentsafe.reports.figures import save

FIRST_SEED = 400_000
"""Of the table's starts; training and choices use smaller ones."""
CURVE_SEED = 300_000
"""Of the starts on which thresholds are swept."""
EPSILON = 0.4
RISKS = (0.1, 0.05)
EPSILONS = (-0.4, 0.0, 0.2, 0.4, 0.6, 0.8)
RISK_CURVE = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
OUTCOMES = ("success", "violation", "stall", "incompletion")
ENDS = ("held", "leaning")

Rows = list[dict]
"""Of `run`, of one method from all starts."""


def happened(rows: Rows, outcome: str) -> np.ndarray:
    """bool (n,). These episodes end only when their time is up, so an incompletion, the older name, is a stall."""
    success, violation = (np.array([row[name] for row in rows], bool) for name in ("success", "violation"))
    neither = ~success & ~violation
    return {"success": success, "violation": violation, "stall": neither, "incompletion": neither}[outcome]


def rates(cells: list[Rows]) -> dict:
    """Outcomes of all seeds together as {k, n, low, high}, and of each; what the end of the episodes looks like."""
    share = lambda rows: {name: wilson(happened(rows, name).sum(), len(rows)) for name in OUTCOMES}  # noqa: E731
    every = [row for rows in cells for row in rows]
    ends = {name: wilson(sum(row[name] for row in every), len(every)) for name in ENDS}
    overridden = sum(row["overridden"] for row in every) / sum(row["steps"] for row in every)
    return {**share(every), **ends, "overridden_share": overridden, "per_seed": [share(rows) for rows in cells]}


def against(cells: list[Rows], bare: Rows) -> list[dict]:
    """Exact McNemar tests of each seed's rows against the bare policy's, start by start."""
    return [{name: paired_p_value(happened(bare, name), happened(rows, name)) for name in OUTCOMES} for rows in cells]


def lead_times(rows: Rows) -> tuple[list[int], int, int | None]:
    """Leads of all failing rollouts, how many failures l missed, and which was the first one that was led."""
    found, missed, shown = [], 0, None
    for i, row in enumerate(rows):
        if row["violation"]:
            steps = lead(np.array(row["margin"]), np.array(row["value"]), EPSILON)
            missed += steps is None
            if steps is not None:
                found.append(steps)
                shown = i if shown is None and steps > 0 else shown
    return found, missed, shown


def table_cells(dreamer: str, filters: list[str], risks: list[str], n: int, n_curve: int) -> dict:
    """Cell -> the jobs of `run` that it is made of."""
    world_model = world_model_of(dreamer)

    def jobs(n: int, first: int, mode: str, path: str | None = None, epsilon: float | None = None) -> list[dict]:
        made_of = [fingerprint(p) for p in (dreamer, world_model, path) if p]
        job = {"dreamer": dreamer, "filter": path, "mode": mode, "epsilon": epsilon, "made_of": made_of}
        return [{**job, "seed": seed} for seed in range(first, first + n)]

    table = lambda *cell: jobs(n, FIRST_SEED, *cell)  # noqa: E731
    curve = lambda *cell: jobs(n_curve, CURVE_SEED, *cell)  # noqa: E731
    return {
        "dreamer": table("bare"),
        **{("latentsafe", path): table("filter", path, EPSILON) for path in filters},
        **{(f"sqrl_{r:g}", path): table("filter", path, -r) for r in RISKS for path in risks},
        "lookahead": table("lookahead"),
        "watched": table("monitor", filters[0], EPSILON),
        **{("epsilon", e, path): curve("filter", path, e) for e in EPSILONS for path in filters},
        **{("risk", r, path): curve("filter", path, -r) for r in RISK_CURVE for path in risks},
        "no filter": curve("bare"),
    }


def method_rows(ran: dict[Any, Rows]) -> dict:
    """The rows of the table: outcomes of each method, and tests against the bare policy."""
    methods = {}
    for name in ("dreamer", *(f"sqrl_{r:g}" for r in RISKS), "latentsafe", "lookahead"):
        seeds = [rows for cell, rows in ran.items() if cell == name or cell[0] == name]
        methods[name] = {**rates(seeds), "mcnemar_against_dreamer": against(seeds, ran["dreamer"])}
    return methods


def threshold_curves(ran: dict[Any, Rows], filters: list[str], risks: list[str]) -> dict:
    """Outcomes as the threshold of each kind of filter varies."""
    return {
        title: [{"threshold": x, **rates([ran[kind, x, path] for path in paths])} for x in thresholds]
        for title, kind, thresholds, paths in (
            ("latent safety filter (epsilon)", "epsilon", EPSILONS, filters),
            ("SQRL (risk)", "risk", RISK_CURVE, risks),
        )
    }


def lead_row(jobs: list[dict], watched: Rows, folder: Path) -> dict:
    """How long V warns before l does in failing rollouts; with pictures of all, and of one."""
    found, missed, shown = lead_times(watched)
    row = {"steps": found, "failures_unseen_by_margin": missed}
    if found:
        row |= {"median": float(np.median(found)), "share_of_3_or_more": float(np.mean(np.array(found) >= 3))}
        save(leads(found), folder / "lead.png")
    if shown is not None:
        _, frames = run_filmed(jobs[shown])
        margin, value = (np.array(watched[shown][name]) for name in ("margin", "value"))
        figure = unsafe_rollout(frames, margin, value, EPSILON, SCENES["blocks"].fps)
        save(figure, folder / "unsafe_rollout.png")
    return row


def write_table(
    dreamer: str, filters: list[str], risks: list[str], n: int, n_curve: int, kept: Path, folder: Path,
    workers: int = 1,
) -> None:  # fmt: skip
    """Run all cells, and write the table and its pictures.

    Args:
        dreamer: path of the task policy.
        filters, risks: paths of latent safety filters, and of filters with a risk critic: one a seed.
        n, n_curve: starts of a cell of the table, and of a point of the curves.
        kept: file of finished episodes, .jsonl.
        folder: for table2.json, trade_off.png, unsafe_rollout.png and lead.png.
    """
    cells = table_cells(dreamer, filters, risks, n, n_curve)
    rows = iter(run_resumable(kept, [job for cell in cells.values() for job in cell], run, workers))
    ran = {name: [next(rows) for _ in cell] for name, cell in cells.items()}
    methods, curves, no_filter = method_rows(ran), threshold_curves(ran, filters, risks), rates([ran["no filter"]])
    save(trade_off(curves, no_filter), folder / "trade_off.png")
    record = {
        "methods": methods,
        "curves": {**curves, "no filter": no_filter},
        "lead": lead_row(cells["watched"], ran["watched"], folder),
    }
    minutes = sum(row["cpu_s"] for cell in ran.values() for row in cell) / 60
    write_json(folder / "table2.json", {**record, **provenance([FIRST_SEED, FIRST_SEED + n - 1], minutes)})
    for name, row in methods.items():
        print(name.ljust(12), *(f"{k} {row[k]['k']}/{row[k]['n']}" for k in OUTCOMES), sep="  ")
