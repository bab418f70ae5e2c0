"""Imagined environment steps per CPU second: ours against the authors' public code, in one process."""

import importlib.util
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.wrappers import TimeLimit

from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.evaluation.statistics import provenance
from lerobot_latentsafe.experiments.dubins.authors import authors_config, authors_frames, authors_modules
from lerobot_latentsafe.experiments.dubins.training_cost import fresh_policy, preset, record
from lerobot_latentsafe.experiments.timing import ratio, spread
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
    theirs: Any = env.unwrapped
    bias = theirs.wm.heads["cont"].mean_layer.bias
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
    generator, model = torch.Generator().manual_seed(seed), policy.eval().model
    began = time.process_time()
    starts = encoded_starts(model, policy.reader, generator)
    seconds = (time.process_time() - began) / len(policy.reader.labels.failure)
    config = policy.config.reachability
    return LatentReachability(model.imagination, model.critic, starts, config, generator), seconds


def rollouts_of_a_run(learner: LatentReachability) -> int:
    """How often a training of the configured length calls `imagine`: to fill the pool, and to renew parts of it."""
    config = learner.config
    return max(1, config.pool // (learner.chunk * learner.learned_steps)) + (config.steps - 1) // config.refresh


def imagined_rates(learner: LatentReachability, encoding: float) -> tuple[dict[str, float], int]:
    """Transitions per CPU second, counted in three ways, and how many a training of the configured length makes.

    Args:
        encoding: CPU seconds of a frame.
    """
    began = time.process_time()
    rows = learner.imagine()
    seconds = time.process_time() - began
    (n, k), calls = rows["next_l"].shape, rollouts_of_a_run(learner)
    whole_run = calls * seconds + ENCODED_FRAMES * encoding
    tail = learner.chunk * (learner.config.horizon - learner.learned_steps)  # one action a step, not all
    total = calls * (n * k + tail)
    rates = {
        "imagine": (n * k + tail) / seconds,
        "with_resets": total / whole_run,
        "along_trajectories_with_resets": calls * (n + tail) / whole_run,
    }
    return rates, total


@dataclass(frozen=True)
class ImaginationCost:
    """What is compared.

    Attributes:
        authors: a clone of CMU-IntentLab/latent-safety.
        episodes: recorded ones that both reset from.
        steps: the authors' steps a round.
        repeats: timed rounds after one to warm up.
        threads: of PyTorch, for all.
        seed: of recording, weights and starts.
    """

    authors: Path
    episodes: int
    steps: int
    repeats: int
    threads: int
    seed: int


def measure(options: ImaginationCost) -> dict:
    """Steps per CPU second of all, and ratios."""
    torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    with tempfile.TemporaryDirectory() as folder:
        rate, encoding, total = compete(Path(folder), options)
    return {
        "what": "imagined transitions per CPU second (user and system)",
        "rounds": options.repeats,
        "threads": options.threads,
        "over_authors": {name: ratio(values, rate["authors"]) for name, values in rate.items()},
        "steps_per_cpu_second": {name: spread(values) for name, values in rate.items()},
        "encoding_ms_per_frame": {name: seconds * 1000 for name, seconds in encoding.items()},
        "imagined_in_a_training": total,
        "torch": torch.__version__,
        "notes": [
            f"authors: {options.steps} steps a round in episodes of {EPISODE_LIMIT}, none ended by the continuation "
            "head; their policy, vector environment and replay buffer are left out",
            f"with_resets: a training of default length, {ENCODED_FRAMES} frames encoded once for its starts included",
            f"resets on both sides from {options.episodes} recorded episodes",
        ],
        **provenance([options.seed]),
    }


def compete(folder: Path, options: ImaginationCost) -> tuple[dict[str, list[float]], dict[str, float], dict[str, int]]:
    """Rates round by round, CPU seconds of encoding a frame, and transitions of a training, of each."""
    record(folder, options.episodes, options.seed)
    learners, encoding, total = {}, {}, {}
    for name in ("paper", "compact"):
        config = preset(name)
        policy = fresh_policy(config, folder, config.world_model.clip_length)
        learners[name], encoding[name] = our_learner(policy, options.seed)
        if name == "paper":
            env = authors_environment(options.authors, policy.reader)
        print(f"{name} ready", flush=True)
    rate: dict[str, list[float]] = {}
    for i in range(1 + options.repeats):
        found = {
            "authors": authors_rate(env, options.steps, continues=True),
            "authors_reset_each_step": authors_rate(env, options.steps // EPISODE_LIMIT, continues=False),
        }
        for name, learner in learners.items():
            rates, total[name] = imagined_rates(learner, encoding[name])
            found |= {f"{name}_{kind}": value for kind, value in rates.items()}
        for name, value in found.items():
            rate.setdefault(name, []).append(value)
        print(f"round {i} of {options.repeats}", flush=True)
    return {name: values[1:] for name, values in rate.items()}, encoding, total  # the first round warms up
