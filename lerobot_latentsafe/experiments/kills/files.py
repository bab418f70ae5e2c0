"""What a run has left, and whether another has left the same."""

import json
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import torch
from safetensors.torch import load_file

OF_LEROBOTS_RUN = ("train_config.json", "rng_state.safetensors")
"""Of a lerobot-train: what was typed, and random numbers, of which a new data loader takes one more."""
OF_TIME_AND_PLACE = {
    "checkpoint_path", "config_path", "cpu_s", "data_s", "labelled_at", "output_dir", "pretrained_path", "resume",
    "update_s",
}  # fmt: skip
"""Entries and columns that are not the same in two runs."""


def left_by(folder: Path) -> dict[str, object]:
    """All that a verb has left: name of a file -> its content, as far as it does not tell of time and place."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and "last" not in path.parts]
    kept = [path for path in files if path.name not in OF_LEROBOTS_RUN and path.suffix != ".lock"]
    return {path.relative_to(folder).as_posix(): content(path) for path in kept}


def content(path: Path) -> object:
    """What a file says, but for time and place."""
    if path.suffix == ".parquet":
        table = pq.read_table(path)
        return table.drop_columns([name for name in table.column_names if name in OF_TIME_AND_PLACE]).to_pydict()
    if path.suffix == ".safetensors":
        return {name: (str(t.dtype), t.shape, t.reshape(-1).view(torch.uint8).numpy().tobytes())
                for name, t in load_file(path).items()}  # fmt: skip
    if path.suffix == ".npy":
        return np.load(path).tobytes()
    if path.suffix == ".json":
        return _told(json.loads(path.read_text()))
    if path.suffix == ".jsonl":
        return [_told(json.loads(line)) for line in path.read_text().splitlines()]
    if path.suffix == ".html":
        return re.sub(r"Made by .*? at commit .*?<", "", path.read_text())
    return path.read_bytes()


def _told(value: object) -> object:
    """Entries in the order of their names, without those of time and place."""
    if isinstance(value, dict):
        return {name: _told(value[name]) for name in sorted(value) if name not in OF_TIME_AND_PLACE}
    return [_told(item) for item in value] if isinstance(value, list) else value


def differences(one: dict[str, object], other: dict[str, object]) -> list[str]:
    """Names of files that one has and the other has not, or that are not the same."""
    return sorted(name for name in {*one, *other} if not _alike(name, one.get(name), other.get(name)))


def _alike(name: str, one: object, other: object) -> bool:
    """Whether both say the same; statistics of a dataset are sums, which round otherwise when they are resumed."""
    one, other = repr(one), repr(other)
    if one == other or not name.endswith("meta/stats.json"):
        return one == other
    ours, theirs = (np.array(re.findall(r"[-\d.e]*\d", text), float) for text in (one, other))
    return len(ours) == len(theirs) and np.allclose(ours, theirs, rtol=0, atol=1e-6)
