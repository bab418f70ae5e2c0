"""Makes tests/data/decisions.npz: what each committed filter was shown, and what it decided. See test_decisions.py.

Run it only when a decision is meant to change: `.venv/bin/python tests/record_decisions.py`.
"""

import numpy as np
import torch
from lerobot.envs import make_env, preprocess_observation
from test_decisions import FILE, FILTERS, VARIANTS, decide_all

from lerobot_latentsafe import LatentSafeBagEnv, LatentSafeBlocksEnv, LatentSafeDubinsEnv
from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

ENVS = {"dubins": LatentSafeDubinsEnv, "bag": LatentSafeBagEnv, "blocks": LatentSafeBlocksEnv}
POLICIES = {"dubins": "dubins_diffusion_reckless", "bag": "bag_diffusion_weak", "blocks": "blocks_dreamer"}
"""What drives while observations are recorded: the policies that the filters are meant to shield."""
SEEDS = {"dubins": [700, 701], "bag": [704, 700], "blocks": [300_003, 300_005]}
SKIP = {"dubins": 0, "bag": 66, "blocks": 28}
"""Steps driven before the recording starts: the filters first act some steps later."""
STEPS = {"dubins": 36, "bag": 24, "blocks": 20}


def drive(name: str) -> dict[str, np.ndarray]:
    """Observations (T, 2, ...) of two episodes, at the model's image size, and what the bare policy did (T, 2, A)."""
    torch.manual_seed(0)
    base, policy = BasePolicy.load(POLICIES[name]), LatentSafePolicy.from_pretrained(name)
    env = next(iter(make_env(ENVS[name](), n_envs=2).values()))[0]
    observation, _ = env.reset(seed=SEEDS[name])
    base.reset()
    size, rows = policy.config.world_model.image_size, []
    for t in range(SKIP[name] + STEPS[name]):
        batch = {**preprocess_observation(observation), "task": list(env.call("task_description"))}
        action = base.propose(batch)
        if t >= SKIP[name]:
            row = {"action": action.numpy(), "observation.state": batch["observation.state"].numpy()}
            for key in policy.model.world_model.image_keys:
                small = torch.nn.functional.interpolate(batch[key], (size, size), mode="area")
                row[key] = (small * 255).round().byte().numpy()
            rows.append(row)
        observation, *_ = env.step(action.numpy())
    env.close()
    return {key: np.stack([row[key] for row in rows]) for key in rows[0]}


def main() -> None:
    torch.set_num_threads(1)  # as in tests
    content = {}
    for name in FILTERS:
        seen = drive(name)
        content |= {f"{name}/{key}": value for key, value in seen.items()}
        for variant in VARIANTS:
            for key, value in decide_all(name, variant, seen).items():
                content[f"{name}/{variant}/{key}"] = value
            print(name, variant, np.bincount(content[f"{name}/{variant}/reason"].ravel(), minlength=12))
    FILE.parent.mkdir(exist_ok=True)
    np.savez_compressed(FILE, **content)
    print(f"{FILE}: {FILE.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
