#!/usr/bin/env python
"""Table 1: monitors and safe policies of the Dubins car against both exact truths, on the paper's grid.

    scripts/dubins_table1.py --filters outputs/dubins/filter_0 outputs/dubins/filter_1 --seeds 0 1 2

Rows: the latent filters as they are used, their critics alone (lookahead 0), the privileged baseline (trained here, one
critic a seed), and three that keep them honest: a planner that only imagines held actions with the same world models,
the failure classifier alone, always safe.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch

from lerobot_latentsafe.critic import ReachabilityConfig
from lerobot_latentsafe.dubins.ground_truth import exact_value, grid_states, solve_continuous
from lerobot_latentsafe.evaluation.statistics import confusion, provenance, wilson, write_json
from lerobot_latentsafe.experiments.dubins.figures import value_slices
from lerobot_latentsafe.experiments.dubins.monitor import (
    LatentMonitor,
    PlanMonitor,
    PrivilegedMonitor,
    boundary_starts,
    feasible_starts,
    safe_policy_rollouts,
)
from lerobot_latentsafe.experiments.dubins.privileged import train_privileged
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reports.figures import save


def score(value: np.ndarray, truths: dict[str, np.ndarray]) -> dict:
    return {name: confusion(value > 0, true > 0) for name, true in truths.items()}


def rollouts(monitor) -> dict:
    """Safe-policy runs from the paper's starts and from 1,000 states that are safe by a hair (0 < V < 0.05)."""
    feasible, hair = feasible_starts(), boundary_starts(1000, seed=11)
    found = {"safe_policy": safe_policy_rollouts(monitor, feasible), "boundary": safe_policy_rollouts(monitor, hair)}
    return {name: wilson(run["safe"], run["n"]) for name, run in found.items()}


def summary(rows: list[dict]) -> dict:
    """Mean, lowest and highest of each figure over seeds."""
    out = {}
    for truth in ("discrete", "continuous"):
        for key in ("f1_safe", "f1_unsafe", "balanced_accuracy", "false_safe_rate", "false_unsafe_rate"):
            values = [row[truth][key] for row in rows]
            out[f"{truth}_{key}"] = {"mean": float(np.mean(values)), "low": min(values), "high": max(values)}
    for key in ("safe_policy", "boundary"):
        shares = [row[key]["k"] / row[key]["n"] for row in rows]
        out[key] = {"mean": float(np.mean(shares)), "low": min(shares), "high": max(shares)}
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--filters", nargs="+", required=True, help="filter checkpoints, one a seed")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="seeds of the privileged critics")
    parser.add_argument("--output_dir", type=Path, default=Path("results/dubins"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)

    states = grid_states()
    truths = {"discrete": exact_value(states), "continuous": solve_continuous().reshape(-1)}
    table: dict[str, dict] = {}
    latent_rows, critic_rows, plan_rows, classifier_rows = [], [], [], []
    for path in arguments.filters:
        policy = LatentSafePolicy.from_pretrained(path)
        monitor = LatentMonitor(policy)
        lookahead, policy.config.lookahead = policy.config.lookahead, 0
        critic_rows.append({**score(monitor.value(states), truths), **rollouts(monitor)})
        policy.config.lookahead = lookahead
        latent_rows.append({**score(monitor.value(states), truths), **rollouts(monitor)})
        value = PlanMonitor(monitor).value(states[::5])  # every fifth state will do for a control
        plan_rows.append(score(value, {name: true[::5] for name, true in truths.items()}))
        classifier_rows.append(score(monitor.margin(states), truths))
        for name, rows in (("latent", latent_rows), ("critic alone", critic_rows), ("plan", plan_rows)):
            print(path, name, {k: round(v, 4) for k, v in rows[-1]["continuous"].items()}, flush=True)

    privileged_rows, cpu = [], []
    for seed in arguments.seeds:
        started = time.process_time()
        privileged = PrivilegedMonitor(*train_privileged(ReachabilityConfig(), seed))
        cpu.append((time.process_time() - started) / 60)
        privileged_rows.append({**score(privileged.value(states), truths), **rollouts(privileged)})
        print("privileged", seed, {k: round(v, 4) for k, v in privileged_rows[-1]["continuous"].items()}, flush=True)

    for name, rows in (
        ("latent", latent_rows),
        ("critic_alone", critic_rows),
        ("privileged", privileged_rows),
    ):
        table[name] = {"seeds": rows, "summary": summary(rows)}
    table["plan"] = {"seeds": plan_rows}
    table["failure_classifier_alone"] = {"seeds": classifier_rows}
    table["always_safe"] = {"seeds": [score(np.ones(len(states)), truths)]}
    header = {"figures": "each row against both truths; safe_policy and boundary are shares of runs that stay safe"}
    record = {**header, **provenance(arguments.seeds), "privileged_cpu_minutes": cpu, "rows": table}
    write_json(arguments.output_dir / "table1.json", record)
    save(value_slices({"latent": monitor, "privileged": privileged}), arguments.output_dir / "value_slices.png")


if __name__ == "__main__":
    main()
