"""Fitting the monitor of the unknown to healthy episodes: nothing is trained.

Episodes are replayed through the filter's own shield, so that what is measured is what will be seen. They fall into
three parts. From the first the kinds of patches and the usual surprises are learned, from the second mu_t and sigma_t,
and the third sets the threshold. So the threshold is of episodes that set nothing else, and its chance of a false alarm
holds whatever the other two are like: the first may be what the filter was trained on.
"""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.constants import OBS_STATE
from torch import Tensor
from tqdm import tqdm

from lerobot_latentsafe.conformal import needed
from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.label_places import UnlabelledDatasetError
from lerobot_latentsafe.datasets.labels import FAILING, FailureLabels
from lerobot_latentsafe.datasets.live_cameras import sampled_episodes
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, world_model_digest
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.shield import Shield
from lerobot_latentsafe.units import Monitored
from lerobot_latentsafe.unknown import appearance, dynamics, placement
from lerobot_latentsafe.unknown.appearance import Seen
from lerobot_latentsafe.unknown.dynamics import Usual
from lerobot_latentsafe.unknown.monitor import Familiar, n_scores
from lerobot_latentsafe.unknown.threshold import TooFewEpisodesError, profile, rank_of

logger = logging.getLogger(__name__)

FEWEST = 3
"""Episodes of each part that is learned from."""
SCALED_AT = 0.85
"""Share of healthy episodes whose M by one score is below that score's unit: scores with heavy tails set no threshold
for the others then. The median does not do."""
SMOOTH_S = 0.5
"""Seconds over which mu_t and sigma_t are smoothed."""


@dataclass(frozen=True)
class Replayed:
    """What a shield made of an episode.

    Attributes:
        seen: of all T frames.
        differences: (T, H, D), see `Foretold.differences`; None of a guard.
    """

    seen: Seen
    differences: np.ndarray | None


class Gatherer:
    """In the place of a monitor: keeps what one would look at, and alarms at nothing.

    Args:
        keys: of the cameras, in order.
        foretells: whether there is a world model.
    """

    evidence = 1.0

    def __init__(self, keys: Sequence[str], foretells: bool):
        self.keys, self.foretells = list(keys), foretells
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self._seen: list[Seen] = []
        self._differences: list[np.ndarray] = []
        self.share = np.zeros(1, np.float32)

    def look(self, images: dict[str, Tensor], seen: np.ndarray) -> np.ndarray:
        """Keep what is looked at in a tick."""
        self._seen.append(appearance.views(images, self.keys))
        return np.zeros(len(seen), np.int64)

    def foresee(self, differences: np.ndarray) -> np.ndarray:
        """Keep the differences of a tick."""
        self._differences.append(differences)
        return np.zeros(len(differences), np.int64)

    def end_tick(self) -> None:
        """Nothing to do."""

    def replayed(self) -> Replayed:
        """What was kept of the episode."""
        return Replayed(Seen.joined(self._seen), np.concatenate(self._differences) if self.foretells else None)


# -- which episodes ---


def healthy_episodes(meta: LeRobotDatasetMetadata, contract: Contract, specification: str) -> list[int]:
    """Episodes in which nothing is labelled as failing; without labels all of them.

    Args:
        contract: of the episodes that are meant.
    """
    meant = np.unique(contract.episode)
    try:
        labels = FailureLabels.load(meta.root, specification, meta.repo_id)
    except UnlabelledDatasetError:
        logger.warning("%s has no failure labels: all of its episodes count as healthy", meta.repo_id)
        return meant.tolist()
    failing = np.unique(labels.episode[labels.failure == FAILING])
    return np.setdiff1d(meant, failing).tolist()


def parts_of(episodes: list[int], alpha: float, has_reference: bool) -> tuple[list[int], list[int], list[int]]:
    """Episodes to learn from, to standardise by, and to set the threshold by, drawn at random.

    Raises:
        TooFewEpisodesError: naming how many there must be.
    """
    learned = 0 if has_reference else FEWEST
    least = needed(alpha) + FEWEST + learned
    if len(episodes) < least:
        raise TooFewEpisodesError(
            f"there are {len(episodes)} healthy episodes, and a false alarm in {alpha:.3g} of them at most needs "
            f"{least}: {needed(alpha)} that set the threshold, {least - needed(alpha)} for the rest. Record more, or "
            "allow more false alarms (--alpha)"
        )
    order = np.random.default_rng(0).permutation(episodes).tolist()
    # Of 19, 39, 59 ... episodes none is lost to rounding up: their rank is 19, 38, 57 for an alpha of 5%.
    unit, most = needed(alpha) + 1, (2 / 3 if has_reference else 1 / 2) * len(order)
    threshold = max(1, int((most + 1) / unit)) * unit - 1
    rest = order[threshold:]
    n_learned = 0 if has_reference else min(round(2 / 3 * len(rest)), len(rest) - FEWEST)
    return rest[:n_learned], rest[n_learned:], order[:threshold]


# -- replaying ---


def replay(
    policy: LatentSafePolicy, meta: LeRobotDatasetMetadata, contract: Contract, episodes: list[int], foretells: bool
) -> Iterator[Replayed]:
    """Episodes of a dataset, as if each action were proposed when it was recorded; see `replayed`."""
    model, frames = policy.model, DatasetFrames(meta, episodes)
    keys = model.world_model.image_keys
    for episode in tqdm(episodes, "looking through healthy episodes", unit="episode", leave=False):
        own, pieces = contract.only([episode]), frames.pieces(keys, episode)
        pictures = ({key: part[key][None] for key in keys} for piece in pieces for part in _each(piece))
        yield replayed(model, pictures, own.state, own.action, foretells)


