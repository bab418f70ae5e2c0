#!/usr/bin/env python
"""Takes one of LeRobot's own simulated tasks through every step, small: it shows that all steps run, and no more.

    pip install gym-pusht 'pymunk<7'     or: gym-aloha 'dm-control<1.0.38' 'mujoco<3.6'
    scripts/try_gym_task.py --env=pusht --output=outputs/pusht

Records episodes of random motion (failing: the first number of the state is among its largest), trains a world model,
margin and critic for a few steps, trains a tiny ACT, wraps it, and runs it under the filter by lerobot-eval.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import make_env, make_env_config, preprocess_observation
from lerobot.utils.constants import ACTION, OBS_STATE

FAILING = 0.8
"""Quantile of the first number of the state from which on a frame fails."""


def record(env: str, root: Path, n_episodes: int, n_steps: int) -> None:
    """Random targets around the present state, as a LeRobotDataset with the column `failure`."""
    config = make_env_config(env)
    world = next(iter(make_env(config).values()))[0]
    rng, episodes = np.random.default_rng(0), []
    for episode in range(n_episodes):
        seen, frames, drift = preprocess_observation(world.reset(seed=[episode])[0]), [], 0.0
        low, high = world.single_action_space.low, world.single_action_space.high
        for _ in range(n_steps):
            state = seen[OBS_STATE][0].numpy()
            drift = 0.9 * drift + rng.normal(0, 0.01, state.shape) * (high - low)
            action = np.clip(state + drift, low, high).astype(np.float32)
            pictures = {key: value[0].permute(1, 2, 0).numpy() for key, value in seen.items() if "image" in key}
            frames.append({**pictures, OBS_STATE: state, ACTION: action, "task": env})
            seen = preprocess_observation(world.step(action[None])[0])
        episodes.append(frames)
    write(episodes, root, config.fps)


def write(episodes: list[list[dict]], root: Path, fps: int) -> None:
    """Frames as `LeRobotDataset.add_frame` takes them, and the labels of a failure that some of them show."""
    threshold = np.quantile([frame[OBS_STATE][0] for frames in episodes for frame in frames], FAILING)
    features: dict[str, dict] = {"failure": {"dtype": "int64", "shape": (1,), "names": None}}
    for key, value in episodes[0][0].items():
        if "image" in key:
            names = ["height", "width", "channels"]
            features[key] = {"dtype": "image", "shape": value.shape, "names": names}
        elif key != "task":
            names = [f"joint_{i}.pos" for i in range(len(value))]
            features[key] = {"dtype": "float32", "shape": value.shape, "names": names}
    dataset = LeRobotDataset.create("me/task", fps, features, root=root, use_videos=False)
    for frames in episodes:
        for frame in frames:
            dataset.add_frame({**frame, "failure": np.array([int(frame[OBS_STATE][0] > threshold)])})
        dataset.save_episode()
    dataset.finalize()


def commands(env: str, output: Path) -> list[list[str]]:
    """The steps after recording, as a user would type them."""
    data, cache = f"--dataset.root={output}/data", f"--dataset.root={output}/cache"
    cached = ["--dataset.repo_id=me/task_cache", cache]
    trained = "checkpoints/last/pretrained_model"
    short = ["--policy.push_to_hub=false", "--policy.device=cpu", "--steps=50", "--num_workers=0", "--save_freq=50"]
    tiny = ["--policy.dim_model=32", "--policy.n_heads=2", "--policy.dim_feedforward=64", "--policy.n_encoder_layers=1"]
    act = ["--policy.type=act", *tiny, "--policy.chunk_size=10", "--policy.n_action_steps=5", "--batch_size=2"]
    return [
        ["latentsafe", "check-dataset", "--dataset.repo_id=me/task", data],
        ["latentsafe", "cache", "--dataset.repo_id=me/task", data, f"--output_dir={output}/cache"],
        ["lerobot-train", "--policy.type=latentsafe", *cached, f"--policy.frame_cache={output}/cache",
         f"--output_dir={output}/world_model", "--batch_size=8", *short],
        ["latentsafe", "train-reachability", f"--policy.path={output}/world_model/{trained}", *cached,
         f"--output_dir={output}/filter", "--steps=50"],
        ["lerobot-train", *act, "--policy.pretrained_backbone_weights=null", "--policy.use_vae=false",
         "--dataset.repo_id=me/task", data, f"--output_dir={output}/act", *short],
        ["latentsafe", "wrap", f"--policy.path={output}/filter", f"--base_policy_path={output}/act/{trained}",
         f"--output_dir={output}/shielded"],
        ["lerobot-eval", f"--policy.path={output}/shielded", f"--env.type={env}", "--env.episode_length=40",
         "--eval.n_episodes=2", "--eval.batch_size=2", "--eval.use_async_envs=false", "--policy.device=cpu",
         f"--output_dir={output}/eval"],
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="pusht", choices=["pusht", "aloha"])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--n_episodes", type=int, default=10)
    parser.add_argument("--n_steps", type=int, default=40)
    arguments = parser.parse_args()
    record(arguments.env, arguments.output / "data", arguments.n_episodes, arguments.n_steps)
    for name, *options in commands(arguments.env, arguments.output):
        print("$", name, *options, flush=True)
        subprocess.run([Path(sys.executable).with_name(name), *options], check=True)


if __name__ == "__main__":
    main()
