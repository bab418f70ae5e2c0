"""Table 1: monitors and safe policies of the Dubins car against both exact truths, on the paper's grid."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.critic import ReachabilityConfig
from lerobot_latentsafe.dubins.ground_truth import exact_value, grid_states, solve_continuous
from lerobot_latentsafe.evaluation.statistics import confusion, provenance, wilson, write_json
from lerobot_latentsafe.experiments.dubins.figures import value_slices
from lerobot_latentsafe.experiments.dubins.monitor import (
    LatentMonitor,
    Monitor,
    PlanMonitor,
    PrivilegedMonitor,
    boundary_starts,
    feasible_starts,
    safe_policy_rollouts,
)
from lerobot_latentsafe.experiments.dubins.privileged import train_privileged
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.reports.figures import save

LOOKAHEADS = {"latent": None, "latent_25_ahead": 25, "critic_alone": 0}
"""Row -> `law.lookahead`; None: the filter's own."""
Truths = dict[str, np.ndarray]
"""discrete and continuous -> the exact V of each state (N,)."""


def score(safe: np.ndarray, truths: Truths) -> dict:
    """Confusion of verdicts, bool (N,), with each truth."""
    return {name: confusion(safe, true > 0) for name, true in truths.items()}


def rollouts(monitor: Monitor) -> dict:
    """Safe-policy runs from the paper's starts and from 1,000 states that are safe by a hair (0 < V < 0.05)."""
    feasible, hair = feasible_starts(), boundary_starts(1000, seed=11)
    found = {"safe_policy": safe_policy_rollouts(monitor, feasible), "boundary": safe_policy_rollouts(monitor, hair)}
    return {name: wilson(run["safe"], run["n"]) for name, run in found.items()}


def summary(rows: list[dict]) -> dict:
    """Mean, lowest and highest of each figure over seeds."""
    out = {}
    for truth in ("discrete", "continuous"):
        for key in ("f1_safe", "f1_unsafe", "balanced_accuracy", "false_safe_rate", "false_unsafe_rate"):
            out[f"{truth}_{key}"] = _spread([row[truth][key] for row in rows])
    for key in ("safe_policy", "boundary"):
        out[key] = _spread([row[key]["k"] / row[key]["n"] for row in rows])
    return out


def _spread(values: list[float]) -> dict[str, float]:
    return {"mean": float(np.mean(values)), "low": min(values), "high": max(values)}


def latent_rows(path: str, states: np.ndarray, truths: Truths) -> tuple[dict[str, dict], LatentMonitor]:
    """The rows of one filter, and its monitor."""
    policy = load_filter(path)
    monitor, law = LatentMonitor(policy.model), policy.config.law
    seen = list(monitor.latents(states))  # drawn and encoded once, for all rows

    @torch.no_grad()
    def judged(safe: Callable[[Latent], Tensor]) -> dict:
        return score(torch.cat([safe(latent) for latent in seen]).numpy(), truths)

    rows = {}
    for name, ahead in LOOKAHEADS.items():
        policy.config.change(law=replace(law, lookahead=law.lookahead if ahead is None else ahead))
        rows[name] = {**judged(monitor.safe), **rollouts(monitor)}
    policy.config.change(law=law)
    plan = PlanMonitor(monitor).value(states[::5]) > 0  # every fifth state will do for a control
    rows["plan"] = score(plan, {name: true[::5] for name, true in truths.items()})
    rows["failure_classifier_alone"] = judged(lambda latent: policy.model.imagination.margin(latent) > 0)
    return rows, monitor


def privileged_row(seed: int, states: np.ndarray, truths: Truths) -> tuple[dict, PrivilegedMonitor, float]:
    """The row of the privileged baseline, its monitor, and the CPU minutes of its training."""
    started = time.process_time()
    monitor = PrivilegedMonitor(*train_privileged(ReachabilityConfig(), seed))
    minutes = (time.process_time() - started) / 60
    return {**score(monitor.value(states) > 0, truths), **rollouts(monitor)}, monitor, minutes


def write_table(filters: list[str], seeds: list[int], folder: Path) -> None:
    """Write table1.json and value_slices.png to a folder.

    Args:
        filters: checkpoints, one a seed.
        seeds: of the privileged critics.
    """
    torch.set_num_threads(1)
    states = grid_states()
    truths = {"discrete": exact_value(states), "continuous": solve_continuous().reshape(-1)}
    found: dict[str, list[dict]] = {}
    for path in filters:
        rows, latent = latent_rows(path, states, truths)
        for name, row in rows.items():
            found.setdefault(name, []).append(row)
        for name in (*LOOKAHEADS, "plan"):
            _tell(f"{path} {name}", rows[name])
    cpu = []
    for seed in seeds:
        row, privileged, minutes = privileged_row(seed, states, truths)
        found.setdefault("privileged", []).append(row)
        cpu.append(minutes)
        _tell(f"privileged {seed}", row)

    table: dict[str, dict] = {
        name: {"seeds": found[name], "summary": summary(found[name])} for name in (*LOOKAHEADS, "privileged")
    }
    table |= {name: {"seeds": found[name]} for name in ("plan", "failure_classifier_alone")}
    table["always_safe"] = {"seeds": [score(np.ones(len(states), bool), truths)]}
    header = {"figures": "each row against both truths; safe_policy and boundary are shares of runs that stay safe"}
    record = {**header, **provenance(seeds), "privileged_cpu_minutes": cpu, "rows": table}
    write_json(folder / "table1.json", record)
    save(value_slices({"latent": latent, "privileged": privileged}), folder / "value_slices.png")


def _tell(who: str, row: dict) -> None:
    print(who, {k: round(v, 4) for k, v in row["continuous"].items()}, flush=True)
