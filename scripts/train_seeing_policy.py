#!/usr/bin/env python
"""Train a small LeRobot policy that sees by the frozen encoder, from recorded demonstrations.

    scripts/train_seeing_policy.py --dataset=data/bag_weak --output=outputs/bag_diffusion_weak [--steps=8000 ...]

Encodes the demonstrations, adds each camera's view to them, trains with lerobot-train on configs/bag_diffusion.yaml
(further options go there), and writes a policy that makes its view itself. A step that is done is skipped; a killed
training goes on from its last checkpoint.
"""

import argparse
import subprocess
import sys
from pathlib import Path

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_latentsafe.datasets.frame_cache import FOLDER, MANIFEST
from lerobot_latentsafe.perceive import VIEWS, let_see, with_views

BIN = Path(sys.executable).parent
CONFIG = Path(__file__).parents[1] / "configs" / "bag_diffusion.yaml"


def run(command: str, *options: str) -> None:
    subprocess.run([str(BIN / command), *options], check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, required=True, help="folder of the demonstrations")
    parser.add_argument("--repo_id", help="of the demonstrations; by default latentsafe/<folder>")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--components", type=int, default=64, help="of each camera's view")
    arguments, options = parser.parse_known_args()
    repo_id = arguments.repo_id or f"latentsafe/{arguments.dataset.name}"
    LeRobotDatasetMetadata(repo_id, root=arguments.dataset)  # refuse what is no dataset before any work
    cache, seen, trained = (arguments.dataset.with_name(f"{arguments.dataset.name}_{what}") for what in
                            ("tokens", "seen", "policy"))  # fmt: skip
    if not (cache / FOLDER / MANIFEST).exists():
        run(
            "latentsafe", "cache", "--encoder=auto", f"--dataset.repo_id={repo_id}",
            f"--dataset.root={arguments.dataset}", f"--output_dir={cache}",
        )  # fmt: skip
    if not (seen / VIEWS).exists():
        with_views(cache, f"{repo_id}_cache", seen, arguments.components)
    last = trained / "checkpoints" / "last" / "pretrained_model"
    if not last.exists():
        dataset = f"--dataset.repo_id={repo_id}_cache_seen", f"--dataset.root={seen}"
        run("lerobot-train", f"--config_path={CONFIG}", *dataset, f"--output_dir={trained}", *options)
    elif not arguments.output.exists():
        run("lerobot-train", f"--config_path={last / 'train_config.json'}", "--resume=true")
    let_see(last, cache, seen, arguments.output)


if __name__ == "__main__":
    main()
