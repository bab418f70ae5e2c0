"""What a world model gets right: whether it obeys the action, whether it looks, and whether its margin holds up.

A world model can have a low error and ignore the action, and a filter can score well without looking. So errors are
given against shuffled actions and against copying the last frame; verdicts on whole imagined episodes against what
happened; and all of it is meant to be read beside the same numbers of a model that sees no images.
"""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.datasets.clips import Clip, ClipReader
from lerobot_latentsafe.datasets.labels import FAILING, SAFE
from lerobot_latentsafe.evaluation.statistics import wilson
from lerobot_latentsafe.latent import Belief, Latent, select
from lerobot_latentsafe.safety_model import SafetyModel

HORIZONS = (1, 5, 10)
OBSERVED = 4
"""Frames seen before imagination starts."""
AHEAD = 15
"""Ticks that are imagined from states along an episode."""


def evaluate_world_model(
    model: SafetyModel, reader: ClipReader, episodes: np.ndarray, seed: int = 0, n_windows: int = 1024,
    horizon: int = 30,
) -> dict:  # fmt: skip
    """Every number of `latentsafe eval-world-model`, on held-out episodes.

    Args:
        reader: of a cached dataset.
        episodes: their indices; each is also imagined from its first frame.
        n_windows: random windows within them, for the errors.
        horizon: ticks of an episode that are imagined.
    """
    horizon = model.config.world_model.steps(horizon)
    generator = torch.Generator().manual_seed(seed)
    model.eval()
    return {
        "errors": prediction_errors(model, reader, episodes, n_windows, generator),
        "margin": margin_quality(model, reader, episodes, n_windows, generator),
        "episodes": imagined_episodes(model, reader, episodes, generator, horizon),
        "along": foreseen_along(model, reader, episodes),
    }


@torch.no_grad()
def prediction_errors(
    model: SafetyModel, reader: ClipReader, episodes: np.ndarray, n: int, generator: torch.Generator
) -> dict:
    """Squared errors of imagined percepts at each horizon, and how much worse shuffled actions or copying are."""
    clip = _windows(model, reader, episodes, n, OBSERVED + max(HORIZONS), generator)
    start = _filtered(model, clip)
    shuffled = torch.randperm(len(clip.action), generator=generator)
    errors = {
        "true": _errors(model, start, clip, clip.action),
        "shuffled": _errors(model, start, clip, clip.action[shuffled]),
        "copied": _errors(model, start, clip, None),
    }
    return {
        f"step {h}": {name: float(error[h - 1]) for name, error in errors.items()}
        | {f"{name} / true": float(errors[name][h - 1] / errors["true"][h - 1]) for name in ("shuffled", "copied")}
        for h in HORIZONS
    }


def _errors(model: SafetyModel, latent: Latent, clip: Clip, action: Tensor | None) -> Tensor:
    """Mean error after each imagined step; without actions, of the last latent seen."""
    rows = []
    for t in range(OBSERVED, clip.state.shape[1]):
        if action is not None:
            latent = model.world_model.step(latent, action[:, t])
        percepts = {key: value[:, t] for key, value in clip.percepts.items()}
        rows.append(model.world_model.error(latent, percepts, clip.state[:, t]).mean())
    return torch.stack(rows)


@torch.no_grad()
def margin_quality(
    model: SafetyModel, reader: ClipReader, episodes: np.ndarray, n: int, generator: torch.Generator
) -> dict:
    """Balanced accuracy of l < 0 on latents of frames that were seen, and on latents imagined so many steps ahead."""
    clip = _windows(model, reader, episodes, n, OBSERVED + max(HORIZONS), generator)
    latent = _filtered(model, clip)
    margin = lambda: model.imagination.margin(latent).cpu().numpy()  # noqa: E731
    failure = clip.failure.cpu().numpy()
    row = {"seen": balanced_accuracy(margin() < 0, failure[:, OBSERVED - 1])}
    for h in range(1, max(HORIZONS) + 1):
        latent = model.world_model.step(latent, clip.action[:, OBSERVED - 1 + h])
        if h in HORIZONS:
            row[f"imagined {h}"] = balanced_accuracy(margin() < 0, failure[:, OBSERVED - 1 + h])
    return row


@torch.no_grad()
def imagined_episodes(
    model: SafetyModel, reader: ClipReader, episodes: np.ndarray, generator: torch.Generator, horizon: int
) -> dict:
    """Imagine the recorded actions of each episode from its first frame alone, and compare with what happened.

    Where episodes branch from one state, only a model that obeys the action can tell which of them fails; where they
    share one motion, only a model that looks.

    Returns:
        verdicts: balanced accuracy of "fails within `horizon` steps"; shuffled: the same under other episodes' actions;
        still: the same if holding still is imagined whatever was done; false_alarms: of the episodes that do not fail;
        hold_false_alarms: of holding still, which fails in none. None are shares of nothing.
    """
    clip = _from_the_start(model, reader, episodes, horizon + 1)
    kept = clip.failure[:, 0] == SAFE
    failed = ((clip.failure == FAILING) & clip.valid).any(1)[kept].cpu().numpy()
    percepts = {key: value[kept, 0] for key, value in clip.percepts.items()}
    start = model.world_model.observe(None, clip.action[kept, 0], percepts, clip.state[kept, 0])
    action, valid = clip.action[kept, 1:], clip.valid[kept, 1:]
    shuffled = torch.randperm(len(action), generator=generator)
    still = model.units.still_as(clip.action[kept, :1])
    verdict = _fails(model, start, action, valid)
    held = _fails(model, start, still.expand_as(action), torch.ones_like(valid))
    return {
        "failing": int(failed.sum()),
        "safe": int((~failed).sum()),
        "verdicts": balanced_accuracy(verdict, failed),
        "shuffled": balanced_accuracy(_fails(model, start, action[shuffled], valid[shuffled]), failed),
        "still": balanced_accuracy(held, failed),
        "false_alarms": share_of(verdict, ~failed),
        "hold_false_alarms": share_of(held, np.ones_like(failed)),
    }


