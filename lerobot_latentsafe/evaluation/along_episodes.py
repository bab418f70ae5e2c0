"""What a filter makes of recorded episodes, frame by frame."""

from collections.abc import Iterator

import numpy as np

from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.latent import Latent


def check_fit(policy, frames: DatasetFrames) -> None:
    """Refuse a dataset of another robot, rate or camera than the filter's, and a filter without a world model.

    Raises:
        ValueError: naming what differs.
        UntrainedFilterError: the world model was never trained.
    """
    from lerobot_latentsafe.units import adopt_dataset

    policy.require_stage("world_model")
    adopt_dataset(policy.config, frames.meta, frames.meta.stats)
    missing = [camera for camera in policy.config.cameras if camera not in frames.cameras]
    if missing:
        raise ValueError(
            f"the filter looks through {', '.join(missing)}, {frames.meta.repo_id} has {', '.join(frames.cameras)}"
        )


def episode_margins(policy, frames: DatasetFrames, batch_size: int = 16) -> Iterator[tuple[int, np.ndarray]]:
    """Margins (T,) along every episode, filtered from its first frame: (episode, margin) in order.

    Raises:
        ValueError: the dataset is of another robot, rate or camera than the filter's.
    """
    check_fit(policy, frames)
    episodes = range(frames.meta.total_episodes)
    for first in episodes[::batch_size]:
        batch = list(episodes[first : first + batch_size])
        yield from zip(batch, _margins(policy, frames, batch))


def _margins(policy, frames: DatasetFrames, episodes: list[int]) -> list[np.ndarray]:
    """Margins of a few episodes."""
    latents, length = encode_episodes(policy, frames, episodes)
    margin = policy.imagination.margin(latents).detach().cpu().numpy()
    return [row[:n] for row, n in zip(margin, length)]


def encode_episodes(policy, frames: DatasetFrames, episodes: list[int]) -> "tuple[Latent, list[int]]":
    """What the filter makes of a few episodes, filtered from their first frames, side by side.

    Returns:
        Latents (B, T, ...) for the longest one's T frames, and how many are the episode's own, of each.
    """
    import torch

    from lerobot_latentsafe.datasets.clips import Clip

    seen = [_model_inputs(policy, frames, episode) for episode in episodes]
    length = [len(state) for _, state, _ in seen]
    pad = torch.nn.utils.rnn.pad_sequence
    stack = lambda rows: pad(rows, batch_first=True).to(policy.device)  # noqa: E731
    valid = torch.arange(max(length)) < torch.tensor(length)[:, None]
    action = stack([action for _, _, action in seen])
    previous = torch.cat([policy.first_action(action[:, :1]), action[:, :-1]], 1)
    is_first = torch.zeros_like(valid)
    is_first[:, 0] = True
    unknown = torch.full(valid.shape, -1)
    percepts = {key: stack([row[key] for row, _, _ in seen]) for key in policy.world_model.percept_names}
    clip = Clip(
        percepts, stack([state for _, state, _ in seen]), previous, is_first.to(policy.device), valid, unknown, unknown
    )
    with torch.no_grad():
        return policy.world_model.encode(clip), length


def _model_inputs(policy, frames: DatasetFrames, episode: int):
    """Percepts, proprioception and normalised actions of an episode, as the world model takes them."""
    import torch

    images = {
        key: policy.model_images(torch.from_numpy(frames.images(key, episode)).permute(0, 3, 1, 2).contiguous())
        for key in policy.world_model.image_keys
    }
    columns = frames.columns(episode, ["observation.state", "action"])
    state, action = (torch.from_numpy(c).float().reshape(len(c), -1).to(policy.device) for c in columns.values())
    return (
        policy.world_model.perceive(images),
        policy.normalise_state(state),
        policy.normalise_action(action).clamp(-1, 1),
    )
