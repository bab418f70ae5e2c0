"""Episodes of the bag, one robot at a time, bare or under a filter, and what became of the candies."""

import time
from collections.abc import Callable, Hashable
from functools import cache, lru_cache
from itertools import batched
from pathlib import Path

import numpy as np
import torch

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.decision import FilterDecision
from lerobot_latentsafe.evaluation.rollouts import Actor, Choice, PolicyActor, steps
from lerobot_latentsafe.evaluation.statistics import paired_p_value, provenance, run_resumable, wilson
from lerobot_latentsafe.experiments.filter_settings import FilterSetting
from lerobot_latentsafe.experiments.scene_world import FRONT, OperatorActor, SceneWorld, picture
from lerobot_latentsafe.franka.bag import BagScene, Variant
from lerobot_latentsafe.franka.behaviors import Actions
from lerobot_latentsafe.franka.scene import CAMERAS
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

STEPS = 90
"""Of an operator, who lifts the bag within 6 s."""
FIRST_SEED = 300_000
"""Settings were chosen on smaller seeds."""
WARM_UP = 3
"""Decisions of an episode that are not timed."""
N_TRACES = 5
"""Episodes whose values are kept step by step in results and drawn."""


@cache
def bag_scene(variant: str | Variant = "red") -> BagScene:
    """The bag of this process."""
    return BagScene(variant)


@lru_cache(maxsize=2)
def load(setting: FilterSetting | None, base: str | None = None) -> BasePolicy | LatentSafePolicy | None:
    """A policy bare or under a filter, a filter without a policy, or nothing."""
    torch.set_num_threads(1)
    if setting is None:
        return None if base is None else BasePolicy.load(base)
    return setting.load(base)


class TimedActor:
    """An actor whose choices are timed.

    Attributes:
        cost: CPU seconds of each.
    """

    def __init__(self, actor: Actor):
        self.actor = actor
        self.cost: list[float] = []

    def __call__(self, seen: dict) -> Choice:
        began = time.process_time()
        choice = self.actor(seen)
        self.cost.append(time.process_time() - began)
        return choice


def drive(
    scene: BagScene, policy: BasePolicy | LatentSafePolicy | None, operator: Actions | None = None,
    frames: list[np.ndarray] | None = None, n_steps: int | None = None,
) -> dict:  # fmt: skip
    """One episode of a scene that has just been reset.

    Args:
        policy: a bare policy; a filter, with a base policy or over an operator; None: the operator alone.
        operator: what an operator does, who goes on trying where the filter overrides; None: a policy acts.
        frames: the front camera's pictures of all steps are appended, if given.
        n_steps: how long it lasts; by default an operator's.

    Returns:
        lost: candies outside at the end; success; grasped: whether the bag was ever held; overridden: steps; first:
        step of the first override or None; cost: CPU seconds of each decision; and step by step: value, margin,
        intervened, adjusted, deviation (from the proposal, in standardised units), spilled (candies outside).
    """
    filter = policy if isinstance(policy, LatentSafePolicy) else None
    actor = TimedActor(PolicyActor(policy) if operator is None else OperatorActor(operator, filter))
    world = SceneWorld(scene, n_steps or STEPS, () if policy is None and frames is None else CAMERAS)
    decisions, truths = [], []
    for step in steps(world, actor):
        decisions += [] if step.decision is None else [step.decision]
        truths.append(step.info)
        if frames is not None:
            frames.append(picture(step.seen[FRONT]))
    return {
        "lost": truths[-1]["spilled"],
        "success": truths[-1]["is_success"],
        "grasped": any(truth["grasp"] >= 0 for truth in truths),
        "cost": [] if policy is None else actor.cost,
        "spilled": [truth["spilled"] for truth in truths],
        **_overrides(decisions, filter),
    }


def _overrides(decisions: list[FilterDecision], filter: LatentSafePolicy | None) -> dict:
    value, margin = ([round(getattr(d, name).item(), 4) for d in decisions] for name in ("value", "margin"))
    intervened, adjusted = ([getattr(d, name).item() for d in decisions] for name in ("intervened", "adjusted"))
    away = [] if filter is None else [filter.shield.nearest.deviation(d) for d in decisions]
    return {
        "overridden": sum(intervened), "first": intervened.index(True) if any(intervened) else None,
        "value": value, "margin": margin, "intervened": intervened, "adjusted": adjusted,
        "deviation": [round(float(distance[0]), 4) for distance in away],
    }  # fmt: skip


def run_cells[Cell: Hashable](
    path: Path,
    cells: dict[Cell, dict],
    n: int,
    run: Callable[[dict], dict],
    workers: int = 1,
    first_seed: int = FIRST_SEED,
) -> tuple[dict[Cell, list[dict]], dict]:
    """Episodes of all cells of a table from the same starts, each kept as it ends; see `run_resumable`.

    Args:
        path: of the table that will be written; the file of episodes is beside it.
        cells: cell -> the job of its episodes, without their seed.
        n: episodes of a cell.
        first_seed: of their starts.

    Returns:
        Cell -> its rows; and their provenance.
    """
    seeds = range(first_seed, first_seed + n)
    jobs = [{**job, "seed": seed} for job in cells.values() for seed in seeds]
    rows = run_resumable(path.with_suffix(".jsonl"), jobs, run, workers)
    runs = dict(zip(cells, map(list, batched(rows, n))))
    return runs, provenance([seeds[0], seeds[-1]], sum(row["cpu_s"] for row in rows) / 60)


