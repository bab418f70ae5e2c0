"""Teaching a policy to see where to grasp: a column of a cached dataset, foreseen by a frozen encoder.

A LeRobot policy that reads images trains a network of its own on them. On a small machine it can instead be trained on
what a filter's encoder sees. `with_aim` learns to foresee, from demonstrations, where the arm will be when the fingers
next close, and adds that to a cached dataset; `let_see` makes the trained policy foresee it by itself.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets.dataset_tools import add_features
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.processor import DeviceProcessorStep, PolicyProcessorPipeline
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from lerobot_latentsafe.datasets.frame_cache import FrameCache, FrameCacheError
from lerobot_latentsafe.encoders.perception import PerceptionConfig
from lerobot_latentsafe.policies.grasp_prediction import FewValuedStep, GraspPredictionStep, GraspPredictor
from lerobot_latentsafe.runtime.checkpoint import read_config
from lerobot_latentsafe.runtime.files import refuse_existing, replacing_folder
from lerobot_latentsafe.runtime.processors import load_processors

SWITCH = "gripper.pos"
"""The command whose falling is aimed at."""


AIM = "aim.safetensors"
"""The network, beside the dataset that it was learned on."""


def few_valued(action: np.ndarray) -> dict[str, tuple[float, ...]]:
    """Which commands of (N, A) take two or three values alone, and those."""
    values = {str(i): np.unique(column) for i, column in enumerate(action.T)}
    return {i: tuple(found.tolist()) for i, found in values.items() if 2 <= len(found) <= 3}


def switched(command: np.ndarray) -> np.ndarray:
    """Where a command (N,) is below the middle of its range, as of closed fingers: bool (N,)."""
    return command < (command.min() + command.max()) / 2


def until_switched(state: np.ndarray, command: np.ndarray, episode: np.ndarray) -> np.ndarray:
    """How a state (N, M) changes until a command (N,) next falls below the middle of its range: (N, M).

    Zero where it does not fall any more in the episode (N,) of a frame.
    """
    closed = switched(command)
    falls = closed & np.append(True, ~closed[:-1]) & np.append(False, episode[1:] == episode[:-1])
    index = np.arange(len(state))
    at = np.minimum.accumulate(np.where(falls, index, len(state))[::-1])[::-1]  # the next fall of any episode
    there = np.minimum(at, len(state) - 1)
    known = (at < len(state)) & (episode[there] == episode)
    return np.where(known[:, None], state[there] - state, 0.0).astype(np.float32)


@torch.no_grad()
def foreseen(aim: GraspPredictor, tokens: Tensor, state: Tensor) -> Tensor:
    """The motions (N, M) of many frames, in batches."""
    return torch.cat([aim(*rows) for rows in zip(tokens.split(512), state.split(512))])


def with_aim(
    cache_root: str | Path, repo_id: str, output_dir: str | Path, switch: str = SWITCH,
    moved: Sequence[str] = ("ee_x.pos", "ee_y.pos", "ee_z.pos", "ee_rz.pos"), device: str = "cpu",
) -> LeRobotDataset:  # fmt: skip
    """Copy a token-cached dataset with the aim of each frame as a column that policies read, and the network beside it.

    The aims of every other episode are foreseen by a network that learned from the rest.

    Args:
        switch: the command whose falling, such as the fingers' closing, is aimed at.
        moved: what of proprioception tells the motion until then.

    Raises:
        EncoderMismatchError: the cache holds pictures, no tokens.
        ValueError: no such command, or it hardly ever falls.
    """
    cache, dataset = FrameCache.open(cache_root), LeRobotDataset(repo_id, root=cache_root)
    PerceptionConfig(token_components=0).of_cache(cache.manifest)  # at deployment it sees whole tokens
    move, episode = _motions_until_grasp(cache, dataset, switch, moved)
    move, odd = torch.from_numpy(move).to(device), torch.from_numpy(episode % 2 == 1).to(device)
    if not (move[odd].any() and move[~odd].any()):
        raise ValueError(f"{switch} hardly ever falls in {repo_id}; record more demonstrations, that grasp something")
    (percepts, state), n_cameras = cache.frames(np.arange(len(move)), ["tokens"]), len(cache.manifest["cameras"])
    tokens, state = percepts["tokens"].to(device), state.to(device)
    n_patches, token_dim = tokens.shape[1:]

    def learned_from(frames: Tensor) -> GraspPredictor:
        torch.manual_seed(0)
        aim = GraspPredictor(n_cameras, n_patches, token_dim, state.shape[1], len(moved)).to(device)
        aim.fit(tokens[frames], state[frames], move[frames])
        return aim

    # A policy is to learn from aims as wrong as it will live by: those of frames that the network did not learn from.
    seen = torch.empty(len(move), len(moved))
    for half in (odd, ~odd):
        seen[half.cpu()] = foreseen(learned_from(~half), tokens[half], state[half]).cpu()
    aim = learned_from(torch.ones_like(odd)).cpu()
    seen = aim.in_detail(seen)
    feature = {"dtype": "float32", "shape": (seen.shape[1],), "names": None}
    with replacing_folder(output_dir) as folder:
        copy = add_features(
            dataset, {OBS_ENV_STATE: (seen.numpy(), feature)}, output_dir=folder, repo_id=f"{repo_id}_seen"
        )
        save_file(aim.state_dict(), folder / AIM, metadata={"fingerprint": cache.manifest["fingerprint"]})
    return LeRobotDataset(copy.repo_id, root=output_dir)


def _motions_until_grasp(
    cache: FrameCache, dataset: LeRobotDataset, switch: str, moved: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """How each frame's state moves until the switch next falls (N, M), and the frame's episode (N,)."""
    names, states = (dataset.meta.features[key]["names"] for key in ("action", OBS_STATE))
    if switch not in names or not {*moved} <= {*states}:
        raise ValueError(
            f"{dataset.repo_id} lacks {switch} or one of {', '.join(moved)}, from which to learn where to aim; its "
            f"commands are {', '.join(names)}, its state {', '.join(states)}"
        )
    episode = np.asarray(dataset.hf_dataset.with_format("numpy")["episode_index"])
    where = cache.state[:, [states.index(name) for name in moved]]
    return until_switched(where, cache.action[:, names.index(switch)], episode), episode


def check_seen(seen: str | Path, cache_root: str | Path) -> None:
    """Refuse aims that `with_aim` learned on another dataset than the cache's.

    Raises:
        FrameCacheError
    """
    with safe_open(Path(seen) / AIM, "pt") as file:
        known = (file.metadata() or {}).get("fingerprint")
    expected = FrameCache.open(cache_root).manifest["fingerprint"]
    if known != expected:
        raise FrameCacheError(
            f"{seen} was learned on dataset {known}, {cache_root} holds {expected}; delete {seen} and learn anew"
        )


def let_see(checkpoint: str | Path, cache_root: str | Path, seen: str | Path, output_dir: str | Path) -> None:
    """Write a policy that was trained on such a column so that it makes the column itself, from its cameras.

    Args:
        seen: the dataset that `with_aim` made of the cache.

    Raises:
        FileExistsError: output_dir exists.
        FrameCacheError: `seen` is of another dataset.
    """
    checkpoint, output_dir = Path(checkpoint), Path(output_dir)
    refuse_existing(output_dir)
    check_seen(seen, cache_root)
    cache = FrameCache.open(cache_root)
    manifest = cache.manifest
    # On a CPU wherever it was trained; commands choose another by --policy.device.
    config, cameras = read_config(checkpoint, "cpu"), sorted(manifest["cameras"])
    step = GraspPredictionStep(
        manifest["encoder"], manifest["encoder_hash"], manifest["image_size"], cameras,
        config.robot_state_feature.shape[0], config.env_state_feature.shape[0] // 2,
    )  # fmt: skip
    step.load_state_dict(load_file(Path(seen) / AIM))
    pre, post = load_processors(config, checkpoint, "cpu")
    # After images are batched and on the device, before anything is normalised.
    at = next(i for i, s in enumerate(pre.steps) if isinstance(s, DeviceProcessorStep)) + 1
    pre.steps.insert(at, step)
    _write(config, checkpoint, pre, post, cache.action, output_dir)


def let_be_told(checkpoint: str | Path, action: np.ndarray, output_dir: str | Path) -> None:
    """Write a policy that was trained on where things are, and reads that wherever it runs.

    Args:
        action: (N, A), the demonstrations' commands.

    Raises:
        FileExistsError: output_dir exists.
    """
    checkpoint, output_dir = Path(checkpoint), Path(output_dir)
    refuse_existing(output_dir)
    config = read_config(checkpoint, "cpu")
    _write(config, checkpoint, *load_processors(config, checkpoint, "cpu"), action, output_dir)


def _write(
    config: PreTrainedConfig, checkpoint: Path, pre: PolicyProcessorPipeline, post: PolicyProcessorPipeline,
    action: np.ndarray, output_dir: Path,
) -> None:  # fmt: skip
    """Write weights and processors; commands of two or three values in the data (N, A) take no others."""
    if levels := few_valued(action):
        post.steps.append(FewValuedStep(levels))
    with replacing_folder(output_dir) as folder:
        folder.mkdir()
        config.save_pretrained(folder)
        shutil.copyfile(checkpoint / "model.safetensors", folder / "model.safetensors")
        for pipeline in (pre, post):
            pipeline.save_pretrained(folder)
