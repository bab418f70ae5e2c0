#!/usr/bin/env python
"""How good the failure margin gets with few labels: episodes labelled at random, or in the order the page suggests.

    scripts/label_curve.py --policy=<world model> --root=data/car_cache

Fits fresh margins on the frozen features of a world model. For a clean result train that with --policy.margin_weight=0,
so that no label has shaped its features; the JSON says whether it was. Labels come from the dataset's own column; the
last fifth of the episodes is held out, and scored frame by frame.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.datasets.labels import SAFE
from lerobot_latentsafe.evaluation.rollouts import confusion, provenance, write_json
from lerobot_latentsafe.labeling.suggestions import Suggestion
from lerobot_latentsafe.margin import FailureMargin, hinge_loss
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.training import load_with_cache

SHARES = (0.01, 0.02, 0.05, 0.1, 0.2, 1.0)
ORDERS = {
    "random": None,
    "suggested": lambda margin: Suggestion.of(margin).usefulness,
    "uncertain": lambda margin: -np.sort(np.abs(margin))[:5].mean(),
}
"""What is labelled next: the episodes of the highest score under the margin trained so far."""


@torch.no_grad()
def encode(policy: LatentSafePolicy, reader: ClipReader, length: int) -> torch.Tensor:
    """Features (N, D) of every frame, filtered from the first frame of its episode (at most `length`)."""
    reader.length = length
    start = np.flatnonzero(np.r_[True, np.diff(reader.labels.episode) > 0])
    features = torch.zeros(len(reader.labels.failure), policy.world_model.feature_dim)
    for chunk in np.array_split(start, max(1, len(start) // 64)):
        clip = reader.cut(chunk, policy)
        z = policy.world_model.features(policy.world_model.encode(clip))
        index = torch.from_numpy(chunk)[:, None] + torch.arange(length)
        features[index[clip.valid]] = z[clip.valid]
    return features


def fit(
    features: torch.Tensor, failure: torch.Tensor, policy: LatentSafePolicy, seed: int, steps: int
) -> FailureMargin:
    """A fresh margin on labelled frames, balanced batches of 512."""
    torch.manual_seed(seed)
    config = policy.config
    margin = FailureMargin(features.shape[1], config.margin_hidden, config.margin_layers)
    optimizer = torch.optim.AdamW(margin.parameters(), 3e-3, weight_decay=1e-3)
    classes = [torch.nonzero(failure == value)[:, 0] for value in (0, 1)]
    for _ in range(steps):
        picked = torch.cat([c[torch.randint(len(c), (256,))] for c in classes if len(c)])
        loss = hinge_loss(margin(features[picked]), failure[picked], config.margin_delta)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return margin


def curve(order: str, seed: int, data: dict, policy: LatentSafePolicy, steps: int) -> dict[str, float]:
    """Balanced accuracy on held-out frames after each share of labels."""
    rng, score = np.random.default_rng(seed), ORDERS[order]
    features, failure, episode = data["features"], data["failure"], data["episode"]
    pool, scores = data["pool"], {}
    labelled: list[int] = []
    for share in SHARES:
        rest = rng.permutation(np.setdiff1d(pool, labelled))
        if score is not None and labelled:
            with torch.no_grad():
                l = margin.bounded(features).numpy()  # noqa: F821 (fitted on the smaller share)
            rest = np.array(sorted(rest, key=lambda e: -score(l[data["frames"][e]])))
        labelled += rest[: round(share * len(pool)) - len(labelled)].tolist()
        known = torch.from_numpy(np.isin(episode, labelled))
        margin = fit(features[known], failure[known], policy, seed, steps)
        with torch.no_grad():
            safe = (margin(features[data["held_out"]]) >= 0).numpy()
        scores[f"{share:g}"] = confusion(safe, failure[data["held_out"]].numpy() == SAFE)["balanced_accuracy"]
    return scores


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="dubins")
    parser.add_argument("--repo_id", default="me/car_cache")
    parser.add_argument("--root", required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--output", type=Path, default=Path("results/labels/curve_dubins.json"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)

    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    meta = LeRobotDatasetMetadata(arguments.repo_id, root=arguments.root)
    policy, reader = load_with_cache(arguments.policy, meta)
    episode = reader.labels.episode
    n, longest = episode.max() + 1, int(np.bincount(episode).max())
    features = encode(policy, reader, longest)
    pool = np.arange(int(0.8 * n))
    data = {
        "features": (features - features.mean(0)) / features.std(0).clamp_min(1e-3),
        "failure": torch.from_numpy(reader.labels.failure.astype(np.int64)),
        "episode": episode,
        "pool": pool,
        "frames": {e: np.flatnonzero(episode == e) for e in pool},
        "held_out": torch.from_numpy(episode >= len(pool)),
    }
    curves = {order: [curve(order, s, data, policy, arguments.steps) for s in arguments.seeds] for order in ORDERS}
    for order, rows in curves.items():
        print(order, {share: f"{np.mean([r[share] for r in rows]):.4f}" for share in rows[0]})
    row = {
        "balanced_accuracy": curves,
        "world_model": arguments.policy,
        "labels_shaped_the_features": policy.config.margin_weight > 0,
        "episodes": len(pool),
        **provenance(arguments.seeds),
    }
    write_json(arguments.output, row)


if __name__ == "__main__":
    main()
