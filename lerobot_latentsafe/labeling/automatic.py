"""Labels without a person: plug-in functions that look at an episode and say where it fails.

A labeller is any function `Episode -> first failing frame | labels of all frames | None for "cannot tell"`. One is
named on the command line as `dubins_truth` or `my_module:my_function`; `vision_language` asks a model.
"""

import base64
import importlib
import json
import logging
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import cv2
import httpx
import numpy as np
from tqdm import tqdm

from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.labels import FAILING, SAFE, UNLABELLED
from lerobot_latentsafe.labeling.store import LabelStore, first_failing, in_words

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Episode:
    """What a labeller sees of one episode; nothing is decoded before it is asked for."""

    number: int
    length: int
    task: str
    frames: DatasetFrames

    def column(self, name: str) -> np.ndarray:
        """(T,) or (T, D) of a column.

        Raises:
            ValueError: the dataset has no such column.
        """
        if name not in self.frames.meta.features:
            raise ValueError(
                f"this labeller reads the column {name!r}, {self.frames.meta.repo_id} has "
                f"{', '.join(self.frames.meta.features)}"
            )
        return self.frames.columns(self.number, [name])[name]

    def stream(self, camera: str, numbers: Sequence[int] | None = None) -> Iterator[np.ndarray]:
        """Frames one after the other, uint8 (H, W, 3), RGB: those of these numbers, ascending from 0, or all."""
        return self.frames.stream(camera, self.number, numbers)

    def images(self, camera: str) -> np.ndarray:
        """All frames at once, uint8 (T, H, W, 3), RGB; a long episode takes much memory, which `stream` does not."""
        return self.frames.images(camera, self.number)


PATIENCE = 3
"""Episodes in a row without an answer, after which a labeller is not asked again."""

Labeller = Callable[[Episode], "int | np.ndarray | None"]

NAMED = {"dubins_truth": "lerobot_latentsafe.dubins.labeller:dubins_truth"}
"""Labellers that come with the package: name -> module:function."""


# -- a vision-language model ---

PROMPT = """These are {shown} frames of one robot episode of {length} frames (camera {camera}), in order.
Task: {task}
Frame numbers, one a picture: {numbers}
Does the episode fail in this sense: {failure}?
Once it has failed, all later frames count as failing.
Answer with one JSON object and nothing else: {{"fails": true, "first_failing_frame": <number>}}
or {{"fails": false, "first_failing_frame": null}}.
If you cannot tell, answer {{"fails": null, "first_failing_frame": null}}."""


class AnswerError(ValueError):
    """A model's answer that is not exactly what was asked for; it never becomes a label."""


class LabellerError(ValueError):
    """A labeller that fails on every episode."""


class Model(Protocol):
    """A vision-language model."""

    def __call__(self, prompt: str, pictures: list[np.ndarray]) -> str:
        """Its answer to a prompt with RGB pictures (H, W, 3)."""


@dataclass(frozen=True)
class VisionLanguageLabeller:
    """Shows a model some frames of each episode and takes its answer only if it is well formed.

    Attributes:
        model: whom to ask.
        failure: what counts as a failure, in words.
        camera: which one to show; None: the first.
        n_frames: pictures an episode.
    """

    model: Model
    failure: str
    camera: str | None = None
    n_frames: int = 12

    def __call__(self, episode: Episode) -> int | None:
        camera = self.camera or episode.frames.cameras[0]
        numbers = np.unique(np.linspace(0, episode.length - 1, self.n_frames).round().astype(int))
        prompt = PROMPT.format(
            shown=len(numbers), length=episode.length, camera=camera, task=episode.task,
            numbers=", ".join(map(str, numbers)), failure=self.failure,
        )  # fmt: skip
        return parse_answer(self.model(prompt, list(episode.stream(camera, numbers.tolist()))), episode.length)


def parse_answer(answer: str, length: int) -> int | None:
    """First failing frame, the length for "never fails", None for "cannot tell".

    Raises:
        AnswerError: anything but exactly one of the three objects asked for.
    """
    try:
        said = json.loads(answer)
    except (ValueError, RecursionError) as e:
        raise AnswerError(f"expected one JSON object, got {answer[:80]!r}") from e
    if not isinstance(said, dict) or set(said) != {"fails", "first_failing_frame"}:
        raise AnswerError(f"expected exactly fails and first_failing_frame, got {answer[:80]!r}")
    fails, first = said["fails"], said["first_failing_frame"]
    if fails is True and type(first) is int and 0 <= first < length:
        return first
    if first is None and fails is False:
        return length
    if first is None and fails is None:
        return None
    raise AnswerError(f"expected a frame from 0 to {length - 1} exactly where it fails, got {answer[:80]!r}")


