#!/usr/bin/env python
"""A scripted operator lifts or swings the bag, bare and under the filter and its baselines, from the same starts.

    scripts/bag_operators.py --policy=<filter> --operators closed_end open_end --n=100

Writes results/bag/operators.json: for each operator and law the episodes that spill, the share of candies lost, steps
overridden, the step of the first override, the CPU time of a decision, and the values of a few episodes step by step;
operators.png beside it draws those of the first law that filters.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from lerobot_latentsafe.envs.bag import BagScene
from lerobot_latentsafe.evaluation.bag import FIRST_SEED, drive, in_short, summary, traces
from lerobot_latentsafe.evaluation.figures import save, value_profiles
from lerobot_latentsafe.evaluation.rollouts import provenance, write_json
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


def episode(scene: BagScene, operator: str, seed: int, policy: LatentSafePolicy | None) -> dict:
    """One episode of an operator, see `drive`."""
    behavior, speed = OPERATORS[operator]
    scene.reset(seed)
    return drive(scene, policy, begin(behavior, scene, speed, np.random.default_rng([0, seed])))


def cell(scene: BagScene, operator: str, n: int, policy: LatentSafePolicy | None) -> dict:
    """All episodes of an operator under one law, and the traces of the first few."""
    rows = [episode(scene, operator, FIRST_SEED + i, policy) for i in range(n)]
    return {**summary(rows, scene.n_candies), "traces": traces(rows)}


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
    policy.config.override(arguments, "epsilon", "guard")
    scene, table = BagScene(), {}
    for operator in arguments.operators:
        for law in arguments.laws:
            if law != "bare":
                policy.config.law = law
            table[f"{operator} {law}"] = row = cell(scene, operator, arguments.n, None if law == "bare" else policy)
            print(operator, law, in_short(row), flush=True)
    if filtering := [law for law in arguments.laws if law != "bare"]:
        panels = {operator: table[f"{operator} {filtering[0]}"]["traces"] for operator in arguments.operators}
        save(value_profiles(panels, policy.config.epsilon, scene.fps), arguments.output.with_suffix(".png"))
    row = {**table, "epsilon": policy.config.epsilon, "guard": policy.config.guard}
    write_json(arguments.output, {**row, **provenance(seeds=[FIRST_SEED, FIRST_SEED + arguments.n - 1])})


if __name__ == "__main__":
    main()
