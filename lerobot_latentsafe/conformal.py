"""What finitely many episodes prove: conformal ranks, binomial bounds, and tests in a fixed sequence.

Of n scores that are exchangeable with the next one, the next one is above the k-th smallest, k = ceil((n + 1) (1 -
alpha)), with probability 1 - k / (n + 1) <= alpha: on average over the n. Of given n scores the share of all that are
above it follows Beta(n + 1 - k, k), whose 95th percentile is the bound of Clopper and Pearson for n - k of n. Episodes
are exchangeable, frames are not: an episode counts once.
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

CONFIDENCE = 0.95
"""Of bounds on shares, one-sided."""

# -- shares of finitely many ---


def rank(n: int, alpha: float) -> int:
    """k = ceil((n + 1) (1 - alpha)), which is more than n where n scores do not suffice for alpha."""
    return math.ceil((n + 1) * (1 - alpha) - 1e-9)


def needed(alpha: float) -> int:
    """The least n for which `rank` is at most n: 9, 19, 49, 99 for 10, 5, 2, 1%."""
    return math.ceil(1 / alpha - 1 - 1e-9)


def at_most(m: int, n: int) -> float:
    """Of m in n, the upper one-sided 95% bound of the share (Clopper and Pearson)."""
    from scipy.stats import beta  # heavy, and the package imports this module

    return 1.0 if m >= n else float(beta.ppf(CONFIDENCE, m + 1, n - m))


def allowed(n: int, share: float) -> int | None:
    """The most m in n whose bound is at most a share; None where even none in n proves too little."""
    kept = [m for m in range(n) if at_most(m, n) <= share]
    return kept[-1] if kept else None


def needed_for_sure(share: float) -> int:
    """The least n of which none must be missed for a bound of this share: 59 for 5%."""
    return math.ceil(math.log(1 - CONFIDENCE) / math.log(1 - share) - 1e-9)


def weighted_quantile(values: np.ndarray, weights: np.ndarray, alpha: float) -> float:
    """The least of n scores up to which a share 1 - alpha of the weights lies: theirs (n,), and the next episode's.

    The next episode is taken to be as heavy as the heaviest of these (Tibshirani et al., 2019, with the worst case).

    Raises:
        ValueError: no score reaches that far.
    """
    order = np.argsort(values)
    reached = np.cumsum(weights[order]) / (weights.sum() + weights.max())
    enough = np.flatnonzero(reached >= 1 - alpha - 1e-9)
    if not len(enough):
        effective = weights.sum() ** 2 / np.square(weights).sum()
        raise ValueError(
            f"--weights: {len(values)} failing episodes of these weights are worth {effective:.1f} of one weight, the "
            f"heaviest alone {weights.max() / weights.sum():.1%} of all, too much for --alpha={alpha:g}; hold out more "
            "episodes of the kind that is heavy"
        )
    return float(values[order[enough[0]]])


# -- closed loop ---


def fixed_sequence(runs: Iterable[tuple[float, int, int]], alpha: float) -> dict[str, Any]:
    """Learn then Test (Angelopoulos et al., 2021): the least cautious epsilon that provably fails rarely.

    The failure rate under a shield is not monotone in epsilon, so each epsilon is tested, the most cautious first,
    against "it fails in more than alpha of the episodes", exactly: p = P(Binomial(n, alpha) <= failures). The first
    that is not rejected at 5% ends the sequence. So with 95% confidence none of those before it fails more often.

    Args:
        runs: epsilon, failures and episodes, of falling epsilon; no more are drawn than are tested.

    Returns:
        alpha; epsilon, None if already the first was not rejected; and tests, each with epsilon, failures, n, p_value.
    """
    from scipy.stats import binom

    tests, epsilon = [], None
    for tried, failures, n in runs:
        p_value = float(binom.cdf(failures, n, alpha))
        tests.append({"epsilon": tried, "failures": failures, "n": n, "p_value": p_value})
        if p_value > 1 - CONFIDENCE:
            break
        epsilon = tried
    return {"alpha": alpha, "epsilon": epsilon, "tests": tests}


def proven(tested: dict[str, Any]) -> float:
    """The epsilon of a fixed sequence.

    Raises:
        ValueError: already the first one was not rejected.
    """
    if tested["epsilon"] is None:
        first, alpha = tested["tests"][0], tested["alpha"]
        raise ValueError(
            f"--closed_loop: at epsilon = {first['epsilon']:g}, the most cautious, {first['failures']} of {first['n']} "
            f"runs failed, which does not prove at most {alpha:.1%} (p = {first['p_value']:.2g}). Run more "
            f"(--n_runs; {needed_for_sure(alpha)} without a failure suffice), begin with another of --epsilons, or "
            "train a better fallback"
        )
    return tested["epsilon"]
