"""What the token cache costs and saves: bytes, rounding errors, reading speed against decoding video, memory at 10x.

    size      bytes a frame of two cameras: the videos, tokens in 16 and in 8 bits, and principal components
    error     of tokens in 8 bits, relative to their norm: overall, and of the worst token
    speed     frames (of both cameras) that a CPU second brings as training windows: by LeRobotDataset, decoding video
              and resizing as training would; and from the cache, where LeRobotDataset brings the frame's index and
              numbers and the cache a window of tokens in 16 bits, in 8 bits, or of principal components
    memory    of `lerobot-train` on the cache and on ten copies of it in one: peak, anonymous memory, and pages of
              mapped files, which the system takes back when it needs them

Speeds are taken in turn, on one thread, the first round thrown away; CPU time, user and system. Encoding, which the
cache saves as well, is not counted. The 8-bit copy is made of the 16-bit tokens by the same function as `latentsafe
cache --dtype=int8` uses.

    OMP_NUM_THREADS=1 python scripts/bench_cache.py --videos=data/held_branches --cache=data/held_branches_tokens \\
        --json=results/bag/bench_cache.json
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.dataset_tools import merge_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.datasets.build_cache import eight_bits
from lerobot_latentsafe.datasets.frame_cache import (
    FOLDER,
    MANIFEST,
    FrameCache,
    dataset_fingerprint,
    scale_file,
    to_model_images,
)
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.runtime.malloc import keep_freed_memory

COPIES = 10
TRAIN = (
    "--policy.type=latentsafe", "--policy.device=cpu", "--policy.push_to_hub=false",
    "--policy.world_model.type=dino_wm", "--policy.world_model.dim=32", "--policy.world_model.depth=1",
    "--policy.world_model.heads=1", "--policy.world_model.mlp=32", "--batch_size=8", "--num_workers=0",
)  # fmt: skip
"""A small model that reads tokens: what is measured is the data's memory, not the model's."""


def bytes_of(folder: Path, pattern: str) -> int:
    return sum(file.stat().st_size for file in folder.rglob(pattern))


def narrow_cache(cache: FrameCache, folder: Path) -> FrameCache:
    """The tokens in 8 bits, on disk as a cache keeps them."""
    parts = np.array_split(np.arange(len(cache.state)), 100)
    numbers, scales = zip(*(eight_bits(cache.frames(part, ["tokens"])[0]["tokens"]) for part in parts))
    files = {folder / "tokens.npy": numbers, scale_file(folder, "tokens"): scales}
    for file, values in files.items():
        np.save(file, torch.cat(values).numpy())
    tokens, scale = (np.load(file, mmap_mode="r") for file in files)
    return replace(cache, percepts={"tokens": tokens}, scales={"tokens": scale})


def rounding_error(wide: FrameCache, narrow: FrameCache) -> dict[str, float]:
    """Relative errors of tokens, over all frames in steps."""
    squares, total, worst = 0.0, 0.0, 0.0
    for part in np.array_split(np.arange(len(wide.state)), 100):
        exact, rounded = (cache.frames(part, ["tokens"])[0]["tokens"] for cache in (wide, narrow))
        error, norm = (rounded - exact).square().sum(-1), exact.square().sum(-1)
        squares, total = squares + error.sum().item(), total + norm.sum().item()
        worst = max(worst, (error / norm.clamp(min=1e-6)).max().item())
    return {"overall": (squares / total) ** 0.5, "worst_token": worst**0.5}


def frames_a_cpu_second(read: Callable[[np.ndarray], None], starts: np.ndarray, length: int) -> float:
    before = time.process_time()
    read(starts)
    return len(starts) * length / (time.process_time() - before)


def readers(args: argparse.Namespace, wide: FrameCache, narrow: FrameCache) -> dict[str, tuple[Callable, int]]:
    """Name -> how windows that start at some frames are read, and how many a round."""
    meta = LeRobotDatasetMetadata("local/videos", root=args.videos)
    windows = {key: [t / meta.fps for t in range(args.length)] for key in (*meta.camera_keys, "observation.state")}
    dataset = LeRobotDataset("local/videos", root=args.videos, delta_timestamps=windows, video_backend="pyav")

    def decode(starts: np.ndarray) -> None:
        for start in starts:
            item = dataset[int(start)]
            for key in meta.camera_keys:
                to_model_images(item[key], wide.image_size)

    items = LeRobotDataset("local/cache", root=args.cache)

    def cached(cache: FrameCache, name: str) -> Callable[[np.ndarray], None]:
        def read(starts: np.ndarray) -> None:
            index = np.array([int(items[int(start)]["index"]) for start in starts])
            cache.frames(index[:, None] + np.arange(args.length), [name])

        return read

    few, many = args.windows, 20 * args.windows
    return {
        "video": (decode, few),
        "tokens_float16": (cached(wide, "tokens"), many),
        "tokens_int8": (cached(narrow, "tokens"), many),
        "components": (cached(wide, "vector"), many),
    }


def speeds(args: argparse.Namespace, wide: FrameCache, narrow: FrameCache) -> dict[str, list[float]]:
    """In turn; the first round warms up."""
    rng, ways = np.random.default_rng(0), readers(args, wide, narrow)
    found: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(args.rounds + 1):
        for name, (read, n) in ways.items():
            starts = rng.integers(len(wide.state) - args.length, size=n)
            found[name].append(frames_a_cpu_second(read, starts, args.length))
    return {name: values[1:] for name, values in found.items()}


def tenfold(cache: Path, folder: Path) -> Path:
    """A cached dataset that holds another one so many times."""
    merge_datasets([LeRobotDataset("local/cache", root=cache)] * COPIES, "local/tenfold", folder)
    (folder / FOLDER).mkdir()
    manifest = json.loads((cache / FOLDER / MANIFEST).read_text())
    for file in (cache / FOLDER).iterdir():
        if file.suffix == ".safetensors":
            (folder / FOLDER / file.name).write_bytes(file.read_bytes())
        elif file.stem in (*manifest["percepts"], "state", "action"):
            one = np.load(file, mmap_mode="r")
            shape = (COPIES * len(one), *one.shape[1:])
            many = np.lib.format.open_memmap(folder / FOLDER / file.name, mode="w+", dtype=one.dtype, shape=shape)
            for i in range(COPIES):
                many[i * len(one) : (i + 1) * len(one)] = one
            many.flush()
    meta = LeRobotDatasetMetadata("local/tenfold", root=folder)
    changed = {"n_frames": meta.total_frames, "fingerprint": dataset_fingerprint(meta)}
    (folder / FOLDER / MANIFEST).write_text(json.dumps({**manifest, **changed}))
    return folder


def memory_of_training(root: Path, steps: int) -> dict[str, float]:
    """MB that `lerobot-train` takes on a cached dataset, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        options = [*TRAIN, "--dataset.repo_id=local/cache", f"--dataset.root={root}", f"--steps={steps}"]
        options += ["--save_checkpoint=false", f"--output_dir={folder}/out"]
        line = [sys.executable, __file__, "--train", *options]
        done = subprocess.run(line, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"lerobot-train on {root} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def train_and_tell(options: list[str]) -> None:
    """`lerobot-train`, then the process's memory in MB."""
    from lerobot.scripts import lerobot_train

    sys.argv = ["lerobot-train", *options]
    lerobot_train.main()
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    names = {"peak": "VmHWM", "anonymous": "RssAnon", "mapped_files": "RssFile"}
    print(json.dumps({name: int(status[key].split()[0]) / 1024 for name, key in names.items()}))


def spread(values: list[float]) -> dict[str, float]:
    return {"median": statistics.median(values), "low": min(values), "high": max(values)}


def main() -> None:
    if sys.argv[1:2] == ["--train"]:
        return train_and_tell(sys.argv[2:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--videos", type=Path, required=True, help="a dataset with videos")
    parser.add_argument("--cache", type=Path, required=True, help="its token cache, in 16 bits")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--length", type=int, default=24, help="frames of a window")
    parser.add_argument("--windows", type=int, default=6, help="decoded a round; of a cache 20 times as many")
    parser.add_argument("--steps", type=int, default=100, help="of training, for its memory")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()  # as training does
    wide = FrameCache.open(args.cache)
    n = len(wide.state)
    with tempfile.TemporaryDirectory() as folder:
        narrow = narrow_cache(wide, Path(folder))
        size = {
            "video": bytes_of(args.videos, "*.mp4") / n,
            "tokens_float16": wide.percepts["tokens"].nbytes / n,
            "tokens_int8": (narrow.percepts["tokens"].nbytes + narrow.scales["tokens"].nbytes) / n,
            "components": wide.percepts["vector"].nbytes / n,
        }
        error = rounding_error(wide, narrow)
        speed = speeds(args, wide, narrow)
        memory = {"1x": memory_of_training(args.cache, args.steps)}
        memory[f"{COPIES}x"] = memory_of_training(tenfold(args.cache, Path(folder) / "tenfold"), args.steps)
    row = {
        "frames": n,
        "rounds": args.rounds,
        "threads": 1,
        "bytes_a_frame_of_two_cameras": size,
        "relative_error_of_int8": error,
        "frames_a_cpu_second": {name: spread(values) for name, values in speed.items()},
        **{
            f"{name}_over_video": spread([a / b for a, b in zip(values, speed["video"])])
            for name, values in speed.items()
            if name != "video"
        },
        "training_steps": args.steps,
        "training_memory_mb": memory,
        **provenance([0]),
    }
    print(json.dumps(row, indent=2))
    if args.json:
        write_json(args.json, row)


if __name__ == "__main__":
    main()
