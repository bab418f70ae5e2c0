"""What a filter makes of recorded episodes, frame by frame: latents, V and l."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from lerobot_latentsafe.datasets.adoption import adopt_dataset
from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.latent import Latent, map_latent
from lerobot_latentsafe.safety_model import SafetyModel

FRAMES_TOGETHER = 4096
"""Of the episodes that are encoded side by side; a longer one is encoded alone."""


@dataclass(frozen=True)
class EpisodeValues:
    """V and the bounded margin l of each frame of an episode: (T,) each."""

    value: np.ndarray
    margin: np.ndarray


def check_fit(model: SafetyModel, frames: DatasetFrames, contract: Contract | None = None) -> None:
    """Refuse a dataset of another robot, rate or camera than the filter's, and a filter without a world model.

    Args:
        contract: of the dataset, if it has been read.

    Raises:
        ValueError: naming what differs.
        UntrainedFilterError: the world model was never trained.
    """
    model.require_stage("world_model")
    trained_on = model.config.trained_on
    adopt_dataset(trained_on, contract or Contract.read(frames.meta))
    missing = [camera for camera in trained_on.cameras if camera not in frames.cameras]
    if missing:
        raise ValueError(
            f"the filter looks through {', '.join(missing)}, {frames.meta.repo_id} has {', '.join(frames.cameras)}"
        )


@torch.no_grad()
def values_along(model: SafetyModel, frames: DatasetFrames, episode: int) -> EpisodeValues:
    """V and l at each frame of an episode, filtered from its first frame.

    Raises:
        ValueError: the dataset is of another robot, rate or camera than the filter's.
        UntrainedFilterError: the critic was never trained.
    """
    check_fit(model, frames)
    latents, _ = encode_episodes(model, frames, [episode])
    latent = map_latent(latents, lambda t: t[0])
    return EpisodeValues(*(t.cpu().numpy() for t in (model.value(latent), model.imagination.margin(latent))))


def episode_margins(
    model: SafetyModel, frames: DatasetFrames, batch_size: int = 16
) -> Iterator[tuple[int, np.ndarray | str]]:
    """Margins (T,) along every episode that is meant, filtered from its first frame: (episode, margin) in order.

    Of an episode that cannot be judged, because its numbers or margins are not finite or its pictures cannot be read,
    (episode, why). The others are judged all the same.

    Raises:
        ValueError: the dataset is of another robot, rate or camera than the filter's.
    """
    contract = Contract.read_sound(frames.meta)
    check_fit(model, frames, contract)
    for batch in _batches(frames, batch_size):
        found: dict[int, np.ndarray | str] = {
            episode: contract.broken[episode] for episode in batch if episode in contract.broken
        }
        found |= _judged(model, frames, [episode for episode in batch if episode not in found])
        yield from ((episode, found[episode]) for episode in batch)


def _judged(model: SafetyModel, frames: DatasetFrames, batch: list[int]) -> dict[int, np.ndarray | str]:
    """Episode -> margin (T,), or why there is none; of a batch that fails, each episode alone."""
    if not batch:
        return {}
    try:
        latents, length = encode_episodes(model, frames, batch)
        margin = model.imagination.margin(latents).detach().cpu().numpy()
    except Exception as e:
        if len(batch) == 1:
            return {batch[0]: " ".join(f"{type(e).__name__}: {e}".split())}
        return {episode: why for alone in batch for episode, why in _judged(model, frames, [alone]).items()}
    rows = {episode: row[:n] for episode, row, n in zip(batch, margin, length)}
    return {episode: row if np.isfinite(row).all() else _not_finite(row) for episode, row in rows.items()}


def _not_finite(margin: np.ndarray) -> str:
    return (
        f"the filter's margin is {margin[~np.isfinite(margin)][0]} in frame {np.flatnonzero(~np.isfinite(margin))[0]}"
    )


def _batches(frames: DatasetFrames, batch_size: int) -> Iterator[list[int]]:
    """Episodes in order, so many together, or fewer where they are long."""
    batch: list[int] = []
    for episode in frames.episodes:
        longest = max(map(frames.length, [*batch, episode]))
        if batch and (len(batch) == batch_size or (len(batch) + 1) * longest > FRAMES_TOGETHER):
            yield batch
            batch = []
        batch.append(episode)
    yield batch


@torch.no_grad()
def encode_episodes(model: SafetyModel, frames: DatasetFrames, episodes: list[int]) -> tuple[Latent, list[int]]:
    """What the filter makes of a few episodes, filtered from their first frames, side by side.

    Returns:
        Latents (B, T, ...) for the longest one's T frames, and how many are the episode's own, of each.
    """
    seen = [_model_inputs(model, frames, episode) for episode in episodes]
    length = [len(state) for _, state, _ in seen]
    skip = model.config.world_model.frame_skip
    longest = -(-max(length) // skip) * skip
    stack = lambda rows: _padded(rows, longest).to(model.device)  # noqa: E731
    action = stack([action for _, _, action in seen])
    percepts = {key: stack([row[key] for row, _, _ in seen]) for key in model.world_model.percept_names}
    clip = _every(skip, percepts, stack([state for _, state, _ in seen]), action, model)
    latents = model.world_model.encode(clip)
    in_order = lambda t: t.unflatten(0, (-1, skip)).transpose(1, 2).flatten(1, 2)[:, : max(length)]  # noqa: E731
    return map_latent(latents, in_order), length


def _padded(rows: list[Tensor], length: int) -> Tensor:
    """Rows (T, ...), each with zeros after it: (B, length, ...)."""
    padded = pad_sequence(rows, batch_first=True)
    return torch.cat([padded, padded.new_zeros(len(rows), length - padded.shape[1], *padded.shape[2:])], 1)


def _every(skip: int, percepts: dict[str, Tensor], state: Tensor, action: Tensor, model: SafetyModel) -> Clip:
    """Frames of B episodes as clips of every so many, one for each frame to begin with: (B skip, T / skip, ...).

    Args:
        percepts, state, action: (B, T, ...), actions those taken after each frame.
    """
    apart = lambda t: t.unflatten(1, (-1, skip)).transpose(1, 2).flatten(0, 1)  # noqa: E731
    since = torch.arange(state.shape[1])[:, None] - torch.arange(skip, 0, -1)  # the ticks before each frame
    ticks = action[:, since.clamp(min=0)].flatten(2)
    ticks[:, :skip] = model.units.first_action(ticks[:, :skip])
    state = apart(state)
    is_first = torch.zeros(state.shape[:2], dtype=torch.bool, device=state.device)
    is_first[:, 0] = True
    unknown = torch.full_like(is_first, -1, dtype=torch.long)
    percepts = {key: apart(value) for key, value in percepts.items()}
    return Clip(percepts, state, apart(ticks), is_first, torch.ones_like(is_first), unknown, unknown)


def _model_inputs(model: SafetyModel, frames: DatasetFrames, episode: int) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Percepts, proprioception and normalised actions of an episode, as the world model takes them."""
    pieces = frames.pieces(model.world_model.image_keys, episode)
    images = ({key: model.images(images) for key, images in piece.items()} for piece in pieces)
    seen = [model.world_model.perceive(piece) for piece in images]
    state, action = (numbers_of(frames, episode, key).to(model.device) for key in ("observation.state", "action"))
    units = model.units
    return (
        {name: torch.cat([piece[name] for piece in seen]) for name in seen[0]},
        units.normalise_state(state),
        units.heard_action(action, state),
    )


def numbers_of(frames: DatasetFrames, episode: int, key: str) -> Tensor:
    """The numbers of a feature in an episode: (T, D), or (T, 0) of a dataset without it."""
    if key not in frames.meta.features:
        return torch.zeros(frames.meta.episodes[episode]["length"], 0)
    values = torch.from_numpy(frames.columns(episode, [key])[key]).float()
    return values.reshape(len(values), -1)
