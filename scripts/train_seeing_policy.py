#!/usr/bin/env python
"""Train a small LeRobot policy that sees by the frozen encoder, from recorded demonstrations.

    scripts/train_seeing_policy.py --dataset=data/bag_weak --output=outputs/bag_diffusion_weak [--steps=8000]

Encodes the demonstrations, learns to foresee in them where the fingers will close (see lerobot_latentsafe/perceive.py),
trains a policy by configs/bag_diffusion.yaml on that, and writes one that sees it by itself. What is done is skipped,
and a killed training goes on from its last checkpoint.

It takes the steps of lerobot-train: the same configuration, policy, processors, optimiser and checkpoints. Only the
windows come from memory: for a policy as small as this, LeRobot's loader takes most of the time.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import draccus
import numpy as np
import torch
from lerobot.common.train_utils import load_training_state, save_checkpoint, update_last_checkpoint
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.policies.factory import make_policy, make_pre_post_processors
from tqdm import trange

from lerobot_latentsafe.datasets.frame_cache import FOLDER, MANIFEST, FrameCache
from lerobot_latentsafe.datasets.windows import Windows
from lerobot_latentsafe.policies.grasp_prediction import AIM, SWITCH, check_seen, let_see, switched, with_aim
from lerobot_latentsafe.runtime.checkpoint import halve_weights

OPEN_FINGERS = 3
"""How much likelier a frame before the fingers close is drawn: what is hard is to get there."""
CONFIG = Path(__file__).parents[1] / "configs" / "bag_diffusion.yaml"


def train(config: TrainPipelineConfig, dataset: LeRobotDataset, output_dir: Path) -> Path:
    """Returns the last checkpoint's policy."""
    torch.manual_seed(config.seed)
    config.policy.pretrained_path = None
    policy = make_policy(config.policy, ds_meta=dataset.meta).train()
    pipelines = make_pre_post_processors(config.policy, dataset_stats=dataset.meta.stats)
    config.optimizer, config.scheduler = policy.config.get_optimizer_preset(), policy.config.get_scheduler_preset()
    optimizer, scheduler = make_optimizer_and_scheduler(config, policy)
    deltas = resolve_delta_timestamps(policy.config, dataset.meta)
    frames = {key: [round(t * dataset.fps) for t in times] for key, times in deltas.items()}
    windows = Windows(dataset, frames, policy.config.drop_n_last_frames)
    command = windows.columns["action"][:, dataset.meta.features["action"]["names"].index(SWITCH)].numpy()
    still_open = windows.anchors[~switched(command)[windows.anchors]]
    windows.anchors = np.concatenate([windows.anchors, *[still_open] * (OPEN_FINGERS - 1)])
    last, begun = output_dir / "checkpoints" / "last", 0
    if last.exists():
        policy = type(policy).from_pretrained(last / "pretrained_model").train()
        optimizer, scheduler = make_optimizer_and_scheduler(config, policy)
        begun, optimizer, scheduler = load_training_state(last, optimizer, scheduler)
    for step in (progress := trange(begun + 1, config.steps + 1, initial=begun, total=config.steps, unit="step")):
        loss, _ = policy.forward(pipelines[0](windows.draw(config.batch_size)))
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), config.optimizer.grad_clip_norm)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        scheduler.step()
        if step % config.log_freq == 0:
            progress.set_postfix(loss=f"{loss.item():.4f}")
        if step % config.save_freq == 0 or step == config.steps:
            folder = output_dir / "checkpoints" / f"{step:06d}"
            save_checkpoint(folder, step, config, policy, optimizer, scheduler, *pipelines)
            update_last_checkpoint(folder)
    return last / "pretrained_model"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=Path, required=True, help="folder of the demonstrations")
    parser.add_argument("--repo_id", help="of the demonstrations; by default latentsafe/<folder>")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--seed", type=int)
    parser.add_argument("--half", action="store_true", help="store 16-bit weights")
    parser.add_argument("--device", default="cpu", help="to train on")
    arguments = parser.parse_args()
    repo_id = arguments.repo_id or f"latentsafe/{arguments.dataset.name}"
    meta = LeRobotDatasetMetadata(repo_id, root=arguments.dataset)  # refuse what is no dataset before any work
    beside = {what: arguments.dataset.with_name(f"{arguments.dataset.name}_{what}") for what in ("tokens", "seen")}
    if not (beside["tokens"] / FOLDER / MANIFEST).exists():
        command = [sys.executable, "-m", "lerobot_latentsafe.cli", "cache", "--encoder=auto"]
        command += [f"--dataset.repo_id={repo_id}", f"--dataset.root={arguments.dataset}"]
        subprocess.run([*command, f"--output_dir={beside['tokens']}"], check=True)
    FrameCache.open(beside["tokens"], meta)  # refuse what was made of another dataset
    if not (beside["seen"] / AIM).exists():
        with_aim(beside["tokens"], f"{repo_id}_cache", beside["seen"], device=arguments.device)
    check_seen(beside["seen"], beside["tokens"])
    config = draccus.parse(TrainPipelineConfig, CONFIG, args=[])
    config.steps, config.seed = arguments.steps or config.steps, arguments.seed or config.seed
    config.policy.device = arguments.device
    dataset = LeRobotDataset(f"{repo_id}_cache_seen", root=beside["seen"])
    trained = train(config, dataset, arguments.output.with_name(f"{arguments.output.name}_training"))
    let_see(trained, beside["tokens"], beside["seen"], arguments.output)
    if arguments.half:
        halve_weights(arguments.output)


if __name__ == "__main__":
    main()
