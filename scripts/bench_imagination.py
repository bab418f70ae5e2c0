"""Imagined environment steps per CPU second: ours against the authors' public code, in one process.

Reachability learns from imagined transitions: a latent, an action, the next latent, its features, margin and whether
the episode has ended. Measured is how many of these each side makes per CPU second, untrained, at these sizes:

    authors  their gymnasium environment `dubins-wm` with its limit of 16 steps an episode: one latent and one action a
             call, reset by encoding two frames of a recorded episode; world model at the sizes of their configs.yaml
    paper    `LatentReachability.imagine` at the same sizes (configs/dubins_rssm_paper.yaml)
    compact  the same with the default RSSMConfig

Why it is fair: both sides step all that their reachability training steps, on the same recorded episodes, in turn, on
the same number of threads, warmed up; resets count on both sides. Ours encodes up to 100,000 frames once and then
draws its starts from them, so `with_resets` divides the transitions of one training run of the default length by the
time they take plus the time of that encoding; `imagine` leaves the encoding out. We imagine the successor of every
candidate action and count each (`imagined`); `along_trajectories` counts only those that a trajectory goes on from.
In favour of the authors: their policy, vector environment, replay buffer and checking wrappers are left out, and their
continuation head is biased to never end an episode before its limit. Untrained it ends every episode after one step;
`authors_reset_each_step` shows that, too. A trained one is in between.

The authors' code is not part of this package. Clone https://github.com/CMU-IntentLab/latent-safety yourself, add what
it imports (pip install gym ruamel.yaml tensorboard wandb), and run

    OMP_NUM_THREADS=1 python scripts/bench_imagination.py --authors=PATH --json=results/dubins/bench_imagination.json
"""

import argparse
import importlib.util
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from bench_rssm import authors_config, authors_frames, authors_modules, fresh_policy, preset, ratio, record, spread
from gymnasium.wrappers import TimeLimit

from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reachability import LatentReachability
from lerobot_latentsafe.training import encoded_starts

ENCODED_FRAMES = 100_000
"""Frames a reachability training encodes at most."""
EPISODE_LIMIT = 16
"""Steps of an imagined episode of the authors."""


def authors_environment(path: Path, reader: ClipReader) -> TimeLimit:
    """Their environment with an untrained world model, resetting from the recorded episodes."""
    authors = authors_modules(path)
    file = path / "PyHJ" / "reach_rl_gym_envs" / "dubins-wm.py"
    specification = importlib.util.spec_from_file_location("dubins_wm", file)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)

    config = authors_config(authors.tools, path)
    config.batch_size, config.batch_length = 1, 2  # as their training script sets them
    env = module.Dubins_WM_Env([config])
    world_model = authors.models.WorldModel(env.observation_space_full, env.action_space, 0, config).eval()
    frames, episode = authors_frames(reader), reader.labels.episode
    episodes = {str(e): {key: values[episode == e] for key, values in frames.items()} for e in np.unique(episode)}
    env.set_wm(world_model, authors.dreamer.make_dataset(episodes, config), config)
    return TimeLimit(env, EPISODE_LIMIT)


def authors_rate(env: TimeLimit, n_steps: int, continues: bool) -> float:
    """Steps per CPU second under random actions, resets included.

    Args:
        continues: whether episodes last until their limit, or one step only.
    """
    bias = env.unwrapped.wm.heads["cont"].mean_layer.bias
    torch.nn.init.constant_(bias, 20.0 if continues else -20.0)
    actions = np.random.default_rng(0).uniform(-1, 1, (n_steps, 1)).astype(np.float32)
    began, over = time.process_time(), True
    for action in actions:
        if over:
            env.reset()
        _, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
    return n_steps / (time.process_time() - began)


def our_learner(policy: LatentSafePolicy, seed: int) -> tuple[LatentReachability, float]:
    """A learner with its starts, and the CPU seconds that encoding one frame for these took."""
    generator = torch.Generator().manual_seed(seed)
    policy.eval()
    began = time.process_time()
    starts = encoded_starts(policy, policy.reader, generator)
    seconds = (time.process_time() - began) / len(policy.reader.labels.failure)
    imagination = policy.imagination
    learner = LatentReachability(imagination, policy.critic, starts, policy.config.reachability, generator)
    return learner, seconds


