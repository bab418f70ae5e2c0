"""Where misses come from: of recorded failures that a filter did not warn of in time, which part of it is to blame.

The first of these that holds:

    doomed       it failed before the lead had passed since its start: nothing could have warned in time
    fallback     V <= epsilon, but later than the lead that was asked for: it is up to the fallback then
    margin       l > 0 of the failing frame as it is seen: the margin is blind to this failure
    world_model  l > 0 of it as imagined from the last tick in time, with the actions that were then done: it came
                 otherwise than it was imagined
    value        imagination foresees the failure with these actions, and V said that there was a way out

A recording cannot tell whether the way out was there: for that a simulator is branched.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.datasets.labels import FAILING
from lerobot_latentsafe.evaluation.decision_values import EpisodeDecisions, decision_values
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.safety_model import SafetyModel

CAUSES = ("doomed", "fallback", "margin", "world_model", "value")


@dataclass(frozen=True)
class Misses:
    """Failing episodes, and why those that were missed were.

    Attributes:
        warned: episodes that were warned of in time.
        missed: cause -> episodes, each of CAUSES.
    """

    warned: list[int]
    missed: dict[str, list[int]]

    def shares(self) -> dict[str, float]:
        """Cause -> share of the missed episodes; nothing where none was missed."""
        n = sum(map(len, self.missed.values()))
        return {cause: len(episodes) / n for cause, episodes in self.missed.items()} if n else {}


def explain_misses(model: SafetyModel, reader: ClipReader, episodes: np.ndarray, lead_steps: int) -> Misses:
    """Why failing ones among these episodes of a cached dataset were not warned of `lead_steps` before their failure.

    Raises:
        ValueError: none of them fails.
    """
    failing = [row for row in decision_values(model, reader, episodes) if (row.failure == FAILING).any()]
    if not failing:
        raise ValueError(
            f"none of {len(episodes)} episodes fails, so none was missed; name others (--dataset.episodes)"
        )
    found = Misses([], {cause: [] for cause in CAUSES})
    for row in failing:
        cause = _cause(model, reader, row, lead_steps)
        (found.warned if cause is None else found.missed[cause]).append(row.episode)
    return found


def read_causes(file: Path) -> dict[str, int]:
    """Cause -> missed episodes, from a file of `latentsafe explain-misses`.

    Raises:
        ValueError: it is none.
    """
    try:
        missed = json.loads(file.read_text(encoding="utf-8"))["missed"]
        return {cause: len(missed[cause]) for cause in CAUSES}
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise ValueError(f"--misses={file} is no file of latentsafe explain-misses ({type(e).__name__}: {e})") from e


def _cause(model: SafetyModel, reader: ClipReader, row: EpisodeDecisions, lead_steps: int) -> str | None:
    """Why a failing episode was missed; None: it was not."""
    failed, acts = int(np.flatnonzero(row.failure == FAILING)[0]), ~(row.value > model.config.law.epsilon)
    if failed < lead_steps:
        return "doomed"
    in_time = failed - lead_steps
    if acts[: in_time + 1].any():
        return None
    if acts[: failed + 1].any():
        return "fallback"
    if not row.margin[failed] <= 0:
        return "margin"
    return "value" if imagined_margin(model, reader, row.episode, in_time, failed) <= 0 else "world_model"


@torch.no_grad()
def imagined_margin(model: SafetyModel, reader: ClipReader, episode: int, seen: int, failed: int) -> float:
    """The least l on the way to frame `failed` of an episode, imagined from frame `seen` on with the recorded actions.

    What was seen until there is filtered, as many frames as the law remembers at least.
    """
    world_model, skip = model.world_model, reader.skip
    first = seen % skip
    if remembered := world_model.config.steps(model.config.law.history_frames) // 2:
        first = max(first, seen - skip * (remembered - 1))
    start = int(np.flatnonzero(reader.labels.episode == episode)[0]) + first
    observed, steps = (seen - first) // skip + 1, world_model.config.steps(failed - seen)
    clip = reader.cut(np.array([start]), world_model, length=observed + steps)
    latent: Latent | None = None
    for t in range(observed):
        percepts = {key: value[:, t] for key, value in clip.percepts.items()}
        latent = world_model.observe(latent, clip.action[:, t], percepts, clip.state[:, t])
    return least_margin(model, latent, (clip.action[:, t] for t in range(observed, observed + steps)))


@torch.no_grad()
def least_margin(model: SafetyModel, latent: Latent, actions: Iterable[Tensor]) -> float:
    """The least l on the way from a latent of one robot under the actions (1, K A) of steps, as they are heard."""
    imagination, margins = model.imagination, []
    for action in actions:
        latent = imagination.follow(latent, action)
        margins.append(imagination.margin(latent).item())
    return min(margins)
