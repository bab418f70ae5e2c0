"""From frames that a person marked to a constraint that a filter heeds, without training."""

from dataclasses import replace
from itertools import batched

import numpy as np
import torch

from lerobot_latentsafe.constraints import ConstraintError, Prototype
from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.labels import FAILING, SAFE, UNLABELLED, FailureLabels
from lerobot_latentsafe.evaluation.along_episodes import check_fit, encode_episodes
from lerobot_latentsafe.looks import Cameras
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.safety_model import SafetyModel

TOGETHER = 8
"""Episodes that are encoded side by side."""


def add_constraint(
    policy: LatentSafePolicy, frames: DatasetFrames, specification: str, of: list[str] | None = None
) -> list[Prototype]:
    """Let a filter heed what labels of this name show, besides what it heeds already; a known name is replaced.

    Args:
        frames: of the labelled dataset.
        of: the numbers that count; None: all that say what is alike.

    Raises:
        ConstraintError: the filter takes no constraints; no frame or too many are marked; a marked frame shows what the
            filter's data do not.
        UnlabelledDatasetError: there are no labels of this name.
        ValueError: a dataset of another robot, rate or camera.
    """
    model, config = policy.model, policy.config
    if not config.likeness.alike:
        raise ConstraintError(
            "this filter was trained for one failure, and takes no constraints. Train its critic again: latentsafe "
            "train-reachability --alike='{x.pos: 0.25}'"
        )
    check_fit(model, frames, Contract.read(frames.meta))
    labels = FailureLabels.load(frames.root, specification, frames.meta.repo_id, both=False)
    where, failure = _marked(model, frames, labels)
    found = config.likeness.prototypes(where[failure == FAILING], where[failure == SAFE], of)
    names = [*dict.fromkeys([*config.constraints, specification])]
    likeness = replace(config.likeness, known={**config.likeness.known, specification: found})
    likeness.require_known(names, trained=True)  # before anything is changed
    config.change(likeness=likeness, constraints=names)
    return found


def _marked(model: SafetyModel, frames: DatasetFrames, labels: FailureLabels) -> tuple[np.ndarray, np.ndarray]:
    """Where labelled frames are (N, m), and their labels (N,)."""
    own = {episode: labels.failure[labels.episode == episode] for episode in frames.episodes}
    marked = [episode for episode, failure in own.items() if (failure != UNLABELLED).any()]
    places, found = [np.zeros((0, len(model.config.likeness.alike)))], [np.zeros(0)]
    for some in batched(marked, TOGETHER):
        latents, lengths = encode_episodes(model, frames, [*some])
        with torch.no_grad():
            where = model.likeness(model.world_model.features(latents)).cpu().numpy()
        for row, n, episode in zip(where, lengths, some):
            _require_familiar(model, frames, episode, own[episode], row[:n])
            places.append(row[:n][own[episode] != UNLABELLED])
            found.append(own[episode][own[episode] != UNLABELLED])
    return np.concatenate(places), np.concatenate(found)


def _require_familiar(
    model: SafetyModel, frames: DatasetFrames, episode: int, failure: np.ndarray, where: np.ndarray
) -> None:
    """Refuse failing frames of another camera, or of a place where the filter's data never were.

    Args:
        failure, where: (T,) and (T, m), of the episode.

    Raises:
        ConstraintError: naming the frame.
    """
    failing, likeness = np.flatnonzero(failure == FAILING), model.config.likeness
    low, high = (np.array(ends) / [*likeness.alike.values()] for ends in (likeness.low, likeness.high))
    inside: np.ndarray = ((where >= low - 1) & (where <= high + 1)).all(1)  # NaN is nowhere
    strange = failing[~inside[failing]]
    if not len(strange) and model.config.trained_on.looks and len(failing):
        strange = failing[_unfamiliar(model, frames, episode, failing)]
    if len(strange):
        raise ConstraintError(
            f"frame {strange[0]} of episode {episode} of {frames.meta.repo_id} is marked as failing, and shows what "
            f"the filter's data never do. A constraint takes frames of the cameras and the scene that the filter was "
            "trained on; mark others, or train it on this dataset, too"
        )


def _unfamiliar(model: SafetyModel, frames: DatasetFrames, episode: int, numbers: np.ndarray) -> np.ndarray:
    """Which of some frames of an episode show what no frame of the data does, or nothing: bool (N,)."""
    looks = model.config.trained_on.looks
    cameras = Cameras(model.config.trained_on.cameras, looks)
    found = []
    for piece in frames.pieces(cameras.keys, episode, numbers.tolist()):
        dead, unfamiliar, _ = cameras.check({key: pictures / 255 for key, pictures in piece.items()})
        found.append(dead | unfamiliar)
    return np.concatenate(found)
