"""One yardstick for world models of every kind: rssm, gru, dino_wm, and beside them those that cannot be good.

All of them are shown the same recorded frames, imagine the same recorded actions, and are held against the same truth,
in the spaces of `token_space.py`. Beside them stand controls, which tell what a number is worth: a copy of the last
frame, the mean of the data, and the first of the models deaf to actions. What a model cannot say is None: a blind one
tells no frames, and one that skips frames none between its steps.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.datasets.labels import FAILING, SAFE
from lerobot_latentsafe.evaluation.token_space import (
    ALL,
    SPACES,
    Copy,
    Futures,
    Imagination,
    Mean,
    TokenSpace,
    moments,
    ticks_a_step,
)
from lerobot_latentsafe.evaluation.world_model import (
    OBSERVED,
    imagined_episodes,
    known_along,
    share_of,
    whole_episodes,
)
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.training import cached_reader

TOLD_AT, FORETOLD_AT = ("0.4 s", "0.8 s", "2 s"), "1 s"
"""Moments that a summary tells of: of errors, and of the difference between two futures."""
SAME_STATE = 1e-3
"""Numbers of the state by which the first frames of two branches differ at most."""

Views = dict[str, dict[str, Any]]
"""Space -> all cameras, or one of them -> what is told of them."""


class Branches(NamedTuple):
    """Episodes that start from one state: (B,) each.

    Attributes:
        start: the frame that a future is imagined from, the same of all branches of a state.
        follow: the first frame of each branch.
        group: which state it starts from.
    """

    start: np.ndarray
    follow: np.ndarray
    group: np.ndarray

    def of(self, chosen: list[int]) -> "Branches":
        """Some of them."""
        return Branches(*(column[chosen] for column in self))


def compare_world_models(
    policies: Mapping[str, str], meta: LeRobotDatasetMetadata, episodes: np.ndarray, branches: int = 0,
    pictures: LeRobotDatasetMetadata | None = None, few: np.ndarray | None = None, horizon: int = 30,
    n_windows: int = 512, seed: int = 0,
) -> dict[str, dict]:  # fmt: skip
    """Score world models side by side on one recording that none of them was trained on.

    Args:
        policies: name -> checkpoint.
        meta: of the recording with a token cache.
        episodes: numbers of those to use.
        branches: so many episodes that follow each other start from one state; 0: no two do.
        pictures: the same recording with a cache of pictures, for world models that read those.
        few: see `missed_failures`.
        horizon: recorded ticks of an episode that are imagined for a verdict on it.
        n_windows: random windows, for the errors.

    Returns:
        name -> row, controls last. A row holds `world_model` (its type; None of controls), `errors`
        (`prediction_errors`), `counterfactual` (`counterfactual_r2`), `verdicts` (`imagined_episodes`) and `seen`
        (`missed_failures`).

    Raises:
        FrameCacheError, EncoderMismatchError: a cache that does not fit a model.
        ValueError: a model reads pictures and there are none, the caches are of two recordings, branches do not start
            from one state, or episodes are too short.
    """
    space = TokenSpace(meta)
    models = {name: loaded(path, space, meta, pictures) for name, path in policies.items()}
    slowest = max(ticks_a_step(model.config) for model, _ in models.values())
    windows = _windows(space, meta, episodes, (OBSERVED - 1) * slowest, n_windows, seed)
    states = branches_of(space, meta, episodes, branches) if branches else None

    def row(futures: Futures, **more: Any) -> dict:
        return {
            "errors": prediction_errors(futures, space, windows, torch.Generator().manual_seed(seed)),
            "counterfactual": None if states is None else counterfactual_r2(futures, space, states),
            **{"world_model": None, "verdicts": None, "seen": None, **more},
        }

    rows: dict[str, dict] = {}
    deaf: dict[str, dict] = {}
    for name, (model, reader) in models.items():
        steps, generator = max(1, horizon // ticks_a_step(model.config)), torch.Generator().manual_seed(seed)
        verdicts = imagined_episodes(model, reader, episodes, generator, steps)
        wrong = missed_failures(model, reader, episodes, few)
        told = {"world_model": model.config.world_model.type, "verdicts": verdicts, "seen": wrong}
        rows[name] = row(Imagination(model, reader, space), **told)
        if rows[name]["errors"] and not deaf:
            same = {"verdicts": verdicts["still"], "hold_false_alarms": verdicts["hold_false_alarms"]}
            deaf[f"{name}, deaf"] = row(Imagination(model, reader, space, deaf=True), verdicts=same, seen=wrong)
    return rows | deaf | {"copy of the last frame": row(Copy(space)), "mean of the data": row(Mean(space))}


def summarised(row: dict) -> dict:
    """The few numbers of a row that tell world models apart; what it does not know is None."""
    at = lambda s, what: {moment: _at(row, "errors", s, moment, ALL, what) for moment in TOLD_AT}  # noqa: E731
    return {
        "errs": {s: at(s, "true") for s in SPACES},
        "hears": {s: at(s, "shuffled / true") for s in SPACES},
        "foretells": {s: _at(row, "counterfactual", s, FORETOLD_AT, ALL) for s in SPACES},
        "tells_apart": _at(row, "verdicts", "verdicts"),
        "fails_holding": _at(row, "verdicts", "hold_false_alarms"),
        "few_missed": _at(row, "seen", "few_missed"),
    }  # fmt: skip


def _at(entry: Any, *path: str) -> Any:
    for key in path:
        entry = None if entry is None else entry[key]
    return entry


# -- what is asked ---


def prediction_errors(
    futures: Futures, space: TokenSpace, windows: np.ndarray, generator: torch.Generator
) -> dict[str, dict[str, Any]] | None:
    """Squared distances of what is foretold from what was recorded, and how much larger they are by shuffled actions.

    Args:
        windows: (N,), the last frames that are seen.

    Returns:
        Space -> moment -> all cameras, or one of them -> true, shuffled, shuffled / true: 1 says that the action is not
        heard. None if no tokens are told.
    """
    shuffled, rows = windows[torch.randperm(len(windows), generator=generator).numpy()], {}
    for (moment, true), (_, false) in zip(futures(windows, windows, OBSERVED), futures(windows, shuffled, OBSERVED)):
        if true is None or false is None:
            return None
        recorded = space.recorded(windows + moment.ticks)
        rows[moment.name] = _in_each_view(_compared, space.views(true - recorded), space.views(false - recorded))
    return _by_space(rows, space)


def _compared(true: Tensor, shuffled: Tensor) -> dict[str, float]:
    error, worse = (difference.square().sum(-1).mean() for difference in (true, shuffled))
    return {"true": error.item(), "shuffled": worse.item(), "shuffled / true": (worse / error).item()}


def counterfactual_r2(futures: Futures, space: TokenSpace, branches: Branches) -> dict[str, dict[str, Any]] | None:
    """How much of the difference between two futures of one state is foretold from their actions alone.

    R^2 = 1 - sum |d - d*|^2 / sum |d*|^2 over all pairs of branches of one state. There d* is the difference between
    the two recorded frames, d that between the two imagined ones. All branches of a state are imagined from the same
    frame, so who does not hear the action says d = 0, and has exactly 0. The truth has 1. What is wrong alike in both
    futures counts for nothing here: that is what the errors tell.

    The sums run over each branch's difference from the mean of its state's branches. That is the same ratio, as
    sum_{i<j} |x_i - x_j|^2 = n sum_i |x_i - mean|^2, and a branch weighs as much where a state has fewer of them.

    Returns:
        Space -> moment -> all cameras, or one of them -> R^2. None if no tokens are told.
    """
    rows = {}
    for moment, tokens in futures(branches.start, branches.follow, 1):
        if tokens is None:
            return None
        recorded = space.recorded(branches.follow + moment.ticks)
        said, true = (space.views(_from_the_mean(frames, branches.group)) for frames in (tokens, recorded))
        rows[moment.name] = _in_each_view(_r2, said, true)
    return _by_space(rows, space)


def _from_the_mean(tokens: Tensor, group: np.ndarray) -> Tensor:
    """Each branch's difference from the mean of its state's: (B, P, C)."""
    return torch.cat([rows - rows.mean(0) for rows in tokens.split(np.unique(group, return_counts=True)[1].tolist())])


def _r2(said: Tensor, true: Tensor) -> float:
    return float(1 - (said - true).square().sum() / true.square().sum())


def _in_each_view(function: Callable[[Tensor, Tensor], Any], first: Views, second: Views) -> Views:
    return {s: {view: function(d, second[s][view]) for view, d in views.items()} for s, views in first.items()}


def _by_space(rows: dict[str, Views], space: TokenSpace) -> dict[str, dict[str, Any]]:
    """Moment -> space -> views as space -> moment -> views, None at moments of which nothing is told."""
    return {s: {m.name: rows[m.name][s] if m.name in rows else None for m in moments(space.fps)} for s in SPACES}


@torch.no_grad()
def missed_failures(model: SafetyModel, reader: ClipReader, episodes: np.ndarray, few: np.ndarray | None) -> dict:
    """Which frames the margin l judges wrongly along whole episodes, of those that a filter has just seen.

    Args:
        few: bool, one for each frame of the recording: little has failed, such as one candy that fell; None: unknown.

    Returns:
        missed: of the failing frames; few_missed: of those of them where little has failed; false_alarms: of the safe
        ones. None where there are none, or where it is unknown.
    """
    clip = whole_episodes(model, reader, episodes)
    latents = known_along(model, clip, clip.state.shape[1])
    alarm = torch.stack([model.imagination.margin(latent) < 0 for latent in latents], 1).cpu().numpy()
    failure = torch.where(clip.valid, clip.failure, -1).cpu().numpy()
    first = np.array([np.flatnonzero(reader.labels.episode == e)[0] for e in episodes])
    index = first[:, None] + ticks_a_step(model.config) * np.arange(alarm.shape[1])
    little = np.zeros_like(alarm) if few is None else few[np.minimum(index, len(few) - 1)]
    return {
        "missed": share_of(~alarm, failure == FAILING),
        "few_missed": share_of(~alarm, (failure == FAILING) & little),
        "false_alarms": share_of(alarm, failure == SAFE),
    }


# -- of which frames ---


def branches_of(space: TokenSpace, meta: LeRobotDatasetMetadata, episodes: np.ndarray, n: int) -> Branches:
    """The branches among episodes of which each n that follow each other start from one state.

    Raises:
        ValueError: they do not, or no two of them last as long as is compared.
    """
    rows = [meta.episodes[int(e)] for e in episodes]
    first, length = (np.array([row[key] for row in rows]) for key in ("dataset_from_index", "length"))
    group, longest = episodes // n, max(moment.ticks for moment in moments(space.fps))
    kept = length > longest
    kept &= np.isin(group, [g for g in np.unique(group) if (kept & (group == g)).sum() > 1])
    if not kept.any():
        raise ValueError(
            f"no two of the {len(episodes)} episodes that start from one state have more than {longest} frames; give "
            "--branches=0, or more episodes"
        )
    follow, group = first[kept], group[kept]
    start = follow[np.searchsorted(group, group)]
    apart = np.abs(space.cache.state[start] - space.cache.state[follow]).max(-1)
    if (apart > SAME_STATE).any():
        e, f = (episodes[kept][i] for i in (np.searchsorted(group, group[apart.argmax()]), apart.argmax()))
        raise ValueError(
            f"episodes {e} and {f} of {meta.repo_id} start from states that differ by {apart.max():.3g}; expected each "
            f"{n} episodes that follow each other to start from one state. Give the number of branches of the recording"
        )
    return Branches(start, follow, group)


def _windows(
    space: TokenSpace, meta: LeRobotDatasetMetadata, episodes: np.ndarray, before: int, n: int, seed: int
) -> np.ndarray:
    """Frames (n,) drawn from those that have so many frames of their episode before them, and all moments after."""
    after = max(moment.ticks for moment in moments(space.fps))
    rows = [meta.episodes[int(e)] for e in episodes]
    inside = [np.arange(row["dataset_from_index"] + before, row["dataset_to_index"] - after) for row in rows]
    frames = np.concatenate(inside)
    if not len(frames):
        raise ValueError(
            f"no episode of {meta.repo_id} has more than {before + after} frames, which errors {after / space.fps:.1f} "
            "s ahead need; record longer ones"
        )
    return frames[torch.randint(len(frames), (n,), generator=torch.Generator().manual_seed(seed)).numpy()]


def loaded(
    path: str, space: TokenSpace, meta: LeRobotDatasetMetadata, pictures: LeRobotDatasetMetadata | None
) -> tuple[SafetyModel, ClipReader]:
    """A filter's model, and the reader of the recording as its world model perceives it."""
    policy = load_filter(path)
    model = policy.model.eval()
    if model.world_model.percept_names != model.world_model.image_keys:
        return model, cached_reader(policy, meta)
    if pictures is None:
        raise ValueError(
            f"the world model of {path} reads pictures, and the recording is known by its tokens; cache its pictures "
            f"(latentsafe cache --image_size={model.config.world_model.image_size}) and give them with --pictures"
        )
    reader = cached_reader(policy, pictures)
    known, other = (cache.manifest["fingerprint"] for cache in (space.cache, reader.cache))
    if known != other:
        raise ValueError(
            f"{pictures.root} holds the pictures of another recording ({other}) than {meta.root} the tokens ({known}); "
            "cache the same one twice"
        )
    return model, reader
