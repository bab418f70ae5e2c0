"""Episodes of one scene on disk, small pictures and all, in the order in which they were recorded."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.datasets.cache_layout import write_manifest
from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.frame_cache import FOLDER, FrameCache
from lerobot_latentsafe.datasets.labels import FAILING, SAFE, FailureLabels
from lerobot_latentsafe.envs.franka_env import FrankaEnv
from lerobot_latentsafe.evaluation.rollouts import Choice, steps
from lerobot_latentsafe.experiments.blocks.worlds import EnvironmentsWorld
from lerobot_latentsafe.franka.actions import ACTION_NAMES, STATE_NAMES, action_limits
from lerobot_latentsafe.franka.scene import FrankaScene
from lerobot_latentsafe.pictures import to_model_images
from lerobot_latentsafe.policies.dreamer.behavior import TERMS
from lerobot_latentsafe.robots.franka_mujoco.franka_mujoco import LatentSafeFrankaMujoco
from lerobot_latentsafe.runtime.files import allocate, replacing_folder
from lerobot_latentsafe.units import Units

CAMERA_KEYS = ("observation.images.front", "observation.images.wrist")
Operator = Callable[[dict[str, torch.Tensor]], np.ndarray]
"""Chooses actions (N, 7) in robot units from a LeRobot batch of observations. If it does something else than it meant,
its attribute `meant` holds that."""


def record(envs: list[FrankaEnv], seeds: list[int], operator: Operator, image_size: int) -> list[dict[str, np.ndarray]]:
    """One episode in each environment: arrays by name, a row a frame, as `Replay` stores them.

    Frame t holds o_t, the action taken after it, the one that was meant, whether the episode has failed by then, and
    the reward's terms of arriving there.
    """
    low, high = action_limits(envs[0].metadata["render_fps"])
    previous = [None, None]  # the last two actions (N, 7), in [-1, 1]
    rows: list[dict[str, np.ndarray]] = []
    for step in steps(EnvironmentsWorld(envs, seeds), lambda batch: Choice(np.asarray(operator(batch), np.float32))):
        change = np.zeros(len(envs)) if previous[0] is None else np.square(previous[1] - previous[0]).sum(1)
        terms = [[*(float(info[name]) for name in TERMS[:-1]), rate] for info, rate in zip(step.before, change)]
        rows.append(
            {
                **{key: _small(step.seen[key], image_size) for key in CAMERA_KEYS},
                "state": step.seen["observation.state"].numpy(),
                "action": step.action,
                "meant": getattr(operator, "meant", step.action),
                "failure": np.array([FAILING if info["failure"] else SAFE for info in step.before], np.int8),
                "terms": np.array(terms, np.float32),
            }
        )
        previous = [previous[1], 2 * (step.action - low) / (high - low) - 1]
    return [{name: np.stack([row[name][i] for row in rows]) for name in rows[0]} for i in range(len(envs))]


def _small(images: torch.Tensor, image_size: int) -> np.ndarray:
    return (to_model_images(images, image_size) * 255).round().to(torch.uint8).numpy()


@dataclass
class Replay:
    """Episodes of equal length in memory maps; episode i is written once, or again with the same content.

    Attributes:
        arrays: name -> (n_episodes x length, ...); percepts by camera, state, action, meant, failure, terms.
        percepts: camera -> the same pictures on the device of training.
        written: bool (n_episodes,).
        length: frames of an episode.
    """

    arrays: dict[str, np.memmap]
    percepts: dict[str, torch.Tensor]
    written: np.memmap
    length: int

    @classmethod
    def open(cls, folder: Path, n_episodes: int, length: int, image_size: int, device: str = "cpu") -> "Replay":
        """Open, or make, a replay for so many episodes.

        Raises:
            ValueError: the folder holds one of another size.
        """
        folder.mkdir(parents=True, exist_ok=True)
        n = n_episodes * length
        shapes = {
            **{key: ((n, 3, image_size, image_size), np.uint8) for key in CAMERA_KEYS},
            "state": ((n, len(STATE_NAMES)), np.float32),
            "action": ((n, len(ACTION_NAMES)), np.float32),
            "meant": ((n, len(ACTION_NAMES)), np.float32),
            "failure": ((n,), np.int8),
            "terms": ((n, len(TERMS)), np.float32),
            "written": ((n_episodes,), bool),
        }
        arrays = {}
        for name, (shape, dtype) in shapes.items():
            file = folder / f"{name}.npy"
            if not file.exists():
                allocate(file, dtype, shape)
            arrays[name] = np.load(file, mmap_mode="r+")
            if arrays[name].shape != shape:
                raise ValueError(
                    f"{file} has shape {arrays[name].shape}, expected {shape}: it is of a run with other sizes; choose "
                    "another --output_dir"
                )
        percepts = {key: torch.from_numpy(arrays[key]).to(device) for key in CAMERA_KEYS}
        return cls(arrays, percepts, arrays.pop("written"), length)

    def write(self, i: int, episode: dict[str, np.ndarray]) -> None:
        """Store episode i: when it is told to be written, all of it is on disk."""
        frames = slice(i * self.length, (i + 1) * self.length)
        for name, values in episode.items():
            self.arrays[name][frames] = values
            self.arrays[name].flush()
        for key, pictures in self.percepts.items():
            pictures[frames] = torch.from_numpy(episode[key]).to(pictures.device)
        self.written[i] = True
        self.written.flush()

    def reader(self, n_episodes: int, clip_length: int, units: Units) -> ClipReader:
        """Clips of the first so many episodes, in these units."""
        n = n_episodes * self.length
        labels = FailureLabels(
            self.arrays["failure"][:n], np.zeros(n, np.int8), np.repeat(np.arange(n_episodes), self.length)
        )
        cache = FrameCache({**self.percepts}, {}, self.arrays["state"], self.arrays["action"], {})
        return ClipReader(labels, cache, clip_length, units)

    def contract(self, n_episodes: int, fps: int) -> Contract:
        """What a dataset of the first so many episodes would say of its robot."""
        n, side = n_episodes * self.length, self.arrays[CAMERA_KEYS[0]].shape[-1]
        state, action = (np.array(self.arrays[name][:n]) for name in ("state", "action"))
        cameras = dict.fromkeys(CAMERA_KEYS, (3, side, side))
        episode = np.repeat(np.arange(n_episodes), self.length)
        return Contract(
            "the replay", Path(), LatentSafeFrankaMujoco.name, fps, STATE_NAMES, ACTION_NAMES, cameras, {}, episode,
            state, action,
        )  # fmt: skip


COLUMNS = {
    "observation.state": {"dtype": "float32", "shape": (len(STATE_NAMES),), "names": STATE_NAMES},
    "action": {"dtype": "float32", "shape": (len(ACTION_NAMES),), "names": ACTION_NAMES},
    "failure": {"dtype": "int64", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}
"""LeRobot's features of a replay, without the cameras."""


