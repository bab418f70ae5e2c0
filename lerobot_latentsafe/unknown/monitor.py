"""The monitor of the unknown in the control loop: scores of a tick, alarms of an episode, evidence of a session."""

import copy
import hashlib
import logging
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.decision import Reason, first_of
from lerobot_latentsafe.host import any_of
from lerobot_latentsafe.unknown import appearance, dynamics
from lerobot_latentsafe.unknown.appearance import Library, Seen
from lerobot_latentsafe.unknown.dynamics import Usual
from lerobot_latentsafe.unknown.placement import Background, Placement
from lerobot_latentsafe.unknown.threshold import Drift, Profile

logger = logging.getLogger(__name__)

LOOKS = appearance.SCORES + 1
"""Scores of each camera."""
QUIET_S = 1.0
"""Seconds without an alarm after which what a camera shows counts as familiar again."""


class StatisticsError(ValueError):
    """A monitor without its statistics, or with those of another filter."""


class Familiar(NamedTuple):
    """All numbers that a monitor has learned. Scores are LOOKS of each camera, and two of each age of a foretelling.

    Attributes:
        library: of the cameras' patches and colours.
        background: what stands still before the cameras.
        usual: differences of foretellings; None where there is no world model.
        profile: of all S scores.
        scale: (S,), a high quantile of each score's M, so that none of them alone sets the threshold.
        strangest: (n,), M of the episodes that set the threshold, over all scores, ascending.
    """

    library: Library
    background: Background
    usual: Usual | None
    profile: Profile
    scale: np.ndarray
    strangest: np.ndarray

    def threshold(self, rank: int) -> float:
        """M_(k)."""
        return float(self.strangest[rank - 1])

    def standardised(self, scores: np.ndarray, ticks: np.ndarray) -> np.ndarray:
        """Scores (N, S) at ticks (N,), on one scale."""
        return self.profile.standardised(scores, ticks) / self.scale

    def tensors(self) -> dict[str, Tensor]:
        """As a file holds them: large ones in half precision, colours in eight bits as in a picture."""
        parts = {"library": self.library, "usual": self.usual or (), "profile": self.profile}
        found = {f"{name}.{i}": numbers for name, part in parts.items() for i, numbers in enumerate(part)}
        pictures = {"library.0": found.pop("library.0"), "background.0": self.background.mean}
        colours = {name: (numbers.clip(0, 1) * 255).round() for name, numbers in pictures.items()}
        small = {"scale": self.scale, "strangest": self.strangest}
        as_kept = (found, np.float16), (colours, np.uint8), (small, np.float32)
        arrays = {name: numbers.astype(kept) for part, kept in as_kept for name, numbers in part.items()}
        arrays["background.1"] = np.packbits(self.background.still, -1)
        return {name: torch.from_numpy(numbers) for name, numbers in arrays.items()}

    @classmethod
    def of(cls, tensors: dict[str, Tensor]) -> "Familiar":
        """The inverse of `tensors`.

        Raises:
            StatisticsError: something is missing, of another shape, or not finite.
        """
        numbers = {
            name: (tensor.float() / (255 if tensor.dtype == torch.uint8 else 1)).numpy()
            for name, tensor in tensors.items()
        }
        try:
            part = lambda name, n: [numbers[f"{name}.{i}"] for i in range(n)]  # noqa: E731
            mean, packed = numbers["background.0"], tensors["background.1"].numpy()
            still = np.unpackbits(packed, -1, count=mean.shape[-1] - 1).astype(bool)
            found = cls(
                Library(*part("library", len(Library._fields))), Background(mean, still),
                Usual(*part("usual", 4)) if "usual.0" in numbers else None, Profile(*part("profile", 2)),
                numbers["scale"], numbers["strangest"],
            )  # fmt: skip
        except KeyError as e:
            raise StatisticsError(f"the statistics of the monitor lack {e}; fit them again: latentsafe monitor") from e
        wrong = [name for name, value in numbers.items() if not np.isfinite(value).all()]
        sizes = {len(found.scale), found.profile.mean.shape[-1], found.profile.deviation.shape[-1], found.n_scores}
        if wrong or len(sizes) > 1:
            raise StatisticsError(
                f"the statistics of the monitor are of {sorted(sizes)} scores, and not finite in "
                f"{', '.join(wrong) or 'none'}; fit them again: latentsafe monitor"
            )
        return found

    @property
    def n_cameras(self) -> int:
        """How many cameras it has seen through."""
        return len(self.library.mean)

    @property
    def n_scores(self) -> int:
        """S."""
        return n_scores(self.n_cameras, self.usual)

    def scores_of(self, seen: Seen, differences: np.ndarray | None) -> np.ndarray:
        """All scores (N, S) of ticks.

        Args:
            seen: of N frames, see `appearance.views`.
            differences: (N, H, D), see `Foretold.differences`; None where there is no world model.
        """
        looks = looks_of(seen, self.library, Placement(self.background))
        return looks if self.usual is None else np.concatenate([looks, self.surprises(differences)], 1)

    def surprises(self, differences: np.ndarray) -> np.ndarray:
        """The scores (N, 2 H) of differences (N, H, D)."""
        return dynamics.surprise(differences, self.usual).reshape(len(differences), -1)

    def digest(self) -> str:
        """Identifies the numbers: the first 16 digits of a SHA-256, as a file holds them."""
        digest = hashlib.sha256()
        for name, tensor in sorted(self.tensors().items()):
            digest.update(name.encode() + tensor.numpy().tobytes())
        return digest.hexdigest()[:16]


