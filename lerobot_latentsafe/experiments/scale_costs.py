"""What many episodes cost: sums of measured figures, and what is the first thing that no further computer speeds up."""

import csv
import json
from dataclasses import asdict, dataclass
from pathlib import Path

CORES = 32
"""Of a node, each of which does one task."""
READ_MB_S = 500.0
"""Megabytes a second that a shared storage brings to all nodes together: a modest one, assumed and not measured."""


@dataclass(frozen=True)
class Measured:
    """Figures of the bag: two cameras of 224 pixels, EfficientNet-Lite0.

    Attributes:
        frames: an episode.
        cache_ms: CPU time of decoding and encoding a frame.
        alone_ms: CPU time a frame of what one process does alone: copying numbers and labels, writing the index.
        video_bytes, token_bytes: of a frame.
        train_s: CPU time of world model, margin and critic, however many episodes there are.
        number_bytes: memory a frame of the process that lays a cache out: it reads all numbers.
    """

    frames: float
    cache_ms: float
    alone_ms: float
    video_bytes: float
    token_bytes: float
    train_s: float
    number_bytes: float

    @classmethod
    def read(cls, results: Path) -> "Measured":
        """From results/."""
        shards, memory, cache = (
            json.loads((results / file).read_text())
            for file in ("scale/shards.json", "scale/memory.json", "bag/bench_cache.json")
        )
        with (results / "bag" / "cost.csv").open() as file:
            cpu = {row["step"]: float(row["user_s"]) + float(row["system_s"]) for row in csv.DictReader(file)}
        one, n = shards["1_workers"], shards["frames"]
        return cls(
            frames=n / shards["episodes"],
            cache_ms=1e3 * one["tasks_s"]["median"] / n,
            alone_ms=1e3 * one["alone_s"]["median"] / n,
            video_bytes=cache["bytes_a_frame_of_two_cameras"]["video"],
            token_bytes=memory["cache_bytes_a_frame"],
            train_s=sum(cpu[step] for step in ("world_model_0", "margin_0", "reachability_0")),
            number_bytes=memory["numbers_bytes_a_frame"],
        )


def costs(measured: Measured, n_episodes: int, n_nodes: int) -> dict[str, float | str]:
    """Of a cache, and of a training on it.

    Returns:
        CPU hours, gigabytes, hours on the clock, and which step takes the most of these.
    """
    frames = n_episodes * measured.frames
    hours = {
        "encoding on all nodes": frames * measured.cache_ms / 3.6e6 / (n_nodes * CORES),
        "one process that copies numbers": frames * measured.alone_ms / 3.6e6,
        "storage that brings the videos": frames * measured.video_bytes / 1e6 / READ_MB_S / 3600,
    }
    return {
        "cache_cpu_hours": frames * (measured.cache_ms + measured.alone_ms) / 3.6e6,
        "train_cpu_hours": measured.train_s / 3600,
        "videos_gb": frames * measured.video_bytes / 1e9,
        "cache_gb": frames * measured.token_bytes / 1e9,
        "laying_out_memory_gb": frames * measured.number_bytes / 1e9,
        # videos are read while they are encoded
        "cache_wall_hours": hours["one process that copies numbers"]
        + max(hours["encoding on all nodes"], hours["storage that brings the videos"]),
        "bottleneck": max(hours, key=lambda name: hours[name]),
    }


def table(measured: Measured, episodes: list[int], nodes: list[int]) -> dict:
    """All of it, by episodes and by nodes."""
    rows = {str(n): {str(k): costs(measured, n, k) for k in nodes} for n in episodes}
    return {"cores_of_a_node": CORES, "read_mb_s": READ_MB_S, "measured": asdict(measured), "episodes": rows}
