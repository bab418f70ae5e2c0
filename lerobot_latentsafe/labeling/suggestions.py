"""What a trained filter's margin says about episodes: a guess, an order of usefulness, labels that look wrong."""

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.labels import FAILING, SAFE
from lerobot_latentsafe.evaluation.along_episodes import episode_margins
from lerobot_latentsafe.modeling_latentsafe import load_filter

logger = logging.getLogger(__name__)

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
        """From a margin (T,)."""
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


class Suggester:
    """Runs a filter over a dataset in a process of its own, so that the page stays quick.

    Args:
        on_new: called with the episode whenever one has been judged.

    Attributes:
        known: episode -> what the filter thinks of it.

    Raises:
        RuntimeError: the filter cannot be loaded or does not fit the dataset, or its process was killed.
    """

    def __init__(self, policy_path: str, repo_id: str, root: str | Path, on_new: Callable[[int], None]):
        context = multiprocessing.get_context("spawn")
        receiver, sender = context.Pipe(duplex=False)
        self.known: dict[int, Suggestion] = {}
        self._silent: dict[int, str] = {}
        self._ended: str | None = None
        self._closed = False
        self._process = context.Process(target=_judge, args=(policy_path, repo_id, str(root), sender), daemon=True)
        self._process.start()
        sender.close()
        try:
            answer = receiver.recv()
        except (EOFError, OSError):
            answer = self._how_it_ended()
        if isinstance(answer, str):
            raise RuntimeError(f"no suggestions from {policy_path}: {answer}")
        self._collect(*answer)
        self.listener = threading.Thread(target=self._listen, args=(receiver, on_new), daemon=True)
        self.listener.start()

    def why_silent(self, episode: int) -> str | None:
        """Why an episode has no suggestion and will get none; None: it has one, or has not been looked at yet."""
        return None if episode in self.known else self._silent.get(episode, self._ended)

    def _collect(self, episode: int, margin: np.ndarray | str) -> None:
        if isinstance(margin, str):
            self._silent[episode] = margin
        else:
            self.known[episode] = Suggestion.of(margin)

    def _listen(self, receiver, on_new: Callable[[int], None]) -> None:
        while True:
            try:
                answer = receiver.recv()
            except (EOFError, OSError, ValueError):
                self._process.join()
                answer = self._how_it_ended() if self._process.exitcode else None
            if not isinstance(answer, tuple):
                break
            self._collect(*answer)
            on_new(answer[0])
        if answer and not self._closed:
            self._ended = answer
            logger.warning("no more suggestions: %s", answer)

    def _how_it_ended(self) -> str:
        self._process.join()
        code = self._process.exitcode
        how = f"was killed ({signal.Signals(-code).name})" if code < 0 else f"ended with exit code {code}"
        return (
            f"the process that runs the filter {how}; a system that is short of memory does so. Free some memory, or "
            "label without --policy.path"
        )

    def close(self) -> None:
        """Stop judging."""
        self._closed = True
        self._process.terminate()


def _judge(policy_path: str, repo_id: str, root: str, sender) -> None:
    """The other process: sends (episode, margin), (episode, why it has none), or why it cannot judge at all."""
    if hasattr(os, "nice"):
        os.nice(10)
    try:
        torch.set_num_threads(1)
        model = load_filter(policy_path).model
        for answer in episode_margins(model, DatasetFrames(LeRobotDatasetMetadata(repo_id, root=root))):
            sender.send(answer)
    except BrokenPipeError:
        return
    except Exception as e:
        sender.send(str(e))