def summary(rows: list[dict], n_candies: int) -> dict:
    """What became of the candies, and what the filter did about it, over the episodes of one cell.

    Args:
        rows: of `drive`.
        n_candies: in the bag.
    """
    n, lost = len(rows), np.array([row["lost"] for row in rows])
    spilled = lost > 0
    k = int(spilled.sum())
    result = {
        "spilled": wilson(k, n),
        "spilled_5_percent": wilson(int((lost >= 0.05 * n_candies).sum()), n),
        "spills_below_5_percent": wilson(int((lost[spilled] < 0.05 * n_candies).sum()), k) if k else None,
        "success": wilson(sum(row["success"] for row in rows), n),
        "stall": wilson(sum(not row["success"] and row["lost"] == 0 for row in rows), n),
        "grasped": wilson(sum(row["grasped"] for row in rows), n),
        "mean_share_lost": float(lost.mean() / n_candies),
        "lost": lost.tolist(),
    }
    if any(row["value"] for row in rows):
        firsts = [row["first"] for row in rows if row["first"] is not None]
        # The margin of a step is that of the state before it.
        late = [l > 0 for row in rows for l, spilled in zip(row["margin"][1:], row["spilled"]) if spilled]
        result |= {
            "seen_after_a_spill": {"n": len(late), "called_safe": sum(late)},
            "deviation": float(np.mean([np.mean(row["deviation"]) for row in rows])),
            "overridden_share": float(np.mean([row["overridden"] / len(row["spilled"]) for row in rows])),
            "episodes_overridden": len(firsts),
            "median_first_override": float(np.median(firsts)) if firsts else None,
        }
    cost = np.concatenate([row["cost"][WARM_UP:] for row in rows])
    if len(cost):
        result["decision_cpu_ms"] = {"p50": float(np.median(cost) * 1e3), "p99": float(np.quantile(cost, 0.99) * 1e3)}
    return result


def against_bare(bare: list[dict], shielded: dict[str, list[dict]], n_candies: int) -> dict:
    """What filters change, each and all together, from the same starts as the bare runs.

    Args:
        bare: rows of `drive`.
        shielded: filter -> rows from the same starts, in the same order.

    Returns:
        filter, and `pooled`: its summary; spilled_of_bare: its violations over the bare ones; success_lost: points;
        paired_p: of the difference in violations.
    """
    pooled = [row for rows in shielded.values() for row in rows]
    table = {name: _change(bare, rows, n_candies) for name, rows in shielded.items()}
    for name, rows in shielded.items():
        table[name]["paired_p"] = paired_p_value(*(np.array([r["lost"] for r in part]) > 0 for part in (bare, rows)))
    return {**table, "pooled": _change(bare * len(shielded), pooled, n_candies)}


def tabulate(bare: list[dict], shielded: dict[FilterSetting, list[dict]], n_candies: int) -> dict:
    """One cell bare and under filters: `bare`, and law -> what its filters change, see `against_bare`."""
    table = {"bare": summary(bare, n_candies)}
    for law in dict.fromkeys(setting.law for setting in shielded):
        rows = {setting.path: runs for setting, runs in shielded.items() if setting.law == law}
        table[law] = against_bare(bare, rows, n_candies)
    return table


def _change(bare: list[dict], shielded: list[dict], n_candies: int) -> dict:
    violations, successes = (
        [sum(count(row) for row in rows) for rows in (bare, shielded)]
        for count in (lambda row: row["lost"] > 0, lambda row: row["success"])
    )
    return {
        **summary(shielded, n_candies),
        "spilled_of_bare": violations[1] / violations[0] if violations[0] else None,
        "success_lost": 100 * (successes[0] - successes[1]) / len(bare),
    }


def traces(rows: list[dict]) -> list[dict]:
    """What figures draw of the first episodes."""
    return [{name: row[name] for name in ("value", "margin", "intervened", "spilled")} for row in rows[:N_TRACES]]


def in_short(cell: dict) -> str:
    """A cell's figures on one line."""
    parts = [f"{name} {cell[name]['k']}/{cell[name]['n']}" for name in ("spilled", "success", "stall")]
    parts.append(f"share lost {cell['mean_share_lost']:.3f}")
    if "overridden_share" in cell:
        parts.append(f"overridden {cell['overridden_share']:.1%}")
    if "decision_cpu_ms" in cell:
        parts.append(f"decision p99 {cell['decision_cpu_ms']['p99']:.1f} CPU-ms")
    return ", ".join(parts)
