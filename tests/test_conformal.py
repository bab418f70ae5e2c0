"""What finitely many episodes prove, against tables of the literature and against chance itself."""

import numpy as np
import pytest
from scipy.stats import binomtest

from lerobot_latentsafe.conformal import (
    allowed,
    at_most,
    fixed_sequence,
    needed,
    needed_for_sure,
    proven,
    rank,
    weighted_quantile,
)


@pytest.mark.parametrize("alpha, n", [(0.1, 9), (0.05, 19), (0.02, 49), (0.01, 99), (0.5, 1), (0.3, 3)])
def test_how_many_episodes_a_share_takes(alpha, n):
    assert needed(alpha) == n
    assert rank(n, alpha) <= n < rank(n - 1, alpha) + 1
    assert rank(n - 1, alpha) > n - 1


@pytest.mark.parametrize("m, n", [(0, 59), (1, 93), (2, 124)])
def test_how_many_prove_five_percent_with_confidence(m, n):
    assert allowed(n, 0.05) == m
    assert allowed(n - 1, 0.05) == (m - 1 if m else None)
    assert needed_for_sure(0.05) == 59


@pytest.mark.parametrize("m, n", [(0, 1), (0, 20), (3, 20), (19, 20), (20, 20)])
def test_the_bound_is_that_of_clopper_and_pearson(m, n):
    # a two-sided interval of 90% ends where a one-sided one of 95% does
    exact = binomtest(m, n, alternative="two-sided").proportion_ci(0.9, method="exact").high
    assert at_most(m, n) == pytest.approx(exact if m < n else 1.0)


@pytest.mark.parametrize("n, alpha", [(19, 0.05), (40, 0.05), (60, 0.1), (9, 0.1)])
def test_a_rank_misses_no_more_than_was_asked_and_its_bound_holds(n, alpha):
    """Scores are uniform, so the share missed of all is 1 - the rank's score."""
    drawn = np.sort(np.random.default_rng(0).uniform(size=(4000, n)), 1)
    k = rank(n, alpha)
    missed = 1 - drawn[:, k - 1]
    assert missed.mean() == pytest.approx(1 - k / (n + 1), abs=4 * missed.std() / 4000**0.5)
    assert missed.mean() <= alpha + 4 * missed.std() / 4000**0.5
    assert (missed > at_most(n - k, n)).mean() == pytest.approx(0.05, abs=0.015)


def test_equal_weights_are_no_weights_and_heavier_ones_count_more():
    scores, rng = np.arange(20.0), np.random.default_rng(1)
    shuffled = rng.permutation(scores)
    for weight in (0.2, 1.0, 7.0):
        assert weighted_quantile(shuffled, np.full(20, weight), 0.2) == scores[rank(20, 0.2) - 1]
    towards_low = weighted_quantile(scores, np.where(scores < 5, 3.0, 1.0), 0.3)
    towards_high = weighted_quantile(scores, np.where(scores > 14, 3.0, 1.0), 0.3)
    assert towards_low < weighted_quantile(scores, np.ones(20), 0.3) < towards_high


def test_a_shift_of_known_likelihood_is_undone():
    """Calibrated where scores are uniform, used where low and high ones occur in a ratio of 1 to 3."""
    rng, missed, unweighted = np.random.default_rng(2), [], []
    for _ in range(500):
        scores = rng.uniform(size=100)
        weights = np.where(scores > 0.5, 1.5, 0.5)
        there = lambda epsilon: 1.5 * (1 - epsilon) if epsilon > 0.5 else 0.75 + 0.5 * (0.5 - epsilon)  # noqa: E731
        missed.append(there(weighted_quantile(scores, weights, 0.1)))
        unweighted.append(there(np.sort(scores)[rank(100, 0.1) - 1]))
    assert np.mean(missed) <= 0.1 < np.mean(unweighted)


def test_weights_that_leave_too_little_are_refused():
    with pytest.raises(ValueError, match=r"worth 1\.2 of one weight, the heaviest alone 90\.\d% of all.*--alpha=0.05"):
        weighted_quantile(np.arange(30.0), np.r_[270.0, np.ones(29)], 0.05)


SEQUENCES = [
    ([(0.5, 0, 60), (0.3, 0, 60), (0.1, 9, 60), (0.0, 0, 60)], 0.3, 3),  # what comes after a failure is not tried
    ([(0.5, 0, 60), (0.3, 0, 60)], 0.3, 2),
    ([(0.5, 1, 60), (0.3, 0, 60)], None, 1),  # nothing is proven, though less caution might fail less
    ([(0.5, 1, 93), (0.4, 2, 124)], 0.4, 2),
    ([(0.5, 20, 20)], None, 1),
]


@pytest.mark.parametrize("runs, epsilon, tried", SEQUENCES)
def test_a_sequence_ends_with_the_first_that_is_not_proven(runs, epsilon, tried):
    drawn = []
    tested = fixed_sequence((drawn.append(run) or run for run in runs), 0.05)
    assert (tested["epsilon"], len(tested["tests"]), len(drawn)) == (epsilon, tried, tried)
    for test in tested["tests"]:
        exact = binomtest(test["failures"], test["n"], 0.05, alternative="less").pvalue
        assert test["p_value"] == pytest.approx(exact)
    if epsilon is None:
        with pytest.raises(ValueError, match=r"the most cautious, \d+ of \d+ runs failed.*--n_runs; 59 without"):
            proven(tested)
    else:
        assert proven(tested) == epsilon