@dataclass(frozen=True)
class ChatEndpoint:
    """A model behind an OpenAI-style chat endpoint, as vLLM, Ollama, llama.cpp and most services offer.

    Attributes:
        url: ends in /v1. model: its name there. key: the service's key, if it wants one.
    """

    url: str
    model: str
    key: str | None = None
    timeout_s: float = 120.0

    def __call__(self, prompt: str, pictures: list[np.ndarray]) -> str:
        images = [{"type": "image_url", "image_url": {"url": _data_url(picture)}} for picture in pictures]
        content = [{"type": "text", "text": prompt}, *images]
        asked = {"model": self.model, "temperature": 0, "messages": [{"role": "user", "content": content}]}
        headers = {"Authorization": f"Bearer {self.key}"} if self.key else {}
        try:
            reply = httpx.post(f"{self.url}/chat/completions", json=asked, headers=headers, timeout=self.timeout_s)
            reply.raise_for_status()
            answer = reply.json()["choices"][0]["message"]["content"]
        except httpx.HTTPError as e:
            raise ConnectionError(f"{self.url} did not answer ({type(e).__name__}: {e})") from e
        except (KeyError, IndexError, TypeError, ValueError) as e:
            raise AnswerError(f"{self.url} does not speak the chat protocol ({e!r})") from e
        if not isinstance(answer, str):
            raise AnswerError(f"{self.url} answered {type(answer).__name__}, expected text")
        return answer


def _data_url(picture: np.ndarray) -> str:
    encoded = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes()
    return f"data:image/jpeg;base64,{base64.b64encode(encoded).decode()}"


# -- running one ---


def find_labeller(name: str) -> Labeller:
    """A labeller of NAMED, or `module:function` of a module that is installed or in the present folder.

    Raises:
        ValueError: there is none of that name.
    """
    module, _, function = NAMED.get(name, name).partition(":")
    if (here := os.getcwd()) not in sys.path:  # a console command's own folder is searched, not the user's
        sys.path.append(here)
    try:
        return getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as e:
        raise ValueError(
            f"no labeller {name!r} ({e}); expected {', '.join(NAMED)}, vision_language, or module:function"
        ) from e


class UnsavedAnswersError(OSError):
    """Answers that could not be saved, each named in the message.

    Attributes:
        answers: episode -> int8 labels (T,).
    """

    def __init__(self, answers: dict[int, np.ndarray], why: OSError):
        said = "; ".join(f"episode {episode}: {_in_words(labels)}" for episode, labels in answers.items())
        super().__init__(
            f"{len(answers)} answers could not be saved ({why}): {said}. Make room, then give the same command again: "
            "it asks about these episodes once more"
        )
        self.answers = answers


def _in_words(labels: np.ndarray) -> str:
    first = first_failing(labels)
    return str(labels.tolist()) if first is None else in_words(first, len(labels))


class _Answers:
    """Saves each answer at once. What a full disk refuses is kept, and tried again with the next and in the end."""

    def __init__(self, save: Callable[[dict[int, np.ndarray]], None]):
        self.save, self.unsaved = save, dict[int, np.ndarray]()

    def add(self, episode: int, labels: np.ndarray) -> None:
        """Save an answer; raises UnsavedAnswersError once PATIENCE of them are unsaved."""
        self.unsaved[episode] = labels
        try:
            self.settle()
        except UnsavedAnswersError as e:
            if len(self.unsaved) >= PATIENCE:
                raise
            logger.warning("kept, and tried again with the next answer: %s", e)

    def settle(self) -> None:
        """Save what is unsaved, or raise UnsavedAnswersError."""
        if not self.unsaved:
            return
        try:
            self.save(self.unsaved)
        except OSError as e:
            raise UnsavedAnswersError(dict(self.unsaved), e) from e
        self.unsaved.clear()