@torch.no_grad()
def foreseen_along(model: SafetyModel, reader: ClipReader, episodes: np.ndarray) -> dict:
    """From every other state along each episode, known as a filter knows it, imagine the recorded actions.

    What a filter has seen grows with the episode, which what it was trained on did not.

    Returns:
        failing, safe: states, themselves safe, after which the episode fails within AHEAD ticks or does not; missed,
        false_alarms: of these, or None where there are none.
    """
    clip, verdicts, outcomes = whole_episodes(model, reader, episodes), [], []
    ahead = model.config.world_model.steps(AHEAD)
    for t, latent in enumerate(known_along(model, clip, clip.state.shape[1] - ahead)):
        kept = (clip.failure[:, t] == SAFE) & clip.valid[:, t + ahead]
        if t % 2 or not kept.any():
            continue
        coming = slice(t + 1, t + 1 + ahead)
        verdicts.append(_fails(model, select(latent, kept), clip.action[kept, coming], clip.valid[kept, coming]))
        outcomes.append((clip.failure[kept, coming] == FAILING).any(1).cpu().numpy())
    verdict, failed = (np.concatenate([*rows, np.zeros(0, bool)]) for rows in (verdicts, outcomes))
    return {
        "failing": int(failed.sum()),
        "safe": int((~failed).sum()),
        "missed": share_of(~verdict, failed),
        "false_alarms": share_of(verdict, ~failed),
    }


def whole_episodes(model: SafetyModel, reader: ClipReader, episodes: np.ndarray) -> Clip:
    """All frames of each episode that the world model sees."""
    longest = max(int((reader.labels.episode == e).sum()) for e in episodes)
    return _from_the_start(model, reader, episodes, model.config.world_model.steps(longest))


def known_along(model: SafetyModel, clip: Clip, n: int) -> Iterator[Latent]:
    """The posteriors after each of the first n frames of whole episodes, as far back as a filter remembers."""
    belief, history = Belief(), model.config.world_model.steps(model.config.law.history_frames)
    for t in range(n):
        belief = belief.after(lambda latent: seen(model, latent, clip, t), history)  # noqa: B023
        yield belief.latent


def _from_the_start(model: SafetyModel, reader: ClipReader, episodes: np.ndarray, length: int) -> Clip:
    """The first frames of each episode."""
    first = np.array([np.flatnonzero(reader.labels.episode == e)[0] for e in episodes])
    return reader.cut(first, model.world_model, length=length)


def seen(model: SafetyModel, latent: Latent | None, clip: Clip, t: int) -> Latent:
    """The posterior after frame t of clips."""
    action = clip.action[:, t] if latent is not None else model.units.first_action(clip.action[:, t])
    percepts = {key: value[:, t] for key, value in clip.percepts.items()}
    return model.world_model.observe(latent, action, percepts, clip.state[:, t])


def _fails(model: SafetyModel, latent: Latent, action: Tensor, valid: Tensor) -> np.ndarray:
    """Whether l < 0 at any imagined step."""
    fails = torch.zeros(len(action), dtype=torch.bool, device=action.device)
    for t in range(action.shape[1]):
        latent = model.world_model.step(latent, action[:, t])
        fails |= (model.imagination.margin(latent) < 0) & valid[:, t]
    return fails.cpu().numpy()


def share_of(wrong: np.ndarray, among: np.ndarray) -> dict[str, float] | None:
    """How many of some are wrong, both bool of one shape: {k, n, low, high}, or None where there are none."""
    return wilson(int((wrong & among).sum()), int(among.sum())) if among.any() else None


def balanced_accuracy(predicted: np.ndarray, truth: np.ndarray) -> float:
    """Mean of the two classes' accuracies; not a number where a class is absent."""
    truth = truth.astype(bool)
    if truth.all() or not truth.any():
        return float("nan")
    return float((predicted[truth].mean() + (~predicted[~truth]).mean()) / 2)


def _windows(
    model: SafetyModel, reader: ClipReader, episodes: np.ndarray, n: int, length: int, generator: torch.Generator
) -> Clip:
    """Random windows that lie within an episode."""
    index = np.flatnonzero(np.isin(reader.labels.episode, episodes))
    last = index + (length - 1) * reader.skip
    index, last = (frames[last < len(reader.labels.episode)] for frames in (index, last))
    inside = index[reader.labels.episode[last] == reader.labels.episode[index]]
    if not len(inside):
        n_frames = 1 + (length - 1) * reader.skip
        raise ValueError(f"no episode has {n_frames} frames, which the errors at {HORIZONS} steps need")
    picked = torch.randint(len(inside), (n,), generator=generator).numpy()
    return reader.cut(inside[picked], model.world_model, length=length)


def _filtered(model: SafetyModel, clip: Clip) -> Latent:
    """The latent after the first OBSERVED frames of each window."""
    latent = None
    for t in range(OBSERVED):
        latent = seen(model, latent, clip, t)
    return latent