def rollouts_of_a_run(learner: LatentReachability) -> int:
    """How often a training of the configured length calls `imagine`: to fill the pool, and to renew parts of it."""
    config = learner.config
    return max(1, config.pool // (learner.chunk * learner.kept)) + (config.steps - 1) // config.refresh


def timed(function: Callable) -> tuple[object, float]:
    began = time.process_time()
    result = function()
    return result, time.process_time() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--authors", type=Path, required=True, help="your clone of CMU-IntentLab/latent-safety")
    parser.add_argument("--episodes", type=int, default=60, help="recorded episodes that both reset from (default 60)")
    parser.add_argument("--steps", type=int, default=320, help="the authors' steps a round (default 320)")
    parser.add_argument("--repeats", type=int, default=5, help="timed rounds after one to warm up (default 5)")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch, for all (default 1)")
    parser.add_argument("--seed", type=int, default=0, help="of recording, weights and starts (default 0)")
    parser.add_argument("--json", type=Path, help="where to write the results")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(args.seed)

    learners, encoding = {}, {}
    with tempfile.TemporaryDirectory() as folder:
        record(Path(folder), args.episodes, args.seed)
        for name in ("paper", "compact"):
            config = preset(name)
            policy = fresh_policy(config, Path(folder), config.world_model.clip_length)
            learners[name], encoding[name] = our_learner(policy, args.seed)
            if name == "paper":
                env = authors_environment(args.authors.resolve(), policy.reader)
            print(f"{name} ready", flush=True)

        rate: dict[str, list[float]] = {}
        note = lambda key, value: rate.setdefault(key, []).append(value)  # noqa: E731
        total = {}
        for i in range(1 + args.repeats):
            note("authors", authors_rate(env, args.steps, continues=True))
            note("authors_reset_each_step", authors_rate(env, args.steps // EPISODE_LIMIT, continues=False))
            for name, learner in learners.items():
                rows, seconds = timed(learner.imagine)
                (n, k), calls = rows["next_l"].shape, rollouts_of_a_run(learner)
                whole_run = calls * seconds + ENCODED_FRAMES * encoding[name]
                tail = learner.chunk * (learner.config.horizon - learner.kept)  # one action a step, not all
                total[name] = calls * (n * k + tail)
                note(f"{name}_imagine", (n * k + tail) / seconds)
                note(f"{name}_with_resets", total[name] / whole_run)
                note(f"{name}_along_trajectories_with_resets", calls * (n + tail) / whole_run)
            print(f"round {i} of {args.repeats}", flush=True)
    rate = {name: values[1:] for name, values in rate.items()}  # the first round warms up

    row = {
        "what": "imagined transitions per CPU second (user and system)",
        "rounds": args.repeats,
        "threads": args.threads,
        "over_authors": {name: ratio(values, rate["authors"]) for name, values in rate.items()},
        "steps_per_cpu_second": {name: spread(values) for name, values in rate.items()},
        "encoding_ms_per_frame": {name: seconds * 1000 for name, seconds in encoding.items()},
        "imagined_in_a_training": total,
        "torch": torch.__version__,
        "notes": [
            f"authors: {args.steps} steps a round in episodes of {EPISODE_LIMIT}, none ended by the continuation head; "
            "their policy, vector environment and replay buffer are left out",
            f"with_resets: a training of default length, {ENCODED_FRAMES} frames encoded once for its starts included",
            f"resets on both sides from {args.episodes} recorded episodes",
        ],
        **provenance([args.seed]),
    }
    for name, values in row["steps_per_cpu_second"].items():
        over = row["over_authors"][name]
        print(f"{name:40s} {values['median']:9.0f} a CPU second, {over['median']:7.2f} times the authors'", end=" ")
        print(f"({over['low']:.2f} to {over['high']:.2f})")
    if args.json:
        write_json(args.json, row)


if __name__ == "__main__":
    main()
