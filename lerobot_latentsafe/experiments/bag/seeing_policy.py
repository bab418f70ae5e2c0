"""Training a small LeRobot policy that sees by the frozen encoder, from recorded demonstrations of the bag."""

import subprocess
import sys
from pathlib import Path

import draccus
import numpy as np
import torch
from lerobot.common.train_utils import load_training_state, save_checkpoint, update_last_checkpoint
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.dataset_tools import remove_feature
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_ENV_STATE
from tqdm import trange

from lerobot_latentsafe.datasets.frame_cache import FOLDER, MANIFEST, FrameCache
from lerobot_latentsafe.datasets.windows import Windows
from lerobot_latentsafe.policies.grasp_training import AIM, SWITCH, check_seen, let_be_told, let_see, switched, with_aim
from lerobot_latentsafe.runtime.files import replacing_folder
from lerobot_latentsafe.runtime.hub import halve_weights

OPEN_FINGERS = 3
"""How much likelier a frame before the fingers close is drawn: what is hard is to get there."""
CONFIGS = Path(__file__).parents[3] / "configs"
SEES, IS_TOLD = CONFIGS / "bag_diffusion.yaml", CONFIGS / "bag_diffusion_told.yaml"


def drawn_windows(dataset: LeRobotDataset, config: PreTrainedConfig) -> Windows:
    """The windows that a policy asks for, of which those before the fingers close are drawn more often."""
    deltas = resolve_delta_timestamps(config, dataset.meta)
    frames = {key: [round(t * dataset.fps) for t in times] for key, times in deltas.items()}
    windows = Windows(dataset, frames, config.drop_n_last_frames)
    command = windows.columns["action"][:, dataset.meta.features["action"]["names"].index(SWITCH)].numpy()
    still_open = windows.anchors[~switched(command)[windows.anchors]]
    windows.anchors = np.concatenate([windows.anchors, *[still_open] * (OPEN_FINGERS - 1)])
    return windows


def train(config: TrainPipelineConfig, dataset: LeRobotDataset, output_dir: Path) -> Path:
    """Train from the last checkpoint on, if there is one; returns the last checkpoint's policy."""
    torch.manual_seed(config.seed)
    config.policy.pretrained_path = None
    policy = make_policy(config.policy, ds_meta=dataset.meta).train()
    pipelines = make_pre_post_processors(config.policy, dataset_stats=dataset.meta.stats)
    config.optimizer, config.scheduler = policy.config.get_optimizer_preset(), policy.config.get_scheduler_preset()
    optimizer, scheduler = make_optimizer_and_scheduler(config, policy)
    windows = drawn_windows(dataset, policy.config)
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


def encode(dataset: Path, repo_id: str) -> Path:
    """Folder of the token cache of some demonstrations, made unless it is there."""
    meta = LeRobotDatasetMetadata(repo_id, root=dataset)  # refuse what is no dataset before any work
    tokens = dataset.with_name(f"{dataset.name}_tokens")
    if not (tokens / FOLDER / MANIFEST).exists():
        command = [sys.executable, "-m", "lerobot_latentsafe.cli", "cache", "--encoder=auto", "--token_components=0"]
        command += [f"--dataset.repo_id={repo_id}", f"--dataset.root={dataset}"]
        subprocess.run([*command, f"--output_dir={tokens}"], check=True)
    FrameCache.open(tokens, meta)  # refuse what was made of another dataset
    return tokens


def train_seeing_policy(
    dataset: Path, repo_id: str, output: Path, steps: int | None = None, seed: int | None = None, half: bool = False,
    device: str = "cpu",
) -> None:  # fmt: skip
    """Train a policy on demonstrations: one that sees by itself, or one that is told where things are, if they say.

    Args:
        dataset: folder of the demonstrations.
        output: folder of the policy.
        steps, seed: of its training; by default those of the configuration.
        half: store 16-bit weights.
        device: to train on.
    """
    meta = LeRobotDatasetMetadata(repo_id, root=dataset)
    told = OBS_ENV_STATE in meta.features
    config = draccus.parse(TrainPipelineConfig, IS_TOLD if told else SEES, args=[])
    config.steps, config.seed = steps or config.steps, seed or config.seed
    config.policy.device = device
    training = output.with_name(f"{output.name}_training")
    if told:
        blind = without_pictures(dataset, repo_id)
        commands = np.stack(blind.hf_dataset.with_format("numpy")["action"])
        let_be_told(train(config, blind, training), commands, output)
    else:
        _see(config, dataset, repo_id, training, output)
    if half:
        halve_weights(output)


def without_pictures(dataset: Path, repo_id: str) -> LeRobotDataset:
    """Demonstrations as a policy reads them that is told where things are; made unless it is there.

    Raises:
        ValueError: what is there was made of others.
    """
    blind, repo_id_told = dataset.with_name(f"{dataset.name}_told"), f"{repo_id}_told"
    whole = LeRobotDataset(repo_id, root=dataset)
    if not blind.exists():
        with replacing_folder(blind) as folder:
            remove_feature(whole, whole.meta.camera_keys, output_dir=folder, repo_id=repo_id_told)
    told = LeRobotDataset(repo_id_told, root=blind)
    if any(not np.array_equal(told.meta.stats[ACTION][key], of) for key, of in whole.meta.stats[ACTION].items()):
        raise ValueError(f"{blind} was made of other demonstrations than those of {dataset}: delete {blind}")
    return told


def _see(config: TrainPipelineConfig, dataset: Path, repo_id: str, training: Path, output: Path) -> None:
    """Encode demonstrations, learn to aim, train on that, and write a policy that sees by itself."""
    device = config.policy.device
    tokens, seen = encode(dataset, repo_id), dataset.with_name(f"{dataset.name}_seen")
    if not (seen / AIM).exists():
        with_aim(tokens, f"{repo_id}_cache", seen, device=device)
    check_seen(seen, tokens)
    aimed = LeRobotDataset(f"{repo_id}_cache_seen", root=seen)
    let_see(train(config, aimed, training), tokens, seen, output)
