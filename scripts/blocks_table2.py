#!/usr/bin/env python
"""Table 2: the blocks' task policy bare, under SQRL, under the latent safety filter, and under the simulator itself.

    scripts/blocks_table2.py --dreamer outputs/blocks/dreamer/policy \
        --filters outputs/blocks/filter/seed_{0,1,2} --risks outputs/blocks/risk/seed_{0,1,2}

All methods start from the same states. Writes table2.json, trade_off.png, unsafe_rollout.png and lead.png to
--output_dir. Each row of rollouts is kept in --cells, so that a killed run goes on where it stopped.
"""

import argparse
import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from lerobot_latentsafe.envs.configuration_envs import LatentSafeBlocksEnv
from lerobot_latentsafe.evaluation.blocks_study import (
    lead,
    leads,
    lookahead_episodes,
    trade_off,
    unsafe_rollout,
    values_along,
)
from lerobot_latentsafe.evaluation.figures import save
from lerobot_latentsafe.evaluation.rollouts import paired_p_value, provenance, wilson, write_json
from lerobot_latentsafe.evaluation.shielding import Episodes, check_environment, run_episodes
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.shield import BasePolicy

FIRST_SEED = 400_000
"""Of the table's starts; training and choices use smaller ones."""
CURVE_SEED = 300_000
"""Of the starts on which thresholds are swept."""
EPSILON = 0.4
RISKS = (0.1, 0.05)
EPSILONS = (-0.4, 0.0, 0.2, 0.4, 0.6, 0.8)
RISK_CURVE = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
OUTCOMES = ("success", "violation", "incompletion")


class Study:
    """Rollouts of one task policy, each kind of them run once and remembered in a file."""

    def __init__(self, dreamer: str, cells: Path):
        self.dreamer, self.cells, self.env = dreamer, cells, LatentSafeBlocksEnv()

    def bare(self, n: int, seed: int) -> dict:
        return self._cell("dreamer", n, seed, lambda: run_episodes(BasePolicy(self.dreamer, "cpu"), self.env, n, seed))

    def lookahead(self, n: int, seed: int) -> dict:
        return self._cell("lookahead", n, seed, lambda: lookahead_episodes(BasePolicy(self.dreamer, "cpu"), n, seed))

    def shielded(self, path: str, epsilon: float, n: int, seed: int) -> dict:
        """Under the filter at a path; of a risk critic, epsilon is -eps_risk."""
        run = lambda: run_episodes(self.filter(path, epsilon), self.env, n, seed)  # noqa: E731
        return self._cell(f"{Path(path).resolve()} {epsilon:g}", n, seed, run)

    def filter(self, path: str, epsilon: float, mode: str = "filter") -> LatentSafePolicy:
        policy = LatentSafePolicy.from_pretrained(path)
        policy.config.epsilon, policy.config.mode = epsilon, mode
        policy.attach(self.dreamer)
        check_environment(policy, self.env)
        return policy

    def _cell(self, name: str, n: int, seed: int, run: Callable[[], Episodes]) -> dict:
        key = hashlib.sha256(f"{Path(self.dreamer).resolve()} {name} {n} {seed}".encode()).hexdigest()[:16]
        file = self.cells / f"{key}.json"
        if not file.exists():
            episodes = run()
            outcome = {k: getattr(episodes, k).tolist() for k in ("success", "violation")}
            outcome["overridden_share"] = float(episodes.overridden.sum() / episodes.steps.sum())
            write_json(file, {"name": name, "n": n, "seed": seed, **outcome})
            print(name, f"success {sum(outcome['success'])}/{n} violation {sum(outcome['violation'])}/{n}", flush=True)
        row = json.loads(file.read_text())
        success, violation = (np.array(row[k], bool) for k in ("success", "violation"))
        return {**row, "success": success, "violation": violation, "incompletion": ~success & ~violation}


def rates(rows: list[dict]) -> dict:
    """Outcomes of all rows together as {k, n, low, high}, and of each."""
    shares = lambda some: {  # noqa: E731
        name: wilson(sum(row[name].sum() for row in some), sum(len(row[name]) for row in some)) for name in OUTCOMES
    }
    overridden = float(np.mean([row["overridden_share"] for row in rows]))
    return {**shares(rows), "overridden_share": overridden, "per_seed": [shares([row]) for row in rows]}


