"""CPU time per frame of one world-model training step: ours against the authors' public code, in the same run."""

import importlib
import multiprocessing
import os
import resource
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace

import draccus
import numpy as np
import torch
import yaml
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy

from lerobot_latentsafe.collection.dubins import collect_dubins
from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.datasets.build_cache import build_frame_cache
from lerobot_latentsafe.datasets.labels import FailureLabels
from lerobot_latentsafe.evaluation.statistics import provenance
from lerobot_latentsafe.experiments.dubins.authors import authors_config, authors_frames, authors_modules
from lerobot_latentsafe.experiments.timing import ratio, spread
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

PAPER = Path(__file__).parents[3] / "configs" / "dubins_rssm_paper.yaml"
KEEP_MEMORY = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": str(2**40), "MALLOC_TOP_PAD_": str(2**26)}
"""glibc: freed memory is kept for reuse instead of being given back and faulted in again."""

# -- what all read ---


def record(folder: Path, n_episodes: int, seed: int) -> None:
    """Record random episodes of the car and cache their frames at 128 and 32 pixels."""
    collect_dubins("random", "local/bench", folder / "recorded", n_episodes, seed)
    dataset = LeRobotDataset("local/bench", root=folder / "recorded")
    for size in (128, 32):
        build_frame_cache(dataset, folder / str(size), size)


def recorded(folder: Path, size: int) -> LeRobotDatasetMetadata:
    """The recording with its cache of `size` pixels."""
    return LeRobotDatasetMetadata("local/bench_cache", root=folder / str(size))


def whole_clips(labels: FailureLabels, n: int, length: int) -> np.ndarray:
    """First frames of n clips of `length` frames, one an episode."""
    episodes, start, frames = np.unique(labels.episode, return_index=True, return_counts=True)
    start = start[frames >= length]
    if len(start) < n:
        raise SystemExit(f"{len(start)} of {len(episodes)} episodes hold {length} frames, {n} are needed")
    return start[:n]


# -- ours ---


def preset(name: str) -> LatentSafeConfig:
    """`paper`: configs/dubins_rssm_paper.yaml; `compact`: the default world model."""
    paper = draccus.decode(PreTrainedConfig, yaml.safe_load(PAPER.read_text())["policy"])
    return paper if name == "paper" else LatentSafeConfig(fallback=paper.fallback)


def fresh_policy(config: LatentSafeConfig, folder: Path, clip: int) -> LatentSafePolicy:
    """An untrained filter, made as lerobot-train makes it, that reads clips of `clip` frames from the cache."""
    config.device = "cpu"
    config.change(world_model=replace(config.world_model, clip_length=clip))
    return make_policy(config, ds_meta=recorded(folder, config.world_model.image_size))


@dataclass(frozen=True)
class TrainingCost:
    """What is compared.

    Attributes:
        authors: a clone of CMU-IntentLab/latent-safety.
        batch, clip: clips a batch, and frames a clip, of all.
        repeats: timed rounds after one to warm up.
        threads: of PyTorch, of all.
        seed: of recording and weights.
    """

    authors: Path
    batch: int
    clip: int
    repeats: int
    threads: int
    seed: int


def our_step(name: str, folder: Path, options: TrainingCost) -> Callable[[], None]:
    """One step of lerobot-train."""
    policy = fresh_policy(preset(name), folder, options.clip)
    optimizer_preset = policy.config.get_optimizer_preset()
    optimizer = optimizer_preset.build(policy.get_optim_params())
    batch = {"index": torch.from_numpy(whole_clips(policy.reader.labels, options.batch, options.clip))}
    policy.train()

    def step() -> None:
        loss, _ = policy.forward(batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), optimizer_preset.grad_clip_norm)
        optimizer.step()
        optimizer.zero_grad()

    return step


# -- theirs ---


def authors_step(folder: Path, options: TrainingCost, device: str = "cpu") -> Callable[[], None]:
    """One step of their pre-training loop."""
    authors, gym = authors_modules(options.authors, device), importlib.import_module("gym")
    config = authors_config(authors.tools, options.authors, device)

    authors.dreamer.Dreamer.fill_cache = lambda learner: None  # skip the thousands of figures they draw for a plot
    spaces = {
        "state": gym.spaces.Box(-np.inf, np.inf, (3,)),
        "obs_state": gym.spaces.Box(-1, 1, (2,)),
        "image": gym.spaces.Box(0, 255, (128, 128, 3), np.uint8),
    }
    logger = SimpleNamespace(step=0, scalar=lambda *a: None, write=lambda **k: None)
    action_space = gym.spaces.Box(-config.turnRate, config.turnRate, (1,))
    learner = authors.dreamer.Dreamer(gym.spaces.Dict(spaces), action_space, config, logger, None)
    learner.requires_grad_(False)
    reader = fresh_policy(preset("paper"), folder, options.clip).reader
    window = whole_clips(reader.labels, options.batch, options.clip)[:, None] + np.arange(options.clip)
    batch = {key: values[window] for key, values in authors_frames(reader).items()}
    batch["is_first"][:, 0] = True
    late = 5000  # their margin and continuation losses count from step 3000 on
    return lambda: learner.pretrain_model_only(batch, late)