def n_scores(n_cameras: int, usual: Usual | None) -> int:
    """How many scores there are of so many cameras, and of foretellings, if there are any."""
    return LOOKS * n_cameras + (0 if usual is None else 2 * len(usual.mean))


def looks_of(seen: Seen, library: Library, stands: Placement) -> np.ndarray:
    """Scores (N, cameras x LOOKS) of what is seen."""
    scores = [appearance.strangeness(seen, library), stands.scores(seen.grey)[..., None]]
    return np.concatenate(scores, -1).reshape(len(seen.grey), -1)


class UnknownMonitor:
    """Says at every tick how strange things are, for B robots.

    What a camera shows may become familiar again: its alarm ends after QUIET_S without one. What the world does stays
    strange: a robot that holds is easily foretold, so an alarm of the dynamics lasts until the episode ends.

    Args:
        familiar: what it has learned.
        keys: of the cameras, in order.
        alpha, rank: chance of any alarm in a healthy episode, and which of the calibration's M is the threshold.
        fps: ticks a second.

    Attributes:
        share: (B,), how strange the last tick was, as a share of the threshold: above 1 it alarms.
        drift: evidence over the session's episodes.
    """

    def __init__(self, familiar: Familiar, keys: Sequence[str], alpha: float, rank: int, fps: float):
        self.familiar, self.keys, self.alpha = familiar, list(keys), alpha
        self._stands = Placement(familiar.background)
        self.threshold = familiar.threshold(rank)
        self.foretells = familiar.usual is not None
        self.drift, self._told_drift = Drift(familiar.strangest), False
        self._quiet = math.ceil(QUIET_S * fps)
        self._tick, self._strangest = 0, np.zeros(0)
        self.reset()

    def reset(self) -> None:
        """End an episode, which counts if anything was seen in it, and begin the next."""
        for strangest in self._strangest[np.isfinite(self._strangest)].tolist():
            self.drift.add(strangest)
        if self.evidence >= 1 / self.alpha and not self._told_drift:
            self._told_drift = True
            logger.warning(
                "THE WORLD HAS DRIFTED: episodes of this session are stranger than those that the monitor was fitted "
                "on (E = %.3g, expected below %.3g). Record episodes of the world as it is now, and fit the monitor "
                "again (latentsafe monitor)", self.evidence, 1 / self.alpha,
            )  # fmt: skip
        self._tick, self._strangest = 0, np.zeros(0)
        self._since: np.ndarray | None = None
        self._surprised: np.ndarray | None = None
        self.share = np.zeros(0, np.float32)
        self._said: set[Reason] = set()

    def look(self, images: dict[str, Tensor], seen: np.ndarray) -> np.ndarray:
        """Begin a tick by what the cameras show. Returns the alarms that hold, a `Reason` each: (B,).

        Args:
            images: camera key -> (B, 3, H, W) in [0, 1].
            seen: bool (B,), whose pictures are fit to be looked at; the others' say nothing.
        """
        n = len(seen)
        if self._since is None:
            self._since, self._surprised = np.full(n, self._quiet), np.zeros(n, bool)
            self._strangest = np.full(n, -np.inf)
        scores = looks_of(appearance.views(images, self.keys), self.familiar.library, self._stands)
        strange = self._standardised(scores, slice(0, scores.shape[1]))
        strange[~seen] = np.nan
        self.share = self._note(strange, Reason.UNKNOWN_APPEARANCE)
        self._since = np.where(self.share > 1, 0, self._since + seen)
        return self.alarms

    def foresee(self, differences: np.ndarray) -> np.ndarray:
        """Go on with a tick by what was foretold of it. Returns the alarms that hold, a `Reason` each: (B,).

        Args:
            differences: (B, H, D); NaN where nothing was foretold.
        """
        scores = self.familiar.surprises(differences)
        share = self._note(self._standardised(scores, slice(-scores.shape[1], None)), Reason.UNKNOWN_DYNAMICS)
        self.share, self._surprised = np.maximum(self.share, share), self._surprised | (share > 1)
        return self.alarms

    @property
    def evidence(self) -> float:
        """E, see `Drift`."""
        return self.drift.evidence

    def end_tick(self) -> None:
        """Time goes on."""
        self._tick += 1

    @property
    def alarms(self) -> np.ndarray:
        """A `Reason` for each robot: (B,)."""
        return first_of(
            {
                Reason.UNKNOWN_APPEARANCE: self._since < self._quiet,
                Reason.UNKNOWN_DYNAMICS: self._surprised,
            }
        )

    def adopt(self, other: "UnknownMonitor") -> None:
        """Take over what another monitor remembers of the same robots."""
        for name in ("_tick", "_strangest", "_since", "_surprised", "share", "_said"):
            setattr(self, name, copy.copy(getattr(other, name)))

    def _standardised(self, scores: np.ndarray, which: slice) -> np.ndarray:
        familiar = self.familiar
        at = min(self._tick, len(familiar.profile.mean) - 1)
        mean, deviation = familiar.profile.mean[at, which], familiar.profile.deviation[at, which]
        return (scores - mean) / (deviation * familiar.scale[which])

    def _note(self, strange: np.ndarray, reason: Reason) -> np.ndarray:
        """Remember the strangest of scores (B, N); how strange each robot's are, as a share of the threshold: (B,)."""
        most = np.fmax.reduce(strange, 1, initial=-np.inf)
        self._strangest = np.maximum(self._strangest, most)
        if any_of(most > self.threshold) and reason not in self._said:
            self._said.add(reason)
            worst = int(np.nanargmax(np.where(np.isfinite(strange), strange, -np.inf).max(0)))
            logger.warning(
                "UNKNOWN %s: %.1f times the threshold", self._named(reason, worst), most.max() / self.threshold
            )
        return (most / self.threshold).astype(np.float32)

    def _named(self, reason: Reason, score: int) -> str:
        if reason == Reason.UNKNOWN_APPEARANCE:
            camera, kind = self.keys[score // LOOKS], score % LOOKS
            if kind == LOOKS - 1:
                return f"APPEARANCE: {camera} was moved or turned, or is out of focus"
            return f"APPEARANCE: {camera} shows what the data do not"
        return "DYNAMICS: what follows from the actions is not what the world model foretold"
