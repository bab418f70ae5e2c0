#!/usr/bin/env python
"""Train a small LeRobot policy that sees by the frozen encoder, from recorded demonstrations.

    scripts/train_seeing_policy.py --dataset=data/bag_weak --output=outputs/bag_diffusion_weak [--steps=8000]

Encodes the demonstrations, learns to foresee in them where the fingers will close (see
lerobot_latentsafe/policies/grasp_training.py), trains a policy by configs/bag_diffusion.yaml on that, and writes one
that sees it by itself. What is done is skipped, and a killed training goes on from its last checkpoint.

Where the demonstrations say where the bag is (bag_mixed does, as observation.environment_state), the policy is told
that wherever it runs, instead of looking.

It takes the steps of lerobot-train: the same configuration, policy, processors, optimiser and checkpoints. Only the
windows come from memory: for a policy as small as this, LeRobot's loader takes most of the time.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.bag.seeing_policy import train_seeing_policy


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, required=True, help="folder of the demonstrations")
    parser.add_argument("--repo_id", help="of the demonstrations; by default latentsafe/<folder>")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--seed", type=int)
    parser.add_argument("--half", action="store_true", help="store 16-bit weights")
    parser.add_argument("--device", default="cpu", help="to train on")
    given = parser.parse_args()
    repo_id = given.repo_id or f"latentsafe/{given.dataset.name}"
    train_seeing_policy(given.dataset, repo_id, given.output, given.steps, given.seed, given.half, given.device)


if __name__ == "__main__":
    main()
