"""Episodes of the bag, one robot at a time, bare or under a filter, and what became of the candies."""

import time

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.envs.bag import BagScene
from lerobot_latentsafe.envs.franka import CAMERAS
from lerobot_latentsafe.evaluation.rollouts import wilson
from lerobot_latentsafe.filter import FilterDecision
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.shield import BasePolicy
from lerobot_latentsafe.teleoperators.scripted.behaviors import Actions

STEPS = 90
FIRST_SEED = 300_000
"""Settings were chosen on smaller seeds."""
WARM_UP = 3
"""Decisions of an episode that are not timed."""


def observe(scene: BagScene) -> dict[str, Tensor]:
    """What the robot would send, as a LeRobot batch of one."""
    images = {
        f"observation.images.{name}": torch.from_numpy(scene.render(name)).permute(2, 0, 1)[None] / 255.0
        for name in CAMERAS
    }
    return {**images, "observation.state": torch.from_numpy(scene.proprioception())[None]}


def drive(scene: BagScene, actor: BasePolicy | LatentSafePolicy | None, operator: Actions | None = None) -> dict:
    """One episode of a scene that has just been reset.

    Args:
        actor: a bare policy; a filter, with a base policy or over an operator; None: the operator alone.
        operator: what an operator does, who goes on trying where the filter overrides; None: a policy acts.

    Returns:
        lost: candies outside at the end; success; overridden: steps; first: step of the first override or None;
        cost: CPU seconds of each decision; and step by step: value, margin, intervened, spilled (candies outside).
    """
    action, decisions, cost, spilled = np.zeros(7), [], [], []
    if actor is not None:
        actor.reset()
    for _ in range(STEPS):
        if operator is not None:
            action = next(operator, np.append(np.zeros(6), action[6]))
        executed = action
        if actor is not None:
            seen, began = observe(scene), time.process_time()
            acted, decision = _act(actor, seen, None if operator is None else torch.from_numpy(action).float()[None])
            cost.append(time.process_time() - began)
            decisions += [] if decision is None else [decision]
            executed = acted[0].double().numpy()
        scene.step(executed)
        spilled.append(scene.truth()["spilled"])
    ended = {"lost": spilled[-1], "success": scene.truth()["is_success"], "cost": cost}
    return {**ended, **_overrides(decisions), "spilled": spilled}


@torch.no_grad()
def _act(
    actor: BasePolicy | LatentSafePolicy, seen: dict[str, Tensor], proposed: Tensor | None
) -> tuple[Tensor, FilterDecision | None]:
    if isinstance(actor, BasePolicy):
        return actor.propose(seen), None
    decision = actor.decide(seen) if proposed is None else actor.shield(seen, proposed)
    return decision.action, decision


def _overrides(decisions: list[FilterDecision]) -> dict:
    traces = {name: [getattr(d, name).item() for d in decisions] for name in ("value", "margin", "intervened")}
    intervened = traces["intervened"]
    return {"overridden": sum(intervened), "first": intervened.index(True) if any(intervened) else None, **traces}


def summary(rows: list[dict], n_candies: int) -> dict:
    """What became of the candies, and what the filter did about it, over the episodes of one cell.

    Args:
        rows: of `drive`.
        n_candies: in the bag.
    """
    n, lost = len(rows), np.array([row["lost"] for row in rows])
    result = {
        "spilled": wilson(int((lost > 0).sum()), n),
        "spilled_5_percent": wilson(int((lost >= 0.05 * n_candies).sum()), n),
        "success": wilson(sum(row["success"] for row in rows), n),
        "mean_share_lost": float(lost.mean() / n_candies),
        "lost": lost.tolist(),
    }
    if any(row["value"] for row in rows):
        firsts = [row["first"] for row in rows if row["first"] is not None]
        result |= {
            "overridden_share": float(np.mean([row["overridden"] for row in rows]) / STEPS),
            "episodes_overridden": len(firsts),
            "median_first_override": float(np.median(firsts)) if firsts else None,
        }
    cost = np.concatenate([row["cost"][WARM_UP:] for row in rows])
    if len(cost):
        result["decision_cpu_ms"] = {"p50": float(np.median(cost) * 1e3), "p99": float(np.quantile(cost, 0.99) * 1e3)}
    return result