def export(replay: Replay, n_episodes: int, root: Path, repo_id: str, scene: FrankaScene) -> None:
    """Write episodes as `latentsafe cache` would have: a LeRobotDataset without images, and a frame cache beside it.

    Raises:
        FileExistsError: root exists.
    """
    with replacing_folder(root) as begun:
        _write_dataset(replay, n_episodes, begun, repo_id, scene)
        folder = begun / FOLDER
        folder.mkdir()
        for name in (*CAMERA_KEYS, "state", "action"):
            np.save(folder / f"{name}.npy", replay.arrays[name][: n_episodes * replay.length])
        seen = {key: [scene.image_size, scene.image_size, 3] for key in CAMERA_KEYS}
        kept = {"image_size": replay.arrays[CAMERA_KEYS[0]].shape[-1], "percepts": list(CAMERA_KEYS)}
        write_manifest(begun, LeRobotDatasetMetadata(repo_id, root=begun), seen, kept)


def _write_dataset(replay: Replay, n_episodes: int, root: Path, repo_id: str, scene: FrankaScene) -> None:
    """All but the pictures."""
    dataset = LeRobotDataset.create(
        repo_id, scene.fps, dict(COLUMNS), root=root, robot_type=LatentSafeFrankaMujoco.name, use_videos=False,
        metadata_buffer_size=100,
    )  # fmt: skip
    for t in range(n_episodes * replay.length):
        state, action, failure = (replay.arrays[name][t] for name in ("state", "action", "failure"))
        dataset.add_frame(
            {
                "observation.state": np.array(state),
                "action": np.array(action),
                "failure": np.array([failure], np.int64),
                "next.done": np.array([False]),
                "task": scene.task,
            }
        )
        if (t + 1) % replay.length == 0:
            dataset.save_episode()
    dataset.finalize()
