"""Recording the simulated SO-101 in bulk, through the same robot and leader arm as lerobot-record."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.collection.parts import record_in_parts
from lerobot_latentsafe.datasets.labels import FAILING, SAFE
from lerobot_latentsafe.robots.so101_mujoco.config_so101_mujoco import LatentSafeSO101MujocoConfig
from lerobot_latentsafe.robots.so101_mujoco.so101_mujoco import LatentSafeSO101Mujoco
from lerobot_latentsafe.runtime.tasks import Tasks
from lerobot_latentsafe.so101.actions import CAMERAS, EPISODE_SECONDS, FPS, IMAGE_SIZE, NAMES
from lerobot_latentsafe.teleoperators.so101_leader.config_so101_leader import LatentSafeSO101LeaderConfig
from lerobot_latentsafe.teleoperators.so101_leader.so101_leader import LatentSafeSO101Leader

EPISODES_A_PART = 50


@dataclass(frozen=True)
class Part:
    """So many episodes of a behaviour in a dataset of full size; smaller ones keep the proportions."""

    behavior: str
    episodes: int
    interrupted: bool = False


SOURCES: dict[str, tuple[Part, ...]] = {
    "so101_careful": (Part("careful", 150),),
    "so101_reckless": (Part("reckless", 150),),
    "so101_mix": (
        Part("careful", 30), Part("careful", 30, True), Part("reckless", 30), Part("reckless", 60, True),
        Part("dally", 110), Part("wander", 40),
    ),
}  # fmt: skip
"""What `latentsafe collect --source=...` can record of the SO-101."""

# No videos: frames as small as these are read several times as fast on their own.
_IMAGE = {"dtype": "image", "shape": (IMAGE_SIZE, IMAGE_SIZE, 3), "names": ["height", "width", "channels"]}
FEATURES: dict[str, dict] = {
    **{f"observation.images.{camera}": dict(_IMAGE) for camera in CAMERAS},
    "observation.state": {"dtype": "float32", "shape": (len(NAMES),), "names": NAMES},
    "action": {"dtype": "float32", "shape": (len(NAMES),), "names": NAMES},
    "failure": {"dtype": "int64", "shape": (1,), "names": None},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}
"""Of the datasets; labels and rewards are no inputs of a policy (see `labels.py`)."""


def part_of(name: str, episode: int) -> Part:
    """Who moves the arm in an episode: the parts follow each other in a fixed shuffle of the mix, over and over."""
    parts = [part for part in SOURCES[name] for _ in range(part.episodes)]
    return parts[int(np.random.default_rng(0).permutation(len(parts))[episode % len(parts)])]


def collect_so101(
    name: str, repo_id: str, root: str | Path, n_episodes: int | None, seed: int, tasks: Tasks | None = None
) -> LeRobotDataset | None:
    """Record a source, or go on recording it; None records it whole. Episode i depends on the seed and i only.

    Returns, raises:
        See `record_in_parts`; ValueError for an unknown source, too.
    """
    if name not in SOURCES:
        raise ValueError(f"--source is {name!r}; expected one of {', '.join(SOURCES)}")
    n = sum(part.episodes for part in SOURCES[name]) if n_episodes is None else n_episodes
    options = {"source": name, "repo_id": repo_id, "seed": seed}
    record = partial(_record, name, repo_id, seed)
    return record_in_parts(repo_id, root, options, n, record, EPISODES_A_PART, tasks=tasks)


def _record(name: str, repo_id: str, seed: int, episodes: range, root: Path) -> Iterator[None]:
    """Write the dataset of some episodes; yields after each."""
    dataset = LeRobotDataset.create(
        repo_id, FPS, FEATURES, root=root, robot_type=LatentSafeSO101Mujoco.name, use_videos=False,
        metadata_buffer_size=EPISODES_A_PART,
    )  # fmt: skip
    with LatentSafeSO101Mujoco(LatentSafeSO101MujocoConfig()) as robot:
        for episode in episodes:
            robot.reset(1_000_000 * seed + episode)
            for frame in episode_frames(robot, part_of(name, episode), episode):
                dataset.add_frame(frame)
            dataset.save_episode()
            yield
    dataset.finalize()


def episode_frames(robot: LatentSafeSO101Mujoco, part: Part, seed: int) -> Iterator[dict]:
    """The frames of an episode as `LeRobotDataset.add_frame` takes them; the first failing frame and all after fail."""
    failed = False
    with LatentSafeSO101Leader(LatentSafeSO101LeaderConfig(**_options(part), seed=seed)) as leader:
        for _ in range(round(EPISODE_SECONDS * FPS)):
            seen, truth = robot.get_observation(), robot.scene.truth()
            failed |= truth["failure"]
            sent = robot.send_action(leader.get_action())
            after = robot.scene.truth()
            yield {
                **{f"observation.images.{camera}": seen[camera] for camera in CAMERAS},
                "observation.state": np.array([seen[name] for name in NAMES], np.float32),
                "action": np.array([sent[name] for name in NAMES], np.float32),
                "failure": np.array([FAILING if failed else SAFE]),
                "next.reward": np.array([after["reward"]], np.float32),
                "next.success": np.array([after["is_success"] and not failed]),
                # Nothing ends by itself: an episode lasts its time, and its last state could go on.
                "next.done": np.array([False]),
                "task": robot.scene.task,
            }


def _options(part: Part) -> dict:
    return {"behavior": part.behavior, "interrupted": part.interrupted}
