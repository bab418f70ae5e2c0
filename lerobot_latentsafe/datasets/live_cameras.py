"""The looks of a dataset's cameras, from a sample of its episodes: see `looks.py`."""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor
from tqdm import tqdm

from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.episodes import AT_ONCE, DatasetFrames
from lerobot_latentsafe.datasets.frame_cache import FrameCache
from lerobot_latentsafe.limits import Limits
from lerobot_latentsafe.looks import SIDE, Look, detail, halved, learn_looks, shrink
from lerobot_latentsafe.units import TrainedOn, Units

FRAMES = 6_000
"""Of each camera, at most: of whole episodes, as what repeats itself is learned, too. A minute's work if large."""
Pieces = Callable[[int], Iterator[dict[str, Tensor]]]
"""Place of an episode -> its pictures piece by piece: camera key -> uint8 (n, C, H, W)."""


def looks_of(
    meta: LeRobotDatasetMetadata, contract: Contract, trained_on: TrainedOn, cache: FrameCache | None = None
) -> dict[str, Look] | None:
    """What the cameras of a dataset look like.

    Args:
        contract: of all episodes, or of those to look at if the dataset has its pictures.
        trained_on: names the cameras, and gives the means and deviations of the state.
        cache: of the dataset's frames, if they are cached.

    Returns:
        Camera key -> look; None of a dataset without pictures, such as a cache of tokens.
    """
    cameras = trained_on.cameras
    if set(cameras) <= {*meta.camera_keys}:
        frames = DatasetFrames(meta, np.unique(contract.episode).tolist())
        pieces: Pieces = lambda e: frames.pieces(cameras, frames.episodes[e])  # noqa: E731
    elif cache is not None and set(cameras) <= {*cache.percepts}:
        pieces = lambda e: _cached(cache, cameras, *_rows(contract, e))  # noqa: E731
    else:
        return None
    sample = sampled_episodes(contract.lengths)
    shown, fine = _glances(pieces, cameras, sample)
    rows = np.concatenate([np.arange(*_rows(contract, e)) for e in sample])
    state = Limits(trained_on, Units(trained_on, [])).deviations(contract.state[rows])
    return learn_looks(shown, fine, state, contract.episode[rows])


def sampled_episodes(lengths: np.ndarray, most: int = FRAMES) -> list[int]:
    """Places of episodes, spread evenly, that have at most so many frames together; at least one."""
    order = np.random.default_rng(0).permutation(len(lengths))
    kept = order[: max(1, int((lengths[order].cumsum() <= most).sum()))]
    return np.sort(kept).tolist()


def _rows(contract: Contract, e: int) -> tuple[int, int]:
    """The first frame of the episode at a place, and that after its last."""
    ends = contract.lengths.cumsum()
    return ends[e] - contract.lengths[e], ends[e]


def _cached(cache: FrameCache, cameras: list[str], begin: int, end: int) -> Iterator[dict[str, Tensor]]:
    for first in range(begin, end, AT_ONCE):
        index = np.arange(first, min(first + AT_ONCE, end))
        yield {key: torch.as_tensor(cache.percepts[key][index]) for key in cameras}


@torch.no_grad()
def _glances(
    pieces: Pieces, cameras: list[str], sample: list[int]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Thumbnails of each camera (N, 3, h, w), and how fine their detail is (N,), where pictures are large enough."""
    shown: dict[str, list[np.ndarray]] = {key: [] for key in cameras}
    fine: dict[str, list[np.ndarray]] = {key: [] for key in cameras}
    for episode in tqdm(sample, "looking through the cameras", unit="episode", leave=False):
        for piece in pieces(episode):
            for key, pictures in piece.items():
                small = shrink(pictures.float() / 255.0)
                shown[key].append(halved(small))
                if min(pictures.shape[-2:]) >= SIDE:
                    fine[key].append(detail(small))
    joined = ({key: np.concatenate(parts) for key, parts in kept.items() if parts} for kept in (shown, fine))
    return next(joined), next(joined)
