"""CPU time per frame of one world-model training step: ours against the authors' public code, in the same run.

Measured: everything a training step does with a batch that is already drawn as 8-bit frames - conversion to float,
encoder, filtering, decoders, KL, continuation and margin losses, backward pass, gradient clipping, Adam.

    authors  their `pretrain_model_only` with their world model, at the sizes of their configs.yaml
    paper    ours at the same sizes (configs/dubins_rssm_paper.yaml): what lerobot-train does in a step
    compact  the same with the default RSSMConfig; the frame cache has averaged the same frames to 32 x 32

Why it is fair: all train on the same clips of the same recorded episodes with batches of the same shape, each in a
process of its own as its user would run it, but in turn and never two at once, on the same number of threads, and
warmed up. CPU time is counted, user and system. Allocating large activations costs much system time, which environment
variables of glibc avoid; so `*_kept_memory` repeats authors and paper with these set.

The authors' code is not part of this package. Clone https://github.com/CMU-IntentLab/latent-safety yourself, add what
it imports (pip install gym ruamel.yaml tensorboard wandb), and run

    OMP_NUM_THREADS=1 python scripts/bench_rssm.py --authors=PATH --json=results/dubins/bench_rssm.json
"""

import argparse
import multiprocessing
import os
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
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
from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.datasets.labels import FailureLabels
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

CAMERA = "observation.image"
PAPER = Path(__file__).parents[1] / "configs" / "dubins_rssm_paper.yaml"
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
    return paper if name == "paper" else LatentSafeConfig(action_candidates=paper.action_candidates)


def fresh_policy(config: LatentSafeConfig, folder: Path, clip: int) -> LatentSafePolicy:
    """An untrained filter, made as lerobot-train makes it, that reads clips of `clip` frames from the cache."""
    config.device, config.world_model.clip_length = "cpu", clip
    return make_policy(config, ds_meta=recorded(folder, config.world_model.image_size))


def our_step(name: str, folder: Path, args: argparse.Namespace) -> Callable[[], None]:
    """One step of lerobot-train."""
    policy = fresh_policy(preset(name), folder, args.clip)
    optimizer_preset = policy.config.get_optimizer_preset()
    optimizer = optimizer_preset.build(policy.get_optim_params())
    batch = {"index": torch.from_numpy(whole_clips(policy.reader.labels, args.batch, args.clip))}
    policy.train()

    def step() -> None:
        loss, _ = policy.forward(batch)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), optimizer_preset.grad_clip_norm)
        optimizer.step()
        optimizer.zero_grad()

    return step


# -- theirs, from a checkout the user provides ---


def authors_modules(path: Path) -> SimpleNamespace:
    """Import the authors' modules `models`, `tools` and `dreamer_offline`, made to run without a GPU."""
    missing = [name for name in ("configs.yaml", "dreamerv3-torch", "scripts") if not (path / name).exists()]
    if missing:
        raise SystemExit(f"--authors={path} lacks {', '.join(missing)}; give a clone of CMU-IntentLab/latent-safety")
    sys.path[:0] = [str(path / folder) for folder in ("dreamerv3-torch", "scripts", ".")]
    try:
        import dreamer_offline
        import models
        import networks
        import tools
    except ImportError as e:
        raise SystemExit(f"the authors' code needs {e.name}: pip install gym ruamel.yaml tensorboard wandb") from e
    # Two defaults name the GPU and are not reached by their `device` option.
    networks.MLP.__init__.__defaults__ = tuple("cpu" if d == "cuda" else d for d in networks.MLP.__init__.__defaults__)
    return SimpleNamespace(models=models, tools=tools, dreamer=dreamer_offline)


def authors_config(tools, path: Path) -> argparse.Namespace:
    """Their configs.yaml as their scripts read it, on the CPU and without videos."""
    import ruamel.yaml

    defaults = ruamel.yaml.YAML(typ="safe", pure=True).load((path / "configs.yaml").read_text())["defaults"]
    config = argparse.Namespace(**{key: tools.args_type(value)(value) for key, value in defaults.items()})
    config.device, config.video_pred_log, config.num_actions = "cpu", False, 1
    return config


def authors_frames(reader: ClipReader) -> dict[str, np.ndarray]:
    """Recorded frames under the names and in the shapes their scripts give them."""
    labels, n = reader.labels, len(reader.labels.episode)
    over = labels.terminal == 1
    return {
        "image": np.moveaxis(np.asarray(reader.cache.percepts[CAMERA]), 1, -1),
        "obs_state": reader.cache.state,
        "action": reader.cache.action[:, :1],
        "is_first": np.append(True, np.diff(labels.episode) != 0),
        "is_last": over,
        "is_terminal": over,
        "failure": (labels.failure == 1).astype(np.float32),
        "discount": np.ones(n, np.float32),
        "reward": np.zeros(n, np.float32),
    }


def authors_step(folder: Path, args: argparse.Namespace) -> Callable[[], None]:
    """One step of their pre-training loop."""
    import gym

    authors = authors_modules(args.authors)
    config = authors_config(authors.tools, args.authors)

    class Learner(authors.dreamer.Dreamer):
        def fill_cache(self):
            """Skip the thousands of figures they draw for a plot."""

    spaces = {
        "state": gym.spaces.Box(-np.inf, np.inf, (3,)),
        "obs_state": gym.spaces.Box(-1, 1, (2,)),
        "image": gym.spaces.Box(0, 255, (128, 128, 3), np.uint8),
    }
    logger = SimpleNamespace(step=0, scalar=lambda *a: None, write=lambda **k: None)
    action_space = gym.spaces.Box(-config.turnRate, config.turnRate, (1,))
    learner = Learner(gym.spaces.Dict(spaces), action_space, config, logger, None)
    learner.requires_grad_(False)
    reader = fresh_policy(preset("paper"), folder, args.clip).reader
    window = whole_clips(reader.labels, args.batch, args.clip)[:, None] + np.arange(args.clip)
    batch = {key: values[window] for key, values in authors_frames(reader).items()}
    batch["is_first"][:, 0] = True
    late = 5000  # their margin and continuation losses count from step 3000 on
    return lambda: learner.pretrain_model_only(batch, late)


