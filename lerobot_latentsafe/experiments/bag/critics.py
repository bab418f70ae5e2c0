"""What makes a good critic of the bag: each variant's V against a planner that tries more, in the same imagination."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_latentsafe.critic import SafetyCritic
from lerobot_latentsafe.datasets.clips import ClipReader, FilterData
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.latent import Latent, map_latent
from lerobot_latentsafe.reachability import LatentReachability, look_ahead
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.training import covered_actions, encoded_starts, load_with_cache

VARIANTS: dict[str, dict] = {
    "as configured": {},
    "16 components": {"components": 16},
    "caution 2": {"caution": 2.0},
    "all 25 imagined steps learned on": {"learned_steps": 25},
    "actor through the world model": {"actor_through": "world_model"},
}
"""Name -> what differs in the configuration of reachability."""
SATURATED = "saturated margin"
"""As configured, with the margin as large as the hinge loss alone leaves it, 2.8 times."""
EVERY, RISE, HORIZON = 5, 3, 25


def states(model: SafetyModel, held: list[Path]) -> dict[str, Latent]:
    """Latents of held-out frames, and after a rise."""
    rows = []
    for root in held:
        reader = _reader(model, root)
        for episode in np.unique(reader.labels.episode):
            index = np.flatnonzero(reader.labels.episode == episode)
            clip = reader.cut(index[:1], model.world_model, length=len(index))
            rows.append(map_latent(model.world_model.encode(clip), lambda t: t[0, 2::EVERY]))
    seen = {key: torch.cat([row[key] for row in rows]) for key in rows[0]}
    risen, up = seen, model.critic.high
    for _ in range(RISE):
        risen = model.imagination.step(risen, model.imagination.complete(risen, up.expand(len(risen["action"]), -1)))
    return {"seen": seen, "after a rise": risen}


def _reader(model: SafetyModel, root: Path) -> ClipReader:
    """Of the cache of a held-out recording."""
    meta, config = (
        LeRobotDatasetMetadata(f"latentsafe/{root.name.removesuffix('_tokens')}_cache", root=root),
        model.config,
    )
    specification, size = config.margin.failure_specification, config.world_model.image_size
    data = FilterData.open(meta, specification, None, size, config.trained_on.cameras)
    return data.reader(config.world_model, model.units)


def outcome(model: SafetyModel, latent: Latent, act: Callable[[Latent, int], Tensor]) -> Tensor:
    """Least margin from here on, acting for HORIZON steps: (N,)."""
    worst = model.imagination.margin(latent)
    for t in range(HORIZON):
        latent = model.imagination.step(latent, model.imagination.complete(latent, act(latent, t)))
        worst = torch.minimum(worst, model.imagination.margin(latent))
    return worst


def planned(model: SafetyModel, latent: Latent) -> Tensor:
    """The best outcome of many plans: move by some share of the range for some steps, at once or later, then hold."""
    critic, n = model.critic, len(latent["action"])
    still = _hold(model)[0]
    moves = critic.high > critic.low
    best = torch.full((n,), -torch.inf)
    plans = [(0, 0, 0.0)] + [(0, steps, -share) for share in (1.0, 0.5, 0.25) for steps in (2, 4, 8, 15, 25)]
    for begin, steps, share in [*plans, (0, 2, 0.5), (0, 5, 0.5), (2, 10, -1.0), (5, 10, -1.0)]:
        bound = critic.high if share > 0 else critic.low
        move = torch.where(moves, still + abs(share) * (bound - still), still)
        act = lambda z, t, m=move, b=begin, s=steps: (m if b <= t < b + s else still).expand(n, -1)  # noqa: E731
        best = torch.maximum(best, outcome(model, latent, act))
    return best


def _hold(model: SafetyModel) -> Tensor:
    """Holding still, (1, A) in [-1, 1]."""
    return model.units.still


def score(value: Tensor, truth: Tensor, epsilon: float) -> dict[str, float]:
    """How far V is off, and what that would do at a threshold."""
    safe, doomed = truth > 2 * epsilon, truth < 0
    return {
        "rmse": (value - truth).square().mean().sqrt().item(),
        "bias_where_safe": (value - truth)[safe].mean().item(),
        "safe_stopped": (value[safe] <= epsilon).float().mean().item(),
        "doomed_passed": (value[doomed] > epsilon).float().mean().item(),
    }


@torch.no_grad()
def judge(model: SafetyModel, critic: SafetyCritic, tests: dict[str, tuple], epsilon: float) -> dict:
    """Every number of one critic."""
    held = critic.held_actions(_hold(model))
    imagination, row = model.imagination, {}
    for name, (latent, truth) in tests.items():
        for lookahead in (0, 5, 15):
            value, _ = look_ahead(imagination, latent, held, lookahead, critic)
            row[f"{name}, lookahead {lookahead}"] = score(value, truth, epsilon)
        followed = outcome(model, latent, lambda z, t: critic.fallback(imagination.features(z)))
        savable = truth > epsilon
        row[f"{name}, savable states the fallback saves"] = (followed[savable] > epsilon).float().mean().item()
    return row


def train_variant(
    path: str, meta: LeRobotDatasetMetadata, name: str, seed: int, steps: int
) -> tuple[SafetyModel, float]:
    """The model with a critic of a variant, and the CPU seconds that its training took."""
    policy, reader = load_with_cache(path, meta, seed)
    model, config = policy.model.requires_grad_(False), policy.config
    if name == SATURATED:
        for parameter in model.margin.net[-1].parameters():
            parameter.mul_(2.8)
    low, high = covered_actions(model, reader, config.reachability.coverage)
    config.change(
        fallback=replace(config.fallback, low=low, high=high),
        reachability=replace(config.reachability, steps=steps, **VARIANTS.get(name, {})),
    )
    model.critic = model.new_critic()
    starts = encoded_starts(model, reader, torch.Generator().manual_seed(seed))
    began = time.process_time()
    learner = LatentReachability(model.imagination, model.critic, starts, config.reachability)
    for _ in range(steps):
        learner.update()
    return model, time.process_time() - began


def compare_critics(
    path: str, dataset: Path, held: list[Path], variants: list[str], seeds: list[int], steps: int, epsilon: float,
    output: Path,
) -> None:  # fmt: skip
    """Train a critic for each variant and seed, judge it, and write the table after each.

    Args:
        path: of a filter with world model and margin.
        dataset: folder of the token cache to train on.
        held: folders of caches to judge on.
        variants: names in VARIANTS, or SATURATED.
        epsilon: the threshold.
        output: of the table, .json.
    """
    torch.set_num_threads(1)
    meta = LeRobotDatasetMetadata("latentsafe/bag_cache", root=dataset)
    table: dict[str, list[dict]] = {}
    for name in variants:
        for seed in seeds:
            model, cpu_s = train_variant(path, meta, name, seed, steps)
            with torch.no_grad():
                tests = {k: (z, planned(model, z)) for k, z in states(model, held).items()}
            row = {"seed": seed, "cpu_s": cpu_s, **judge(model, model.critic, tests, epsilon)}
            table.setdefault(name, []).append(row)
            shown = row["after a rise, lookahead 0"]
            print(name, seed, {k: round(v, 3) for k, v in shown.items()}, f"{cpu_s:.0f} CPU-s", flush=True)
            write_json(output, {"variants": table, **provenance(seeds)})
