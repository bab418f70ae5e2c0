"""What the token cache costs and saves: bytes, rounding errors, reading speed against decoding video, memory."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts import lerobot_train

from lerobot_latentsafe.datasets.cache_recipes import eight_bits
from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.frame_cache import FrameCache, scale_file
from lerobot_latentsafe.datasets.join_caches import join_all
from lerobot_latentsafe.evaluation.statistics import provenance
from lerobot_latentsafe.experiments.timing import cpu_seconds, ratio, spread
from lerobot_latentsafe.pictures import to_model_images
from lerobot_latentsafe.runtime.malloc import keep_freed_memory

COPIES = 10
TRAIN = (
    "--policy.type=latentsafe", "--policy.device=cpu", "--policy.push_to_hub=false",
    "--policy.world_model.type=dino_wm", "--policy.world_model.dim=32", "--policy.world_model.depth=1",
    "--policy.world_model.heads=1", "--policy.world_model.mlp=32", "--batch_size=8", "--num_workers=0",
)  # fmt: skip
"""A small model that reads tokens: what is measured is the data's memory, not the model's."""


@dataclass(frozen=True)
class CacheCost:
    """What is measured, and how long.

    Attributes:
        videos, cache: folders of a dataset with videos, and of its token cache in 16 bits.
        rounds: timed, after one to warm up.
        length: frames of a window.
        windows: decoded a round; of a cache 20 times as many.
        steps: of training, for its memory.
        most: times the cache, of which training's memory is measured.
        scratch: folder for datasets that hold it many times; None: the system's for such files.
    """

    videos: Path
    cache: Path
    rounds: int
    length: int
    windows: int
    steps: int
    most: int = 100
    scratch: Path | None = None


def bytes_of(folder: Path, pattern: str) -> int:
    """Of all files of a pattern."""
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
    """Of reading windows of so many frames."""
    return len(starts) * length / cpu_seconds(lambda: read(starts))


def readers(options: CacheCost, wide: FrameCache, narrow: FrameCache) -> dict[str, tuple[Callable, int]]:
    """Name -> how windows that start at some frames are read, and how many a round."""
    meta = LeRobotDatasetMetadata("local/videos", root=options.videos)
    windows = {key: [t / meta.fps for t in range(options.length)] for key in (*meta.camera_keys, "observation.state")}
    dataset = LeRobotDataset("local/videos", root=options.videos, delta_timestamps=windows, video_backend="pyav")

    def decode(starts: np.ndarray) -> None:
        for start in starts:
            item = dataset[int(start)]
            for key in meta.camera_keys:
                to_model_images(item[key], wide.image_size)

    items = LeRobotDataset("local/cache", root=options.cache)

    def cached(cache: FrameCache, name: str) -> Callable[[np.ndarray], None]:
        def read(starts: np.ndarray) -> None:
            index = np.array([int(items[int(start)]["index"]) for start in starts])
            cache.frames(index[:, None] + np.arange(options.length), [name])

        return read

    few, many = options.windows, 20 * options.windows
    return {
        "video": (decode, few),
        "tokens_float16": (cached(wide, "tokens"), many),
        "tokens_int8": (cached(narrow, "tokens"), many),
        "components": (cached(wide, "vector"), many),
    }


def speeds(options: CacheCost, wide: FrameCache, narrow: FrameCache) -> dict[str, list[float]]:
    """In turn; the first round warms up."""
    rng, ways = np.random.default_rng(0), readers(options, wide, narrow)
    found: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(options.rounds + 1):
        for name, (read, n) in ways.items():
            starts = rng.integers(len(wide.state) - options.length, size=n)
            found[name].append(frames_a_cpu_second(read, starts, options.length))
    return {name: values[1:] for name, values in found.items()}


def many(cache: Path, folder: Path, most: int) -> Iterator[tuple[int, Path]]:
    """A cached dataset, and datasets that hold it 10 and 100 times, if that is at most `most`: they link its shards."""
    yield 1, cache
    for times in (n for n in (COPIES, COPIES**2) if n <= most):
        meta = LeRobotDatasetMetadata("local/cache", root=cache)
        cache = folder / f"{times}x"
        join_all([meta] * COPIES, [FrameCache.open(meta.root)] * COPIES, "local/cache", cache)
        yield times, cache


def measure_memory(options: CacheCost) -> dict:
    """Of training on these."""
    if options.scratch is not None:
        options.scratch.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=options.scratch) as folder:
        found = {}
        for n, root in many(options.cache, Path(folder), options.most):
            found[f"{n}x"] = memory_of_training(root, options.steps)
            print(n, found[f"{n}x"], file=sys.stderr, flush=True)
    contract = Contract.read(LeRobotDatasetMetadata("local/cache", root=options.cache))
    n, numbers = len(contract.episode), (contract.episode, contract.state, contract.action)
    return {
        "training_steps": options.steps,
        "training_memory_mb": found,
        "frames": n,
        "cache_bytes_a_frame": bytes_of(options.cache, "*.*") / n,
        "numbers_bytes_a_frame": sum(values.nbytes for values in numbers) / n,
    }


def memory_of_training(root: Path, steps: int) -> dict[str, float]:
    """MB that `lerobot-train` takes on a cached dataset, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        options = [*TRAIN, "--dataset.repo_id=local/cache", f"--dataset.root={root}", f"--steps={steps}"]
        options += ["--save_checkpoint=false", f"--output_dir={folder}/out"]
        line = [sys.executable, "-m", "lerobot_latentsafe.experiments.bag.cache_cost", *options]
        done = subprocess.run(line, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"lerobot-train on {root} failed:\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def train_and_tell(options: list[str]) -> None:
    """`lerobot-train`, then the process's memory in MB."""
    sys.argv = ["lerobot-train", *options]
    lerobot_train.main()
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    names = {"peak": "VmHWM", "anonymous": "RssAnon", "mapped_files": "RssFile"}
    print(json.dumps({name: int(status[key].split()[0]) / 1024 for name, key in names.items()}))


def measure(options: CacheCost) -> dict:
    """Every number."""
    torch.set_num_threads(1)
    keep_freed_memory()  # as training does
    wide = FrameCache.open(options.cache)
    with tempfile.TemporaryDirectory() as folder:
        narrow = narrow_cache(wide, Path(folder))
        size, error = sizes(options, wide, narrow), rounding_error(wide, narrow)
        speed = speeds(options, wide, narrow)
    return {
        "frames": len(wide.state),
        "rounds": options.rounds,
        "threads": 1,
        "bytes_a_frame_of_two_cameras": size,
        "relative_error_of_int8": error,
        "frames_a_cpu_second": {name: spread(values) for name, values in speed.items()},
        **{f"{name}_over_video": ratio(values, speed["video"]) for name, values in speed.items() if name != "video"},
        **measure_memory(options),
        **provenance([0]),
    }


def sizes(options: CacheCost, wide: FrameCache, narrow: FrameCache) -> dict[str, float]:
    """Bytes a frame of two cameras."""
    n = len(wide.state)
    return {
        "video": bytes_of(options.videos, "*.mp4") / n,
        "tokens_float16": wide.percepts["tokens"].nbytes / n,
        "tokens_int8": (narrow.percepts["tokens"].nbytes + narrow.scales["tokens"].nbytes) / n,
        "components": wide.percepts["vector"].nbytes / n,
    }


if __name__ == "__main__":
    train_and_tell(sys.argv[1:])