def _each(piece: dict[str, Tensor]) -> Iterator[dict[str, Tensor]]:
    for t in range(len(next(iter(piece.values())))):
        yield {key: pictures[t] for key, pictures in piece.items()}


@torch.no_grad()
def replayed(
    model: SafetyModel, pictures: Iterator[dict[str, Tensor]], state: np.ndarray, action: np.ndarray,
    foretells: bool = True,
) -> Replayed:  # fmt: skip
    """An episode of a robot.

    Args:
        pictures: of each tick, camera key -> uint8 (1, 3, H, W).
        state, action: (T, S) and (T, A) in robot units.
        foretells: whether the world model, if there is one, foretells what follows.
    """
    shield = Shield(model, clock=standing_still)
    foretells = foretells and model.config.law.name != "guard"
    shield.monitor = gatherer = Gatherer(model.world_model.image_keys, foretells)
    for seen, s, a in zip(pictures, torch.from_numpy(state), torch.from_numpy(action)):
        images = {key: picture.float() / 255.0 for key, picture in seen.items()}
        shield({**images, OBS_STATE: s[None]}, a[None])
        shield.was_executed(a[None])  # the recording went on as it did
    return gatherer.replayed()


# -- fitting ---


def fit_monitor(
    policy: LatentSafePolicy, meta: LeRobotDatasetMetadata, contract: Contract, alpha: float = 0.05,
    reference: tuple[LeRobotDatasetMetadata, Contract] | None = None, foretells: bool = True,
) -> LatentSafePolicy:  # fmt: skip
    """The policy with a monitor of the unknown.

    Args:
        meta, contract: of the recording whose healthy episodes the filter was not trained on.
        alpha: the chance of any alarm in a healthy episode.
        reference: a recording of what is familiar, such as that which the filter was trained on; by default a part of
            the other one.
        foretells: whether to watch what follows from the actions, too, where there is a world model.

    Raises:
        ValueError: an alpha that is no share, or too few healthy episodes for it.
    """
    if not 0 < alpha < 1:
        raise ValueError(f"--alpha is {alpha}; expected a share of healthy episodes, above 0 and below 1")
    policy.model.require_trained_for_law()
    specification = policy.config.margin.failure_specification
    healthy = healthy_episodes(meta, contract, specification)
    learned, standard, threshold = parts_of(healthy, alpha, reference is not None)
    source = (meta, contract)
    if reference is not None:
        source, episodes = reference, healthy_episodes(*reference, specification)
        lengths = reference[1].only(episodes).lengths
        learned = [episodes[place] for place in sampled_episodes(lengths, appearance.FRAMES)]
    first = list(replay(policy, *source, learned, foretells))
    second, third = (list(replay(policy, meta, contract, part, foretells)) for part in (standard, threshold))
    familiar = learn(first, second, third, SMOOTH_S * meta.fps)
    return with_monitor(policy, familiar, alpha, len(learned) + len(standard))


def learn(
    first: Sequence[Replayed], second: Sequence[Replayed], third: Sequence[Replayed], smooth: float
) -> Familiar:  # fmt: skip
    """All numbers of a monitor, of three parts of the episodes; smoothed over so many ticks."""
    shown = Seen.joined([episode.seen for episode in first])
    library, background = appearance.learn(shown), placement.learn(shown.grey)
    usual: Usual | None = None
    if first[0].differences is not None:
        usual = dynamics.learn(np.concatenate([episode.differences for episode in first]))
    nothing = np.ones(n_scores(len(library.mean), usual), np.float32)
    familiar = Familiar(library, background, usual, profile([nothing[None]], 1.0), nothing, np.zeros(1, np.float32))
    familiar = Familiar.of(familiar.tensors())  # as it will be read from its file: what is left unsaid is small
    scores = [familiar.scores_of(*vars(episode).values()) for episode in second]
    familiar = familiar._replace(profile=profile(scores, smooth))
    scale = np.quantile([strangest(familiar, score) for score in scores], SCALED_AT, axis=0)
    familiar = Familiar.of(familiar._replace(scale=np.maximum(scale, 0.5).astype(np.float32)).tensors())
    most = [strangest(familiar, familiar.scores_of(*vars(episode).values())).max() for episode in third]
    return Familiar.of(familiar._replace(strangest=np.sort(most).astype(np.float32)).tensors())


def strangest(familiar: Familiar, scores: np.ndarray) -> np.ndarray:
    """The strangest moment of an episode by each of its scores (T, S): (S,)."""
    return np.fmax.reduce(familiar.standardised(scores, np.arange(len(scores))), 0)


def with_monitor(policy: LatentSafePolicy, familiar: Familiar, alpha: float, fitted_on: int) -> LatentSafePolicy:
    """The policy with a monitor of these numbers."""
    config, world_model = policy.config, policy.model.world_model
    record = Monitored(
        alpha=alpha, episodes=len(familiar.strangest), rank=rank_of(len(familiar.strangest), alpha),
        fitted_on=fitted_on,
        cameras=list(world_model.image_keys), image_size=config.world_model.image_size,
        dynamics=familiar.usual is not None, world_model=world_model_digest(policy.model), statistics=familiar.digest(),
    )  # fmt: skip
    config.change(trained_on=replace(config.trained_on, monitor=record))
    policy.monitor_by(familiar)
    return policy