# -- the comparison ---


def contestant(connection: Connection, name: str, folder: Path, args: argparse.Namespace) -> None:
    """A process that takes a step when told to and answers with its CPU seconds; in the end with its peak GB."""
    torch.set_num_threads(args.threads)
    torch.manual_seed(args.seed)
    step = authors_step(folder, args) if name == "authors" else our_step(name, folder, args)
    connection.send("ready")
    while connection.recv():
        began = time.process_time()
        step()
        connection.send(time.process_time() - began)
    connection.send(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)


def start_contestant(name: str, environment: dict[str, str], folder: Path, args: argparse.Namespace) -> Connection:
    """Start a contestant's process with these environment variables added; returns the wire to it."""
    before = dict(os.environ)
    os.environ.update(environment)
    here, there = multiprocessing.get_context("spawn").Pipe()
    multiprocessing.get_context("spawn").Process(
        target=contestant, args=(there, name, folder, args), daemon=True
    ).start()
    there.close()
    os.environ.clear()
    os.environ.update(before)
    here.recv()
    print(f"{name} ready", flush=True)
    return here


def ask(connection: Connection, step: bool = True) -> float:
    connection.send(step)
    return connection.recv()


def spread(values: list[float]) -> dict[str, float]:
    """Median and range."""
    return {"median": statistics.median(values), "low": min(values), "high": max(values)}


def ratio(theirs: list[float], ours: list[float]) -> dict[str, float]:
    """How many times ours theirs is, round by round: median and range."""
    return spread([t / o for t, o in zip(theirs, ours)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--authors", type=Path, required=True, help="your clone of CMU-IntentLab/latent-safety")
    parser.add_argument("--batch", type=int, default=16, help="clips a batch, for all (default: the paper's 16)")
    parser.add_argument(
        "--clip",
        type=int,
        default=16,
        help="frames a clip, for all (default 16; the paper has 64, few random episodes last as long)",
    )
    parser.add_argument("--repeats", type=int, default=5, help="timed rounds after one to warm up (default 5)")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch, for all (default 1)")
    parser.add_argument("--seed", type=int, default=0, help="of recording and weights (default 0)")
    parser.add_argument("--json", type=Path, help="where to write the results")
    args = parser.parse_args()
    args.authors = args.authors.resolve()

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record(folder, 3 * args.batch, args.seed)
        wires = {
            "authors": start_contestant("authors", {}, folder, args),
            "authors_kept_memory": start_contestant("authors", KEEP_MEMORY, folder, args),
            "paper": start_contestant("paper", {}, folder, args),
            "paper_kept_memory": start_contestant("paper", KEEP_MEMORY, folder, args),
            "compact": start_contestant("compact", {}, folder, args),
        }
        frames = args.batch * args.clip
        cost: dict[str, list[float]] = {name: [] for name in wires}
        for i in range(1 + args.repeats):
            for name, wire in wires.items():
                seconds = ask(wire)
                if i:
                    cost[name].append(seconds / frames * 1000)
            print(f"round {i} of {args.repeats}", flush=True)
        memory = {name: round(ask(wire, step=False), 2) for name, wire in wires.items()}
    for child in multiprocessing.active_children():
        child.join()

    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    row = {
        "what": "CPU milliseconds (user and system) per frame of one world-model training step",
        "batch": args.batch,
        "clip": args.clip,
        "rounds": args.repeats,
        "threads": args.threads,
        "authors_over_paper": ratio(cost["authors"], cost["paper"]),
        "authors_over_compact": ratio(cost["authors"], cost["compact"]),
        "authors_over_paper_both_kept_memory": ratio(cost["authors_kept_memory"], cost["paper_kept_memory"]),
        "authors_kept_memory_over_compact": ratio(cost["authors_kept_memory"], cost["compact"]),
        "ms_per_frame": {name: spread(values) for name, values in cost.items()},
        "peak_memory_gb": memory,
        "torch": torch.__version__,
        "notes": [
            f"all at batches of {args.batch} clips of {args.clip} frames; the paper's are 16 x 64",
            "authors: their pretrain_model_only at step 5000, where all losses count; two defaults naming the GPU were "
            "set to the CPU, and the figures they draw at start were skipped; their torch.compile wraps a module whose "
            "forward is never called, so nothing is compiled",
            f"kept_memory: with {' '.join(f'{k}={v}' for k, v in KEEP_MEMORY.items())}",
        ],
        **provenance([args.seed], cpu_minutes=sum(u.ru_utime + u.ru_stime for u in used) / 60),
    }
    for name, values in row["ms_per_frame"].items():
        print(f"{name:36s} {values['median']:7.2f} ms a frame ({values['low']:.2f} to {values['high']:.2f})")
    for name in row:
        if "_over_" in name:
            print(f"{name:36s} {row[name]['median']:7.2f} ({row[name]['low']:.2f} to {row[name]['high']:.2f})")
    if args.json:
        write_json(args.json, row)


if __name__ == "__main__":
    main()
