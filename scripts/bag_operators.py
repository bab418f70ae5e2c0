#!/usr/bin/env python
"""A scripted operator lifts or swings the bag, bare and under the filter and its baselines, from the same starts.

    scripts/bag_operators.py --policy=<filter> --operators closed_end open_end --n=100

Writes results/bag/operators.json: for each operator and law the episodes that spill, the share of candies lost, steps
overridden, the step of the first override, and the CPU time of a decision.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch

from lerobot_latentsafe.envs.bag import BagScene
from lerobot_latentsafe.envs.franka import CAMERAS
from lerobot_latentsafe.evaluation.rollouts import provenance, wilson, write_json
from lerobot_latentsafe.filter import FilterDecision
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.teleoperators.scripted.behaviors import begin

OPERATORS = {
    "closed_end": ("closed_end", None),
    "open_end": ("open_end", None),
    "middle": ("middle", None),
    "side_to_side_0.04": ("side_to_side", 0.04),
    "side_to_side_0.15": ("side_to_side", 0.15),
    "side_to_side_0.30": ("side_to_side", 0.30),
}
LAWS = ("bare", "reachability", "plan", "margin")
STEPS = 90
FIRST_SEED = 300_000
"""Settings were chosen on smaller seeds."""


def observe(scene: BagScene) -> dict[str, torch.Tensor]:
    """What the robot would send, as a LeRobot batch of one."""
    images = {
        f"observation.images.{name}": torch.from_numpy(scene.render(name)).permute(2, 0, 1)[None] / 255.0
        for name in CAMERAS
    }
    return {**images, "observation.state": torch.from_numpy(scene.proprioception())[None]}


def drive(scene: BagScene, operator: str, seed: int, policy: LatentSafePolicy | None) -> dict:
    """One episode; an operator who is overridden goes on trying."""
    behavior, speed = OPERATORS[operator]
    scene.reset(seed)
    actions = begin(behavior, scene, speed, np.random.default_rng([0, seed]))
    action, decisions, cost = np.zeros(7), [], []
    if policy is not None:
        policy.reset()
    for _ in range(STEPS):
        action = next(actions, np.append(np.zeros(6), action[6]))
        executed = action
        if policy is not None:
            seen, began = observe(scene), time.process_time()
            decision = policy.shield(seen, torch.from_numpy(action).float()[None])
            cost.append(time.process_time() - began)
            decisions.append(decision)
            executed = decision.action[0].double().numpy()
        scene.step(executed)
    truth = scene.truth()
    return {"lost": truth["spilled"], "success": bool(truth["is_success"]), "cost": cost, **_overrides(decisions)}


def _overrides(decisions: list[FilterDecision]) -> dict:
    intervened = [bool(d.intervened.item()) for d in decisions]
    first = intervened.index(True) if any(intervened) else None
    return {"overridden": sum(intervened), "first": first, "value": [d.value.item() for d in decisions]}


def cell(scene: BagScene, operator: str, n: int, policy: LatentSafePolicy | None) -> dict:
    """All episodes of an operator under one law."""
    rows = [drive(scene, operator, FIRST_SEED + i, policy) for i in range(n)]
    lost = np.array([row["lost"] for row in rows])
    result = {
        "spilled": wilson(int((lost > 0).sum()), n),
        "spilled_5_percent": wilson(int((lost >= 0.05 * scene.n_candies).sum()), n),
        "success": wilson(sum(row["success"] for row in rows), n),
        "mean_share_lost": float(lost.mean() / scene.n_candies),
        "lost": lost.tolist(),
    }
    if policy is not None:
        firsts = [row["first"] for row in rows if row["first"] is not None]
        cost = np.concatenate([row["cost"][3:] for row in rows])
        result |= {
            "overridden_share": float(np.mean([row["overridden"] for row in rows]) / STEPS),
            "episodes_overridden": len(firsts),
            "median_first_override": float(np.median(firsts)) if firsts else None,
            "decision_cpu_ms": {"p50": float(np.median(cost) * 1e3), "p99": float(np.quantile(cost, 0.99) * 1e3)},
        }
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", required=True)
    parser.add_argument("--operators", nargs="+", choices=OPERATORS, default=list(OPERATORS))
    parser.add_argument("--laws", nargs="+", choices=LAWS, default=list(LAWS))
    parser.add_argument("--n", type=int, default=100)
    parser.add_argument("--epsilon", type=float)
    parser.add_argument("--guard", type=int)
    parser.add_argument("--output", type=Path, default=Path("results/bag/operators.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    policy = LatentSafePolicy.from_pretrained(arguments.policy).eval()
    for name in ("epsilon", "guard"):
        if getattr(arguments, name) is not None:
            setattr(policy.config, name, getattr(arguments, name))
    scene, table = BagScene(), {}
    for operator in arguments.operators:
        for law in arguments.laws:
            if law != "bare":
                policy.config.law = law
            table[f"{operator} {law}"] = row = cell(scene, operator, arguments.n, None if law == "bare" else policy)
            shown = {k: row[k] for k in ("mean_share_lost", "overridden_share", "decision_cpu_ms") if k in row}
            print(operator, law, f"spilled {row['spilled']['k']}/{arguments.n}", shown, flush=True)
    row = {**table, "epsilon": policy.config.epsilon, "guard": policy.config.guard}
    write_json(arguments.output, {**row, **provenance(seeds=[FIRST_SEED, FIRST_SEED + arguments.n - 1])})


if __name__ == "__main__":
    main()
