#!/usr/bin/env python
"""Table 2: the blocks' task policy bare, under SQRL, under the latent safety filter, and under the simulator itself.

    scripts/blocks_table2.py --dreamer outputs/blocks/dreamer/policy --workers=2 \
        --filters outputs/blocks/filter/seed_{0,1,2} --risks outputs/blocks/risk/seed_{0,1,2}

All methods start from the same states. Writes table2.json, trade_off.png, unsafe_rollout.png and lead.png to
--output_dir. Each episode is kept in --cells as it ends, so that a killed run goes on where it stopped.
"""

import argparse
from pathlib import Path

import numpy as np

from lerobot_latentsafe.evaluation.statistics import paired_p_value, provenance, run_resumable, wilson, write_json
from lerobot_latentsafe.experiments.bag.runs import fingerprint
from lerobot_latentsafe.experiments.blocks.study import (
    lead,
    leads,
    run,
    run_filmed,
    trade_off,
    unsafe_rollout,
    world_model_of,
)
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
OUTCOMES = ("success", "violation", "incompletion")
ENDS = ("held", "leaning")

Rows = list[dict]
"""Of `run`, of one method from all starts."""


def happened(rows: Rows, outcome: str) -> np.ndarray:
    """bool (n,)."""
    success, violation = (np.array([row[name] for row in rows], bool) for name in ("success", "violation"))
    return {"success": success, "violation": violation, "incompletion": ~success & ~violation}[outcome]


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dreamer", required=True, help="the task policy")
    parser.add_argument("--filters", nargs="+", required=True, help="latent safety filters, one a seed")
    parser.add_argument("--risks", nargs="+", required=True, help="filters with a risk critic, one a seed")
    parser.add_argument("--n", type=int, default=200, help="starts")
    parser.add_argument("--n_curve", type=int, default=50, help="starts of each point of the curves, each seed")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--cells", type=Path, default=Path("outputs/blocks/cells.jsonl"))
    parser.add_argument("--output_dir", type=Path, default=Path("results/blocks"))
    arguments = parser.parse_args()
    dreamer, filters, risks = arguments.dreamer, arguments.filters, arguments.risks
    world_model = world_model_of(dreamer)

    def jobs(n: int, first: int, mode: str, path: str | None = None, epsilon: float | None = None) -> list[dict]:
        made_of = [fingerprint(p) for p in (dreamer, world_model, path) if p]
        job = {"dreamer": dreamer, "filter": path, "mode": mode, "epsilon": epsilon, "made_of": made_of}
        return [{**job, "seed": seed} for seed in range(first, first + n)]

    table = lambda *cell: jobs(arguments.n, FIRST_SEED, *cell)  # noqa: E731
    curve = lambda *cell: jobs(arguments.n_curve, CURVE_SEED, *cell)  # noqa: E731
    cells = {
        "dreamer": table("bare"),
        **{("latentsafe", path): table("filter", path, EPSILON) for path in filters},
        **{(f"sqrl_{r:g}", path): table("filter", path, -r) for r in RISKS for path in risks},
        "lookahead": table("lookahead"),
        "watched": table("monitor", filters[0], EPSILON),
        **{("epsilon", e, path): curve("filter", path, e) for e in EPSILONS for path in filters},
        **{("risk", r, path): curve("filter", path, -r) for r in RISK_CURVE for path in risks},
        "no filter": curve("bare"),
    }
    rows = iter(
        run_resumable(arguments.cells, [job for cell in cells.values() for job in cell], run, arguments.workers)
    )
    ran = {name: [next(rows) for _ in cell] for name, cell in cells.items()}

    bare, methods = ran["dreamer"], {}
    for name in ("dreamer", *(f"sqrl_{r:g}" for r in RISKS), "latentsafe", "lookahead"):
        seeds = [ran[cell] for cell in cells if cell == name or cell[0] == name]
        methods[name] = {**rates(seeds), "mcnemar_against_dreamer": against(seeds, bare)}
    curves = {
        title: [{"threshold": x, **rates([ran[kind, x, path] for path in paths])} for x in thresholds]
        for title, kind, thresholds, paths in (
            ("latent safety filter (epsilon)", "epsilon", EPSILONS, filters),
            ("SQRL (risk)", "risk", RISK_CURVE, risks),
        )
    }
    no_filter = rates([ran["no filter"]])
    save(trade_off(curves, no_filter), arguments.output_dir / "trade_off.png")

    found, missed, shown = lead_times(ran["watched"])
    lead_row = {"steps": found, "failures_unseen_by_margin": missed}
    if found:
        lead_row |= {"median": float(np.median(found)), "share_of_3_or_more": float(np.mean(np.array(found) >= 3))}
        save(leads(found), arguments.output_dir / "lead.png")
    if shown is not None:
        _, frames = run_filmed(cells["watched"][shown])
        curves_of = (np.array(ran["watched"][shown][name]) for name in ("margin", "value"))
        figure = unsafe_rollout(frames, *curves_of, EPSILON, SCENES["blocks"].fps)
        save(figure, arguments.output_dir / "unsafe_rollout.png")
    record = {"methods": methods, "curves": {**curves, "no filter": no_filter}, "lead": lead_row}
    minutes = sum(row["cpu_s"] for cell in ran.values() for row in cell) / 60
    made_by = provenance([FIRST_SEED, FIRST_SEED + arguments.n - 1], minutes)
    write_json(arguments.output_dir / "table2.json", {**record, **made_by})
    for name, row in methods.items():
        print(name.ljust(12), *(f"{k} {row[k]['k']}/{row[k]['n']}" for k in OUTCOMES), sep="  ")


if __name__ == "__main__":
    main()