# -- the comparison ---


def contestant(connection: Connection, name: str, folder: Path, options: TrainingCost) -> None:
    """A process that takes a step when told to and answers with its CPU seconds; in the end with its peak GB."""
    torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    step = authors_step(folder, options) if name == "authors" else our_step(name, folder, options)
    connection.send("ready")
    while connection.recv():
        began = time.process_time()
        step()
        connection.send(time.process_time() - began)
    connection.send(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)


def start_contestant(name: str, environment: dict[str, str], folder: Path, options: TrainingCost) -> Connection:
    """Start a contestant's process with these environment variables added; returns the wire to it."""
    before = dict(os.environ)
    os.environ.update(environment)
    here, there = multiprocessing.get_context("spawn").Pipe()
    multiprocessing.get_context("spawn").Process(
        target=contestant, args=(there, name, folder, options), daemon=True
    ).start()
    there.close()
    os.environ.clear()
    os.environ.update(before)
    here.recv()
    print(f"{name} ready", flush=True)
    return here


def ask(connection: Connection, step: bool = True) -> float:
    """A contestant's answer, to a step or in the end."""
    connection.send(step)
    return connection.recv()


def measure(options: TrainingCost) -> dict:
    """Milliseconds a frame of all contestants, and ratios."""
    with tempfile.TemporaryDirectory() as name:
        cost, memory = compete(Path(name), options)
    for child in multiprocessing.active_children():
        child.join()
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return {
        "what": "CPU milliseconds (user and system) per frame of one world-model training step",
        "batch": options.batch,
        "clip": options.clip,
        "rounds": options.repeats,
        "threads": options.threads,
        "authors_over_paper": ratio(cost["authors"], cost["paper"]),
        "authors_over_compact": ratio(cost["authors"], cost["compact"]),
        "authors_over_paper_both_kept_memory": ratio(cost["authors_kept_memory"], cost["paper_kept_memory"]),
        "authors_kept_memory_over_compact": ratio(cost["authors_kept_memory"], cost["compact"]),
        "ms_per_frame": {name: spread(values) for name, values in cost.items()},
        "peak_memory_gb": memory,
        "torch": torch.__version__,
        "notes": [
            f"all at batches of {options.batch} clips of {options.clip} frames; the paper's are 16 x 64",
            "authors: their pretrain_model_only at step 5000, where all losses count; two defaults naming the GPU were "
            "set to the CPU, and the figures they draw at start were skipped; their torch.compile wraps a module whose "
            "forward is never called, so nothing is compiled",
            f"kept_memory: with {' '.join(f'{k}={v}' for k, v in KEEP_MEMORY.items())}",
        ],
        **provenance([options.seed], cpu_minutes=sum(u.ru_utime + u.ru_stime for u in used) / 60),
    }


def compete(folder: Path, options: TrainingCost) -> tuple[dict[str, list[float]], dict[str, float]]:
    """Milliseconds a frame, round by round, and peak memory in GB, of each contestant."""
    record(folder, 3 * options.batch, options.seed)
    wires = {
        "authors": start_contestant("authors", {}, folder, options),
        "authors_kept_memory": start_contestant("authors", KEEP_MEMORY, folder, options),
        "paper": start_contestant("paper", {}, folder, options),
        "paper_kept_memory": start_contestant("paper", KEEP_MEMORY, folder, options),
        "compact": start_contestant("compact", {}, folder, options),
    }
    cost: dict[str, list[float]] = {name: [] for name in wires}
    for i in range(1 + options.repeats):
        for name, wire in wires.items():
            seconds = ask(wire)
            if i:
                cost[name].append(seconds / (options.batch * options.clip) * 1000)
        print(f"round {i} of {options.repeats}", flush=True)
    return cost, {name: round(ask(wire, step=False), 2) for name, wire in wires.items()}