def against(rows: list[dict], bare: dict) -> list[dict]:
    """Exact McNemar tests of each seed's row against the bare policy, start by start."""
    return [{name: paired_p_value(bare[name], row[name]) for name in OUTCOMES} for row in rows]


def lead_times(study: Study, path: str, n: int, seed: int) -> tuple[list[int], int, tuple]:
    """Leads of all failing rollouts, how many failures l missed, and (frames, l, V) of the first one that was led."""
    policy = study.filter(path, EPSILON, mode="monitor")
    found, missed, shown = [], 0, None
    for first in range(0, n, 25):  # few at a time: every frame is kept
        episodes = run_episodes(policy, study.env, min(25, n - first), seed + first, n_videos=25)
        for i in np.flatnonzero(episodes.violation):
            margin, value = values_along(policy, episodes.latents[i])
            steps = lead(margin, value, EPSILON)
            missed += steps is None
            if steps is not None:
                found.append(steps)
                shown = shown or ((episodes.frames[i], margin, value) if steps > 0 else None)
    return found, missed, shown


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dreamer", required=True, help="the task policy")
    parser.add_argument("--filters", nargs="+", required=True, help="latent safety filters, one a seed")
    parser.add_argument("--risks", nargs="+", required=True, help="filters with a risk critic, one a seed")
    parser.add_argument("--n", type=int, default=200, help="starts")
    parser.add_argument("--n_curve", type=int, default=100, help="starts of each point of the curve, first seeds only")
    parser.add_argument("--cells", type=Path, default=Path("outputs/blocks/cells"))
    parser.add_argument("--output_dir", type=Path, default=Path("results/blocks"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    study, n = Study(arguments.dreamer, arguments.cells), arguments.n

    bare = study.bare(n, FIRST_SEED)
    rows = {
        "dreamer": [bare],
        **{f"sqrl_{risk:g}": [study.shielded(p, -risk, n, FIRST_SEED) for p in arguments.risks] for risk in RISKS},
        "latentsafe": [study.shielded(p, EPSILON, n, FIRST_SEED) for p in arguments.filters],
        "lookahead": [study.lookahead(n, FIRST_SEED)],
    }
    methods = {name: {**rates(r), "mcnemar_against_dreamer": against(r, bare)} for name, r in rows.items()}

    n_curve = arguments.n_curve
    at = lambda path, epsilon: rates([study.shielded(path, epsilon, n_curve, CURVE_SEED)])  # noqa: E731
    curves = {
        "latent safety filter (epsilon)": [{"threshold": e, **at(arguments.filters[0], e)} for e in EPSILONS],
        "SQRL (risk)": [{"threshold": r, **at(arguments.risks[0], -r)} for r in RISK_CURVE],
    }
    bare_curve = rates([study.bare(n_curve, CURVE_SEED)])
    save(trade_off(curves, bare_curve), arguments.output_dir / "trade_off.png")

    found, missed, shown = lead_times(study, arguments.filters[0], n, FIRST_SEED)
    lead_row = {"steps": found, "failures_unseen_by_margin": missed}
    if found:
        lead_row |= {"median": float(np.median(found)), "share_of_3_or_more": float(np.mean(np.array(found) >= 3))}
        save(leads(found), arguments.output_dir / "lead.png")
    if shown:
        save(unsafe_rollout(*shown, EPSILON, study.env.fps), arguments.output_dir / "unsafe_rollout.png")
    record = {"methods": methods, "curves": {**curves, "no filter": bare_curve}, "lead": lead_row}
    write_json(arguments.output_dir / "table2.json", {**record, **provenance(seeds=[FIRST_SEED, FIRST_SEED + n - 1])})
    for name, row in methods.items():
        print(name.ljust(12), *(f"{k} {row[k]['k']}/{row[k]['n']}" for k in OUTCOMES), sep="  ")


if __name__ == "__main__":
    main()
