#!/usr/bin/env python
"""What makes a good critic of the bag: each variant's V against a planner that tries far more, in the same imagination.

    scripts/bag_critics.py --policy=<margin> --dataset=data/bag_tokens --held data/held_branches_tokens ...

Trains a critic for each variant and seed on `--dataset` and asks it on states of held-out recordings, as they are and
after three steps of a full-speed rise. Writes results/bag/critics.json: error against the planner's V, safe states that
would be stopped and doomed ones that would pass at `--epsilon`, what following the fallback comes to, and CPU seconds.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_latentsafe.critic import SafetyCritic
from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.latent import Latent, map_latent
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reachability import LatentReachability, look_ahead
from lerobot_latentsafe.training import covered_actions, encoded_starts, load_with_cache

VARIANTS = {
    "as configured": {},
    "16 components": {"components": 16},
    "caution 2": {"caution": 2.0},
    "all 25 imagined steps learned on": {"kept": 25},
    "actor through the world model": {"actor_through": "world_model"},
}
SATURATED = "saturated margin"
"""As configured, with the margin as large as the hinge loss alone leaves it, 2.8 times."""
EVERY, RISE, HORIZON = 5, 3, 25


def states(policy: LatentSafePolicy, held: list[Path]) -> dict[str, Latent]:
    """Latents of held-out frames, and after a rise."""
    rows = []
    for root in held:
        meta = LeRobotDatasetMetadata(f"latentsafe/{root.name.removesuffix('_tokens')}_cache", root=root)
        policy.config.frame_cache = None
        reader = ClipReader.of_dataset(policy.config, meta)
        for episode in np.unique(reader.labels.episode):
            index = np.flatnonzero(reader.labels.episode == episode)
            latents = policy.world_model.encode(reader.cut(index[:1], policy, length=len(index)))
            rows.append(map_latent(latents, lambda t: t[0, 2::EVERY]))
    seen = {key: torch.cat([row[key] for row in rows]) for key in rows[0]}
    risen, up = seen, policy.critic.high
    for _ in range(RISE):
        risen = policy.imagination.step(risen, policy.imagination.complete(risen, up.expand(len(risen["action"]), -1)))
    return {"seen": seen, "after a rise": risen}


def outcome(policy: LatentSafePolicy, latent: Latent, act: Callable[[Latent, int], Tensor]) -> Tensor:
    """Least margin from here on, acting for HORIZON steps: (N,)."""
    worst = policy.imagination.margin(latent)
    for t in range(HORIZON):
        latent = policy.imagination.step(latent, policy.imagination.complete(latent, act(latent, t)))
        worst = torch.minimum(worst, policy.imagination.margin(latent))
    return worst


def planned(policy: LatentSafePolicy, latent: Latent) -> Tensor:
    """The best outcome of many plans: move by some share of the range for some steps, at once or later, then hold."""
    critic, n = policy.critic, len(latent["action"])
    still = policy.normalise_action(policy.hold_action(1))[0]
    moves = critic.high > critic.low
    best = torch.full((n,), -torch.inf)
    plans = [(0, 0, 0.0)] + [(0, steps, -share) for share in (1.0, 0.5, 0.25) for steps in (2, 4, 8, 15, 25)]
    for begin, steps, share in [*plans, (0, 2, 0.5), (0, 5, 0.5), (2, 10, -1.0), (5, 10, -1.0)]:
        bound = critic.high if share > 0 else critic.low
        move = torch.where(moves, still + abs(share) * (bound - still), still)
        act = lambda z, t, m=move, b=begin, s=steps: (m if b <= t < b + s else still).expand(n, -1)  # noqa: E731
        best = torch.maximum(best, outcome(policy, latent, act))
    return best


def score(value: Tensor, truth: Tensor, epsilon: float) -> dict[str, float]:
    safe, doomed = truth > 2 * epsilon, truth < 0
    return {
        "rmse": (value - truth).square().mean().sqrt().item(),
        "bias_where_safe": (value - truth)[safe].mean().item(),
        "safe_stopped": (value[safe] <= epsilon).float().mean().item(),
        "doomed_passed": (value[doomed] > epsilon).float().mean().item(),
    }


@torch.no_grad()
def judge(policy: LatentSafePolicy, critic: SafetyCritic, tests: dict[str, tuple], epsilon: float) -> dict:
    """Every number of one critic."""
    held = critic.held_actions(policy.normalise_action(policy.hold_action(1)))
    imagination, row = policy.imagination, {}
    for name, (latent, truth) in tests.items():
        for lookahead in (0, 5, 15):
            value, _ = look_ahead(imagination, latent, held, lookahead, critic)
            row[f"{name}, lookahead {lookahead}"] = score(value, truth, epsilon)
        followed = outcome(policy, latent, lambda z, t: critic.fallback(imagination.features(z)))
        savable = truth > epsilon
        row[f"{name}, savable states the fallback saves"] = (followed[savable] > epsilon).float().mean().item()
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", required=True, help="world model and margin, as of latentsafe train-margin")
    parser.add_argument("--dataset", type=Path, required=True)
    parser.add_argument("--held", type=Path, nargs="+", required=True)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--variants", nargs="+", choices=[*VARIANTS, SATURATED], default=[*VARIANTS, SATURATED])
    parser.add_argument("--epsilon", type=float, default=0.2)
    parser.add_argument("--output", type=Path, default=Path("results/bag/critics.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    meta = LeRobotDatasetMetadata("latentsafe/bag_cache", root=arguments.dataset)
    table: dict[str, list[dict]] = {}
    for name in arguments.variants:
        for seed in arguments.seeds:
            policy, reader = load_with_cache(arguments.policy, meta, seed)
            policy.requires_grad_(False)
            config = policy.config
            if name == SATURATED:
                policy.margin.net[-1].weight.mul_(2.8)
                policy.margin.net[-1].bias.mul_(2.8)
            config.fallback_low, config.fallback_high = covered_actions(policy, reader, config.reachability.coverage)
            config.reachability = replace(config.reachability, steps=arguments.steps, **VARIANTS.get(name, {}))
            policy.critic = critic = policy.new_critic(None)
            starts = encoded_starts(policy, reader, torch.Generator().manual_seed(seed))
            began = time.process_time()
            learner = LatentReachability(policy.imagination, critic, starts, config.reachability)
            for _ in range(arguments.steps):
                learner.update()
            cpu_s = time.process_time() - began
            with torch.no_grad():
                tests = {k: (z, planned(policy, z)) for k, z in states(policy, arguments.held).items()}
            row = {"seed": seed, "cpu_s": cpu_s, **judge(policy, critic, tests, arguments.epsilon)}
            table.setdefault(name, []).append(row)
            shown = row["after a rise, lookahead 0"]
            print(name, seed, {k: round(v, 3) for k, v in shown.items()}, f"{cpu_s:.0f} CPU-s", flush=True)
            write_json(arguments.output, {"variants": table, **provenance(arguments.seeds)})


if __name__ == "__main__":
    main()
