"""What a trained filter's margin says about episodes: a guess, an order of usefulness, labels that look wrong."""

import multiprocessing
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lerobot_latentsafe.datasets.labels import FAILING, SAFE
from lerobot_latentsafe.labeling.frames import DatasetFrames

if TYPE_CHECKING:
    from lerobot_latentsafe.world_models.base import Latent

WORST = 5
"""Frames an episode is judged by: a short doubt in a long certain episode counts."""
DOUBTFUL = -0.5
"""Bounded margin of a failure that is seen but doubted. Failures are rare, and a margin fitted to few labels misses
whole ones: such episodes teach it more than those on its border, most of which turn out safe."""


@dataclass(frozen=True)
class Suggestion:
    """What the filter thinks of one episode.

    Attributes:
        margin: (T,), bounded l in (-1, 1), negative where it sees a failure.
        guess: the first failing frame that fits the margin best; T if none.
        usefulness: 0 to 1, how much a label would teach: 0 surely safe all along, 1 its worst frames look like a
            doubtful failure.
    """

    margin: np.ndarray
    guess: int
    usefulness: float

    @classmethod
    def of(cls, margin: np.ndarray) -> "Suggestion":
        worst = np.sort(margin)[:WORST].mean()
        return cls(margin, best_split(margin), float(1 - abs(worst - DOUBTFUL) / (1 - DOUBTFUL)))


def best_split(margin: np.ndarray) -> int:
    """The k in 0..T for which "safe before k, failing from k on" agrees most with the margin (T,); late on ties."""
    gain = np.r_[0.0, np.cumsum(margin)] - (margin.sum() - np.r_[0.0, np.cumsum(margin)])
    return int(len(margin) - gain[::-1].argmax())


def contradiction(margin: np.ndarray, failure: np.ndarray) -> float:
    """How much labels (T,) contradict a margin (T,): 0 agrees surely, 0.5 undecided, 1 contradicts surely.

    The mean over the WORST frames; unlabelled frames do not count.
    """
    sign = np.select([failure == SAFE, failure == FAILING], [1.0, -1.0], np.nan)
    wrong = np.sort(((1 - sign * margin) / 2)[~np.isnan(sign)])
    return float(wrong[-WORST:].mean()) if len(wrong) else 0.0


def check_fit(policy, frames: DatasetFrames) -> None:
    """Refuse a dataset of another robot, rate or camera than the filter's, and a filter without a world model.

    Raises:
        ValueError: naming what differs.
        UntrainedFilterError: the world model was never trained.
    """
    from lerobot_latentsafe.modeling_latentsafe import adopt_dataset

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

    from lerobot_latentsafe.world_models.base import Clip

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


class Suggester:
    """Runs a filter over a dataset in a process of its own, so that the page stays quick.

    Args:
        on_new: called with the episode whenever one has been judged.

    Raises:
        RuntimeError: the filter cannot be loaded or does not fit the dataset.
    """

    def __init__(self, policy_path: str, repo_id: str, root: str | Path, on_new: Callable[[int], None]):
        context = multiprocessing.get_context("spawn")
        receiver, sender = context.Pipe(duplex=False)
        self.known: dict[int, Suggestion] = {}
        self._process = context.Process(target=_judge, args=(policy_path, repo_id, str(root), sender), daemon=True)
        self._process.start()
        sender.close()
        answer = receiver.recv()
        if isinstance(answer, str):
            raise RuntimeError(f"no suggestions from {policy_path}: {answer}")
        self._collect(*answer)
        threading.Thread(target=self._listen, args=(receiver, on_new), daemon=True).start()

    def _collect(self, episode: int, margin: np.ndarray) -> None:
        self.known[episode] = Suggestion.of(margin)

    def _listen(self, receiver, on_new: Callable[[int], None]) -> None:
        while True:
            try:
                episode, margin = receiver.recv()
            except (EOFError, OSError, ValueError):
                return
            self._collect(episode, margin)
            on_new(episode)

    def close(self) -> None:
        self._process.terminate()


def _judge(policy_path: str, repo_id: str, root: str, sender) -> None:
    """The other process: sends (episode, margin), or why it cannot."""
    import os

    if hasattr(os, "nice"):
        os.nice(10)
    try:
        import torch
        from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

        import lerobot_latentsafe  # noqa: F401  (registers the policy type)
        from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

        torch.set_num_threads(1)
        policy = LatentSafePolicy.from_pretrained(policy_path).eval()
        for answer in episode_margins(policy, DatasetFrames(LeRobotDatasetMetadata(repo_id, root=root))):
            sender.send(answer)
    except BrokenPipeError:
        return
    except Exception as e:
        sender.send(str(e))