class Answer(NamedTuple):
    """What a labeller says of an episode.

    Attributes:
        kind: labelled; undecided; refused: what it said is no label; failed: it said nothing.
        labels: int8 (T,), if it gave some.
        why: it was refused, or failed.
    """

    episode: int
    kind: str
    labels: np.ndarray | None = None
    why: str = ""


def label_automatically(
    store: LabelStore, frames: DatasetFrames, specification: str, labeller: Labeller, name: str
) -> dict[str, list]:
    """Ask a labeller about the episodes of `frames` that have no label yet; each answer is saved before the next.

    Whatever ends it, what was answered is on disk, and another call goes on there.

    Returns:
        See `sorted_answers`.

    Raises:
        LabellerError: so many episodes failed in a row that the next would, too.
        UnsavedAnswersError: answers could not be saved, nor later; it names them.
    """
    to_ask, given = unlabelled(store, frames, specification), list[Answer]()
    answers = _Answers(lambda said: store.label_frames(specification, said, f"auto {name}"))
    try:
        for answer in ask(labeller, frames, to_ask, name, min(PATIENCE, len(to_ask))):
            if answer.labels is not None:
                answers.add(answer.episode, answer.labels)
            given.append(answer)
    except UnsavedAnswersError:
        raise
    except BaseException:  # also Ctrl-C
        answers.settle()
        raise
    answers.settle()
    return sorted_answers(given)


def unlabelled(store: LabelStore, frames: DatasetFrames, specification: str) -> list[int]:
    """Those of the episodes of `frames` that have no label yet."""
    return [e for e in frames.episodes if (store.labels(specification, e) == UNLABELLED).all()]


def sorted_answers(answers: Iterable[Answer]) -> dict[str, list]:
    """Answers by their kind.

    Returns:
        labelled: episodes; undecided: episodes; refused: (episode, why) of answers that were no labels; failed:
        (episode, why) of those without an answer.
    """
    result: dict[str, list] = {"labelled": [], "undecided": [], "refused": [], "failed": []}
    for answer in answers:
        result[answer.kind].append((answer.episode, answer.why) if answer.why else answer.episode)
    return result


def ask(
    labeller: Labeller, frames: DatasetFrames, episodes: Sequence[int], name: str, patience: int
) -> Iterator[Answer]:
    """What a labeller says of some episodes, one after the other.

    Args:
        name: the labeller's.
        patience: episodes in a row without an answer, after which it is not asked again.

    Raises:
        LabellerError: it fails on so many in a row.
    """
    n_labelled = in_a_row = 0
    for number in tqdm(episodes, desc=name, unit="episode"):
        length = frames.length(number)
        episode = Episode(number, length, ", ".join(frames.meta.episodes[number]["tasks"]), frames)
        try:
            said = labeller(episode)
            labels = None if said is None else as_vector(said, length)
        except AnswerError as e:
            answer = Answer(number, "refused", why=str(e))
        except Exception as e:
            answer = Answer(number, "failed", why=f"{type(e).__name__}: {e}")
            in_a_row += 1
            if in_a_row == patience:
                raise LabellerError(
                    f"{name} failed on {in_a_row} episodes in a row, last on episode {number} ({answer.why}). The "
                    f"{n_labelled} labels it gave before are saved; the same command goes on there"
                ) from e
        else:
            answer = Answer(number, "undecided" if labels is None else "labelled", labels)
        n_labelled += answer.kind == "labelled"
        in_a_row = in_a_row if answer.kind == "failed" else 0
        yield answer


def as_vector(said: "int | np.ndarray", length: int) -> np.ndarray:
    """int8 labels (T,) from a first failing frame or from labels.

    Raises:
        AnswerError: neither.
    """
    if np.ndim(said) == 0:
        if not isinstance(said, int | np.integer) or isinstance(said, bool) or not 0 <= said <= length:
            raise AnswerError(f"expected a frame from 0 to {length} or {length} labels, got {said!r}")
        return np.where(np.arange(length) < said, SAFE, FAILING).astype(np.int8)
    vector = np.asarray(said)
    if vector.shape != (length,) or not np.isin(vector, (FAILING, SAFE, UNLABELLED)).all():
        raise AnswerError(f"expected {length} labels of 1, 0 or -1, got shape {vector.shape}")
    return vector.astype(np.int8)
