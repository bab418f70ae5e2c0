"""A threshold that healthy episodes cross with a stated chance, and evidence over episodes that the world has drifted.

A score u_t is standardised by the time t of the episode, and an episode is as strange as its strangest moment:

    M_i = max_t (u_t - mu_t) / sigma_t

Of n healthy episodes that set nothing else, M_(k) with k = ceil((n + 1)(1 - alpha)) is exceeded in a further healthy
episode with a chance of alpha at most, whatever the distribution (Vovk et al. 2005): the chance of *any* alarm in it.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lerobot_latentsafe.conformal import needed, rank

PRIOR = 20.0
"""Frames that the mean over all times counts for, beside those of one time."""
LEAST = 0.1
"""Standard deviation of a score at least: of a logarithm, a tenth of what it is of. One that hardly ever changes would
otherwise set the threshold where it does."""
LONGEST = 600
"""Ticks of an episode that have means of their own, at most."""


class TooFewEpisodesError(ValueError):
    """Fewer healthy episodes than the asked chance of a false alarm needs."""


class Profile(NamedTuple):
    """Mean and standard deviation of S scores at each tick of an episode, both (T, S); the last holds ever after."""

    mean: np.ndarray
    deviation: np.ndarray

    def standardised(self, score: np.ndarray, ticks: np.ndarray) -> np.ndarray:
        """Scores (N, S) at ticks (N,) in standard deviations from the mean."""
        at = np.minimum(ticks, len(self.mean) - 1)
        return (score - self.mean[at]) / self.deviation[at]


def profile(episodes: Sequence[np.ndarray], smooth: float) -> Profile:
    """The profile of scores of episodes, (T_i, S) each, NaN where there is none; smoothed over so many ticks.

    An episode may begin anywhere, so a time is never surer than half of all times are: sigma_t is at least half the
    deviation over all of them, and LEAST.
    """
    length = min(LONGEST, max(map(len, episodes)))
    n, total, square = (np.zeros((length, episodes[0].shape[1])) for _ in range(3))
    for scores in episodes:
        part = scores[:length]
        n[: len(part)] += np.isfinite(part)
        total[: len(part)] += np.nan_to_num(part)
        square[: len(part)] += np.nan_to_num(part) ** 2
    weight = np.exp(-0.5 * ((np.arange(length)[:, None] - np.arange(length)) / smooth) ** 2)
    everywhere = np.nanmean(np.concatenate(episodes), 0), np.nanvar(np.concatenate(episodes), 0)
    n, total, square = weight @ n + PRIOR, weight @ total, weight @ square
    mean = (total + PRIOR * everywhere[0]) / n
    second = (square + PRIOR * (everywhere[1] + everywhere[0] ** 2)) / n
    variance = np.maximum(second - mean**2, everywhere[1] / 4)
    return Profile(mean.astype(np.float32), np.sqrt(np.maximum(variance, LEAST**2)).astype(np.float32))


def rank_of(n: int, alpha: float) -> int:
    """Which of n sorted episodes is the threshold, counted from 1.

    Raises:
        TooFewEpisodesError: they are too few for alpha.
    """
    k = rank(n, alpha)
    if k > n:
        raise TooFewEpisodesError(
            f"{n} healthy episodes are left to set the threshold, and a false alarm in {alpha:.3g} of healthy episodes "
            f"at most needs {needed(alpha)}; record more, or allow more false alarms (--alpha)"
        )
    return k


class Drift:
    """Evidence over the episodes of a session that they are not as those of the calibration: an e-process.

    The p-value of an episode is the share of those before it, and itself, that are as strange. If the world is as it
    was, p is uniform or larger, and E = prod of integral of kappa p^(kappa - 1) over kappa in [0, 1] exceeds 1 / alpha
    at any time with a chance of alpha at most (Ville). Each episode is one of those before the next.

    Args:
        known: M of the calibration's episodes (n,).

    Attributes:
        log_evidence: natural logarithm of E.
    """

    def __init__(self, known: np.ndarray):
        self.log_evidence, self._known = 0.0, [float(m) for m in known]

    @property
    def evidence(self) -> float:
        """E."""
        return math.exp(min(self.log_evidence, 700.0))

    def add(self, strangest: float) -> None:
        """Note an episode's M."""
        at_least = 1 + sum(m >= strangest for m in self._known)
        self._known.append(strangest)
        self.log_evidence += math.log(e_value(at_least / len(self._known)))


def e_value(p: float) -> float:
    """(1 - p + p log p) / (p log^2 p), the mean over kappa of the calibrators kappa p^(kappa - 1); 1/2 at p = 1."""
    log = math.log(p)
    return 0.5 if p > 1 - 1e-4 else (1 - p + p * log) / (p * log**2)
