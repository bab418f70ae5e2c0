"""Where to grasp, seen by a frozen encoder, as `observation.environment_state` for any LeRobot policy.

A LeRobot policy that reads images trains a network of its own on them. On a small machine it can instead be trained on
what a filter's encoder sees. Of that, its demonstrations tell what matters: where the arm was when the fingers next
closed. `with_aim` learns to foresee it and adds it to a cached dataset; the step below does the same to live
observations, so that the trained policy runs wherever there are cameras.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lerobot.configs import FeatureType, PipelineFeatureType, PolicyFeature
from lerobot.processor import (
    DeviceProcessorStep,
    ObservationProcessorStep,
    PolicyActionProcessorStep,
    ProcessorStepRegistry,
)
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor, nn
from tqdm import trange

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

SWITCH = "gripper.pos"
"""The command whose falling is aimed at."""
AIM = "aim.safetensors"
"""The network, beside the dataset that it was learned on."""
KEYPOINTS, HIDDEN, DROPOUT = 16, 128, 0.1
STEPS, LEARNING_RATE = 4000, 3e-3
SMALL = 0.2
"""Motions below this share of their deviation are shown enlarged: a policy that goes down 20 mm beside is of no use."""
MOSTLY, RARELY = 112, 16
"""Frames of a batch from before the fingers close, the few that matter, and of any frames."""


class Aim(nn.Module):
    """How the hand will move until the fingers next close, foreseen from a frame.

    Each camera's patches vote for the places of a few learned keypoints (a spatial softmax): what is learned of an
    object in one place then holds in others, which components of whole pictures would have to be shown.

    Args:
        n_cameras, n_patches, token_dim: of the tokens (N, n_patches, token_dim) of all cameras.
        state_dim: S, of proprioception.
        n_moves: M, numbers that tell a motion.
    """

    def __init__(self, n_cameras: int, n_patches: int, token_dim: int, state_dim: int, n_moves: int):
        super().__init__()
        side = round(n_patches**0.5)
        places = torch.linspace(-1, 1, side)
        self.places = torch.cartesian_prod(places, places)
        self.votes = nn.ModuleList([nn.Linear(token_dim // n_cameras, KEYPOINTS) for _ in range(n_cameras)])
        self.head = nn.Sequential(
            nn.Linear(n_cameras * KEYPOINTS * 2 + state_dim, HIDDEN),
            nn.ReLU(),
            nn.Dropout(DROPOUT),
            nn.Linear(HIDDEN, n_moves),
        )
        for name, size in {"token": token_dim, "state": state_dim, "move": n_moves}.items():
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_std", torch.ones(size))

    def forward(self, tokens: Tensor, state: Tensor) -> Tensor:
        """Tokens (N, P, C) and proprioception (N, S) -> the motion (N, M), in the units of proprioception."""
        tokens = (tokens - self.token_mean) / self.token_std
        cameras = tokens.chunk(len(self.votes), -1)
        places = self.places.to(tokens)
        points = [
            torch.einsum("npk,pd->nkd", vote(part).softmax(1), places).flatten(1)
            for vote, part in zip(self.votes, cameras)
        ]
        moves = self.head(torch.cat([*points, (state - self.state_mean) / self.state_std], -1))
        return moves * self.move_std + self.move_mean

    def in_detail(self, moves: Tensor) -> Tensor:
        """Motions (N, M) as policies read them (N, 2M): as they are, and enlarged where they are small."""
        return torch.cat([moves, (moves / (SMALL * self.move_std)).tanh()], -1)

    def fit(self, tokens: Tensor, state: Tensor, move: Tensor) -> None:
        """Learn from frames: tokens (N, P, C), proprioception (N, S), the motion that came (N, M)."""
        self.token_mean.copy_(tokens.mean((0, 1)))
        self.token_std.copy_(tokens.std((0, 1)).clamp(min=1e-4))
        self.state_mean.copy_(state.mean(0))
        self.state_std.copy_(state.std(0).clamp(min=1e-3))
        optimizer = torch.optim.AdamW(self.parameters(), LEARNING_RATE, weight_decay=1e-2)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
        self.train()
        before = move.any(-1).nonzero()[:, 0]
        self.move_mean.copy_(move[before].mean(0))
        self.move_std.copy_(move[before].std(0).clamp(min=1e-3))
        for _ in trange(STEPS, desc="aim", unit="step"):
            drawn, any_frames = torch.randint(len(before), (MOSTLY,)), torch.randint(len(state), (RARELY,))
            rows = torch.cat([before[drawn.to(before.device)], any_frames.to(before.device)])
            error = (self(tokens[rows], state[rows]) - move[rows]) / self.move_std
            loss = error.square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        self.eval()


@ProcessorStepRegistry.register("latentsafe_perceive")
class PerceiveStep(ObservationProcessorStep):
    """Adds the aim to an observation whose images are tensors.

    Args:
        encoder, encoder_hash: see `PerceptionConfig`.
        image_size: side to which images (B, 3, H, W) in [0, 1] are area-averaged.
        cameras: their keys in the observation.
        state_dim, n_moves: see `Aim`.
    """

    def __init__(
        self, encoder: str, encoder_hash: str, image_size: int, cameras: list[str], state_dim: int, n_moves: int
    ):
        from lerobot_latentsafe.encoders.perception import Perception, PerceptionConfig

        self.config = PerceptionConfig(encoder=encoder, encoder_hash=encoder_hash)
        self.perception = Perception(self.config, cameras, image_size)
        self.sizes = {"state_dim": state_dim, "n_moves": n_moves}
        self.aim = Aim(len(cameras), self.perception.n_patches, self.perception.token_dim, **self.sizes).eval()

    @torch.no_grad()
    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        from lerobot_latentsafe.datasets.frame_cache import to_model_images

        perception = self.perception
        missing = [key for key in (*perception.image_keys, OBS_STATE) if key not in observation]
        if missing:
            raise KeyError(
                f"observation lacks {', '.join(missing)}, which this policy sees by; got {', '.join(observation)}"
            )
        images = {key: to_model_images(observation[key], perception.image_size) for key in perception.image_keys}
        tokens = perception.tokens(images)
        aim = self.aim.to(tokens.device)
        return {**observation, OBS_ENV_STATE: aim.in_detail(aim(tokens, observation[OBS_STATE]))}

    def get_config(self) -> dict[str, Any]:
        return {
            "encoder": self.config.encoder,
            "encoder_hash": self.config.encoder_hash,
            "image_size": self.perception.image_size,
            "cameras": self.perception.image_keys,
            **self.sizes,
        }

    def state_dict(self) -> dict[str, Tensor]:
        return {name: value.clone() for name, value in self.aim.state_dict().items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.aim.load_state_dict(state)

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        seen = PolicyFeature(FeatureType.ENV, (2 * self.sizes["n_moves"],))
        observed = {**features.get(PipelineFeatureType.OBSERVATION, {}), OBS_ENV_STATE: seen}
        return {**features, PipelineFeatureType.OBSERVATION: observed}


@ProcessorStepRegistry.register("latentsafe_two_valued")
class TwoValuedStep(PolicyActionProcessorStep):
    """Commands that only ever took two values in the demonstrations, as of fingers, are given as the nearer one.

    A denoised command falls a little short of them. The robot follows, and a policy that reads how far its fingers have
    closed, never having seen them in between, takes that for the beginning of a grasp, and closes on nothing.

    Args:
        levels: index of a command -> its two values.
    """

    def __init__(self, levels: dict[str, tuple[float, float]]):
        self.levels = levels

    def action(self, action: Tensor) -> Tensor:
        """(..., A) -> (..., A)."""
        action = action.clone()
        for index, (low, high) in self.levels.items():
            command = action[..., int(index)]
            action[..., int(index)] = torch.where(command < (low + high) / 2, low, high)
        return action

    def get_config(self) -> dict[str, Any]:
        return {"levels": self.levels}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


def two_valued(action: np.ndarray) -> dict[str, tuple[float, float]]:
    """Which commands of (N, A) take two values alone, and those."""
    values = {str(i): np.unique(column) for i, column in enumerate(action.T)}
    return {i: (float(found[0]), float(found[1])) for i, found in values.items() if len(found) == 2}


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
def foreseen(aim: Aim, tokens: Tensor, state: Tensor) -> Tensor:
    """The motions (N, M) of many frames, in batches."""
    return torch.cat([aim(*rows) for rows in zip(tokens.split(512), state.split(512))])


def with_aim(
    cache_root: str | Path, repo_id: str, output_dir: str | Path, switch: str = SWITCH,
    moved: Sequence[str] = ("ee_x.pos", "ee_y.pos", "ee_z.pos", "ee_rz.pos"), device: str = "cpu",
) -> "LeRobotDataset":  # fmt: skip
    """Copy a token-cached dataset with the aim of each frame as a column that policies read, and the network beside it.

    The aims of every other episode are foreseen by a network that learned from the rest.

    Args:
        switch: the command whose falling, such as the fingers' closing, is aimed at.
        moved: what of proprioception tells the motion until then.

    Raises:
        FrameCacheError: the cache holds no tokens.
        ValueError: no such command, or it hardly ever falls.
    """
    from lerobot.datasets.dataset_tools import add_features
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from safetensors.torch import save_file

    from lerobot_latentsafe.datasets.frame_cache import FrameCache
    from lerobot_latentsafe.encoders.perception import PerceptionConfig

    cache, dataset = FrameCache.open(cache_root), LeRobotDataset(repo_id, root=cache_root)
    PerceptionConfig().adopt_cache(cache.manifest)
    names, states = (dataset.meta.features[key]["names"] for key in ("action", OBS_STATE))
    if switch not in names or not {*moved} <= {*states}:
        raise ValueError(
            f"{repo_id} lacks {switch} or one of {', '.join(moved)}, from which to learn where to aim; its commands "
            f"are {', '.join(names)}, its state {', '.join(states)}"
        )
    episode = np.asarray(dataset.hf_dataset.with_format("numpy")["episode_index"])
    where = cache.state[:, [states.index(name) for name in moved]]
    move = torch.from_numpy(until_switched(where, cache.action[:, names.index(switch)], episode)).to(device)
    odd = torch.from_numpy(episode % 2 == 1).to(device)
    if not (move[odd].any() and move[~odd].any()):
        raise ValueError(f"{switch} hardly ever falls in {repo_id}; record more demonstrations, that grasp something")
    (percepts, state), n_cameras = cache.frames(np.arange(len(move)), ["tokens"]), len(cache.manifest["cameras"])
    tokens, state = percepts["tokens"].to(device), state.to(device)

    def learned_from(frames: Tensor) -> Aim:
        torch.manual_seed(0)
        aim = Aim(n_cameras, *tokens.shape[1:], state.shape[1], len(moved)).to(device)
        aim.fit(tokens[frames], state[frames], move[frames])
        return aim

    # A policy is to learn from aims as wrong as it will live by: those of frames that the network did not learn from.
    seen = torch.empty(len(move), len(moved))
    for half in (odd, ~odd):
        seen[half.cpu()] = foreseen(learned_from(~half), tokens[half], state[half]).cpu()
    aim = learned_from(torch.ones_like(odd)).cpu()
    seen = aim.in_detail(seen)
    feature = {"dtype": "float32", "shape": (seen.shape[1],), "names": None}
    copy = add_features(
        dataset, {OBS_ENV_STATE: (seen.numpy(), feature)}, output_dir=output_dir, repo_id=f"{repo_id}_seen"
    )
    save_file(aim.state_dict(), Path(output_dir) / AIM, metadata={"fingerprint": cache.manifest["fingerprint"]})
    return copy


def check_seen(seen: str | Path, cache_root: str | Path) -> None:
    """Refuse aims that `with_aim` learned on another dataset than the cache's.

    Raises:
        FrameCacheError
    """
    from safetensors import safe_open

    from lerobot_latentsafe.datasets.frame_cache import FrameCache, FrameCacheError

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
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors
    from safetensors.torch import load_file

    from lerobot_latentsafe.datasets.frame_cache import FrameCache

    checkpoint, output_dir = Path(checkpoint), Path(output_dir)
    if output_dir.exists():
        raise FileExistsError(f"{output_dir} exists; choose another folder or delete it")
    check_seen(seen, cache_root)
    cache = FrameCache.open(cache_root)
    manifest = cache.manifest
    config, cameras = PreTrainedConfig.from_pretrained(checkpoint), sorted(manifest["cameras"])
    config.device = "cpu"  # wherever it was trained; commands choose another by --policy.device
    step = PerceiveStep(
        manifest["encoder"], manifest["encoder_hash"], manifest["image_size"], cameras,
        config.robot_state_feature.shape[0], config.env_state_feature.shape[0] // 2,
    )  # fmt: skip
    step.load_state_dict(load_file(Path(seen) / AIM))
    elsewhere = {"device_processor": {"device": "cpu"}}
    pre, post = make_pre_post_processors(config, pretrained_path=checkpoint, preprocessor_overrides=elsewhere)
    # After images are batched and on the device, before anything is normalised.
    at = next(i for i, s in enumerate(pre.steps) if isinstance(s, DeviceProcessorStep)) + 1
    pre.steps.insert(at, step)
    if levels := two_valued(cache.action):
        post.steps.append(TwoValuedStep(levels))
    output_dir.mkdir(parents=True)
    config.save_pretrained(output_dir)
    shutil.copyfile(checkpoint / "model.safetensors", output_dir / "model.safetensors")
    for pipeline in (pre, post):
        pipeline.save_pretrained(output_dir)
