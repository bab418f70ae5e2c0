"""Episodes of the bag, one robot at a time, bare or under a filter, and what became of the candies."""

import hashlib
import time
from argparse import ArgumentParser
from collections.abc import Callable, Hashable
from dataclasses import asdict, dataclass
from functools import cache
from itertools import batched
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.configuration_latentsafe import DECIDES, LAWS
from lerobot_latentsafe.decision import FilterDecision
from lerobot_latentsafe.evaluation.statistics import paired_p_value, provenance, run_resumable, wilson
from lerobot_latentsafe.franka.bag import BagScene
from lerobot_latentsafe.franka.behaviors import Actions
from lerobot_latentsafe.franka.scene import CAMERAS
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.runtime.checkpoint import WEIGHTS, read_config, resolve_checkpoint

STEPS = 90
"""Of an operator, who lifts the bag within 6 s."""
FIRST_SEED = 300_000
"""Settings were chosen on smaller seeds."""
WARM_UP = 3
"""Decisions of an episode that are not timed."""

N_TRACES = 5
"""Episodes whose values are kept step by step in results and drawn."""


@dataclass(frozen=True)
class FilterSetting:
    """A filter as an experiment runs it: all that its decisions depend on."""

    path: str
    law: str
    epsilon: float
    guard: int
    release: float
    fingerprint: str

    @classmethod
    def of(cls, path: str, law: str, **changed: float | None) -> "FilterSetting":
        """Epsilon, guard and release are the filter's own unless given."""
        own = read_config(resolve_checkpoint(path))
        chosen = {name: getattr(own, name) if changed.get(name) is None else changed[name] for name in DECIDES}
        return cls(path, law, **chosen, fingerprint=fingerprint(path))

    @classmethod
    def all(cls, paths: list[str], laws: list[str], options: object) -> list["FilterSetting"]:
        """Filters under the first law, and the first of them under the others, which are what it is compared with.

        Epsilon, guard and release are those of a command line's options.
        """
        pairs = [(path, laws[0]) for path in paths] + [(paths[0], law) for law in laws[1:]]
        changed = {name: getattr(options, name) for name in DECIDES}
        return [cls.of(path, law, **changed) for path, law in pairs]

    def load(self, base: str | None = None) -> LatentSafePolicy:
        """The filter, with the policy it is to shield, if any."""
        policy = LatentSafePolicy.from_pretrained(self.path).eval()
        policy.config.override(self, "law", *DECIDES)
        if base is not None:
            policy.attach(base)
        return policy


def add_filter_options(parser: ArgumentParser, n: int) -> None:
    """The filters of an experiment, how they decide, and how many starts: by default n."""
    parser.add_argument("--filters", nargs="+", required=True)
    parser.add_argument("--n", type=int, default=n)
    parser.add_argument("--epsilon", type=float)
    parser.add_argument("--guard", type=int)
    parser.add_argument("--release", type=float)
    parser.add_argument("--workers", type=int, default=1, help="processes")


def add_laws(parser: ArgumentParser) -> None:
    """The laws that are compared, see `FilterSetting.all`."""
    parser.add_argument(
        "--laws", nargs="+", choices=LAWS, default=["reachability", "plan", "margin"],
        help="the first for all filters, the others for the first filter",
    )  # fmt: skip


def in_use(settings: list[FilterSetting]) -> dict[str, dict]:
    """Path -> what a table notes of a filter beside its rates."""
    rows = {setting.path: {name: getattr(setting, name) for name in DECIDES} for setting in settings}
    for path, row in rows.items():
        own = read_config(resolve_checkpoint(path))
        row |= {"memory": own.memory} if own.memory else {}
        if own.retreat:
            row |= {"retreat": own.retreat, "patience": own.patience, "dwell": own.dwell}
    return rows


def as_job(setting: FilterSetting | None) -> dict | None:
    """As a part of a job; back by `FilterSetting(**...)`."""
    return asdict(setting) if setting else None


@cache
def fingerprint(path: str) -> str:
    """Hash of a checkpoint's weights and configuration."""
    files = [resolve_checkpoint(path) / name for name in ("config.json", WEIGHTS)]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]


def observe(scene: BagScene) -> dict[str, Tensor]:
    """What the robot would send, as a LeRobot batch of one."""
    images = {
        f"observation.images.{name}": torch.from_numpy(scene.render(name)).permute(2, 0, 1)[None] / 255.0
        for name in CAMERAS
    }
    return {**images, "observation.state": torch.from_numpy(scene.proprioception())[None]}


def drive(
    scene: BagScene, actor: BasePolicy | LatentSafePolicy | None, operator: Actions | None = None,
    frames: list[np.ndarray] | None = None, steps: int | None = None,
) -> dict:  # fmt: skip
    """One episode of a scene that has just been reset.

    Args:
        actor: a bare policy; a filter, with a base policy or over an operator; None: the operator alone.
        operator: what an operator does, who goes on trying where the filter overrides; None: a policy acts.
        frames: the front camera's pictures of all steps are appended, if given.
        steps: how long it lasts; by default an operator's.

    Returns:
        lost: candies outside at the end; success; grasped: whether the bag was ever held; overridden: steps; first:
        step of the first override or None; cost: CPU seconds of each decision; and step by step: value, margin,
        intervened, spilled (candies outside).
    """
    action, decisions, cost, truths = np.zeros(7), [], [], []
    if actor is not None:
        actor.reset()
    for _ in range(steps or STEPS):
        if frames is not None:
            frames.append(scene.render("front"))
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
        truths.append(scene.truth())
    return {
        "lost": truths[-1]["spilled"],
        "success": truths[-1]["is_success"],
        "grasped": any(truth["grasp"] >= 0 for truth in truths),
        "cost": cost,
        "spilled": [truth["spilled"] for truth in truths],
        **_overrides(decisions),
    }


@torch.no_grad()
def _act(
    actor: BasePolicy | LatentSafePolicy, seen: dict[str, Tensor], proposed: Tensor | None
) -> tuple[Tensor, FilterDecision | None]:
    if isinstance(actor, BasePolicy):
        return actor.propose(seen), None
    decision = actor.decide(seen) if proposed is None else actor.shield(seen, proposed)
    return decision.action, decision


def _overrides(decisions: list[FilterDecision]) -> dict:
    value, margin = ([round(getattr(d, name).item(), 4) for d in decisions] for name in ("value", "margin"))
    intervened = [d.intervened.item() for d in decisions]
    first = intervened.index(True) if any(intervened) else None
    return {"overridden": sum(intervened), "first": first, "value": value, "margin": margin, "intervened": intervened}


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
    parts = [f"{name} {cell[name]['k']}/{cell[name]['n']}" for name in ("spilled", "success")]
    parts.append(f"share lost {cell['mean_share_lost']:.3f}")
    if "overridden_share" in cell:
        parts.append(f"overridden {cell['overridden_share']:.1%}")
    if "decision_cpu_ms" in cell:
        parts.append(f"decision p99 {cell['decision_cpu_ms']['p99']:.1f} CPU-ms")
    return ", ".join(parts)
