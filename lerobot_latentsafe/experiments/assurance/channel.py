"""What the critic is for: a bent channel, in which no held action saves, beside a planner that holds actions.

The car must stay between two walls that bend like an S. A planner that imagines holding each action calls most of the
way unsafe, as what saves is to turn one way and then the other. The critic learns that by its own backup. Both read the
same world model and margin, of one filter for each seed. The truth is the exact solution on a grid.
"""

from dataclasses import replace
from functools import cached_property
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure

from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.evaluation.statistics import confusion, provenance, run_resumable, wilson, write_json
from lerobot_latentsafe.experiments.assurance.constraints import (
    GRID,
    LOOKAHEAD,
    N_RUNS,
    N_STATES,
    PROPOSAL_STEPS,
    RUN,
    Case,
    Filters,
    Truth,
    drive,
    runs_of,
)
from lerobot_latentsafe.experiments.dubins.monitor import LatentMonitor, safe_policy_rollouts
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reports.figures import save

BEND, WAVES, HALF_WIDTH = 0.31, 2.0, 0.17
"""The middle of the channel is y = BEND sin(WAVES x), in m; its curvature never exceeds that of the sharpest turn."""
LAWS = {
    "critic and look-ahead": {"name": "reachability", "lookahead": LOOKAHEAD},
    "critic alone": {"name": "reachability", "lookahead": 0},
    "plan": {"name": "plan", "lookahead": 25},
    "margin": {"name": "margin", "lookahead": 0},
}
"""Those that are compared; all hold the proposal for PROPOSAL_STEPS first."""
EPSILON = 0.5
"""Threshold of all laws, chosen on other starts: there the runs of the critic hit no wall."""
FAR = 0.03
"""Starts are those that the exact controller keeps this far from the walls, m."""


def middle(x: np.ndarray) -> np.ndarray:
    """Of the channel, y at x."""
    return BEND * np.sin(WAVES * x)


def _walls() -> np.ndarray:
    x = np.linspace(-car.VIEW, car.VIEW, 45)
    return np.concatenate([np.stack([x, middle(x) + side * (HALF_WIDTH + 0.1)], -1) for side in (-1, 1)])


CHANNEL = Case({"walls": lambda s: HALF_WIDTH - np.abs(s[..., 1] - middle(s[..., 0]))}, _walls())
"""What is forbidden is all beyond the walls; a reckless driver heads for the nearest one."""


class Study(Filters):
    """The channel under several laws."""

    @cached_property
    def truth(self) -> Truth:
        """The exact value."""
        return Truth(CHANNEL)

    def policy(self, law: str, seed: int) -> LatentSafePolicy:
        """The filter of a seed under a law."""
        policy = self.dedicated("channel", CHANNEL, seed)
        options = {"proposal_steps": PROPOSAL_STEPS, "epsilon": EPSILON, **LAWS[law]}
        policy.config.change(law=replace(policy.config.law, **options))
        return policy

    def run(self, job: dict) -> dict:
        """Under a law: verdicts on states of the channel against the truth; or runs."""
        torch.set_num_threads(1)
        truth = self.truth
        kept = truth.value > FAR
        starts = truth.sample(N_RUNS, 1, kept)[0]
        if job["law"] == "bare":
            return runs_of(drive(None, CHANNEL, starts))
        policy = self.policy(job["law"], job["seed"])
        monitor = LatentMonitor(policy.model)
        if job["what"] == "shielded":
            return runs_of(drive(policy, CHANNEL, starts))
        if job["what"] == "fallback":
            failed = safe_policy_rollouts(monitor, starts, RUN, CHANNEL.margin)["failed"]
            return {"violation": wilson(int(failed.sum()), len(failed))}
        states, value = truth.sample(N_STATES, 0, CHANNEL.margin(truth.states) > 0)
        return {"verdicts": confusion(monitor.value(states) > 0, value > 0)}


def study(base: str, dataset_root: Path, folder: Path, seeds: list[int], n_steps: int, output: Path) -> None:
    """Measure all laws, and write the table and a picture; what was measured before is kept beside it."""
    made = Study(base, dataset_root, folder, n_steps)
    jobs = [{"law": "bare", "seed": 0, "what": "shielded", "steps": n_steps, "epsilon": EPSILON}]
    jobs += [
        {"law": law, "seed": seed, "what": what, "steps": n_steps, "epsilon": EPSILON}
        for what in ("verdicts", "fallback", "shielded")
        for seed in seeds
        for law in LAWS
    ]
    rows = run_resumable(output.with_suffix(".jsonl"), jobs, made.run)
    bare, *measured = zip(jobs, rows)
    summary: dict[str, dict] = {"bare": bare[1]}
    for law in LAWS:
        of = {what: [row for job, row in measured if (job["law"], job["what"]) == (law, what)] for what in MEASURES}
        summary[law] = {what: measure(of[what]) for what, measure in MEASURES.items()}
    minutes = sum(row["cpu_s"] for row in rows) / 60
    settings = {"epsilon": EPSILON, "proposal_steps": PROPOSAL_STEPS, "steps": n_steps, "laws": LAWS}
    write_json(output, {"summary": summary, "settings": settings, **provenance(seeds, minutes)})
    save(values_of(made, seeds[0]), output.with_suffix(".png"))


def _verdicts(rows: list[dict]) -> dict:
    names = ("balanced_accuracy", "false_safe_rate", "false_unsafe_rate")
    each = {name: [row["verdicts"][name] for row in rows] for name in names}
    return {**{name: float(np.mean(of)) for name, of in each.items()}, "seeds": each}


def _violations(rows: list[dict]) -> dict:
    of = [row["violation"] for row in rows]
    changed = [row["changed_share"] for row in rows if "changed_share" in row]
    share = {"changed_share": float(np.mean(changed))} if changed else {}
    return {**wilson(sum(each["k"] for each in of), sum(each["n"] for each in of)), **share}


MEASURES = {"verdicts": _verdicts, "fallback": _violations, "shielded": _violations}


def values_of(made: Study, seed: int, n: int = 45) -> Figure:
    """V over the plane at heading 0 under the critic and under the planner, its zero level, and the exact one."""
    laws = ("critic and look-ahead", "plan")
    figure, axes = plt.subplots(1, len(laws), figsize=(4.6 * len(laws), 4.4))
    axis = np.linspace(-car.VIEW, car.VIEW, n)
    x, y = np.meshgrid(axis, axis)
    states = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], -1)
    exact = made.truth.value[made.truth.states[:, 2] == 0].reshape(GRID, GRID).T
    fine = np.linspace(-car.VIEW, car.VIEW, GRID)
    for ax, law in zip(axes, laws):
        value = LatentMonitor(made.policy(law, seed).model).value(states).reshape(n, n)
        ax.pcolormesh(x, y, value, cmap="RdBu", vmin=-1, vmax=1, shading="auto")
        ax.contour(x, y, value, [0.0], colors="k", linewidths=2)
        ax.contour(fine, fine, exact, [0.0], colors="k", linewidths=2, linestyles="--")
        for wall in (-HALF_WIDTH, HALF_WIDTH):
            ax.plot(axis, middle(axis) + wall, color="tab:red", linewidth=2)
        ax.set(title=law, aspect="equal", xlabel="x (m)", ylabel="y (m)", ylim=(-car.VIEW, car.VIEW))
    figure.suptitle("V of a car that heads to the right. Solid: V = 0, dashed: the exact one, red: the walls")
    figure.tight_layout()
    return figure
