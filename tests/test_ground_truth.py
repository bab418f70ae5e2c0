import sys

import numpy as np
import pytest

from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.dubins.ground_truth import (
    PAPER_GRID,
    exact_value,
    grid_states,
    load_states,
    solve_continuous,
    solve_grid,
    truth_on,
)


def random_states(n=2000, half_width=1.1, seed=0):
    bounds = np.array([half_width, half_width, np.pi])
    return np.random.default_rng(seed).uniform(-bounds, bounds, (n, 3))


def brute_force(states, turn_rates, horizon):
    """V by trying every action sequence of this length."""
    n, k = len(states), len(turn_rates)
    worst = car.margin(states)
    for _ in range(horizon):
        states, worst = np.repeat(states, k, 0), np.repeat(worst, k)
        states = car.step(states, np.tile(turn_rates, len(states) // k))
        worst = np.minimum(worst, car.margin(states))
    return worst.reshape(n, -1).max(1)


def test_inside_the_disc_is_unsafe_and_far_away_is_safe():
    value = exact_value(np.array([[0.0, 0.0, 0.0], [0.6, 0.0, 0.0], [-1.1, 1.1, np.pi]]))
    assert value[0] < 0
    assert value[1] == pytest.approx(0.36 - 0.25)  # already leaving: the smallest margin is now
    assert value[2] > 0


def test_head_on_close_up_is_doomed_but_not_from_afar():
    value = exact_value(np.array([[-0.6, 0.0, 0.0], [-1.1, 0.0, 0.0]]))
    assert value[0] < 0 < car.margin(np.array([-0.6, 0.0, 0.0]))
    assert value[1] > 0


def test_no_action_sequence_beats_the_oracle():
    states = random_states(5000, half_width=0.7)
    value, distance = exact_value(states), np.hypot(states[:, 0], states[:, 1])
    near = (distance > car.RADIUS) & (distance < 0.75)  # 10 steps take it past the disc
    doomed_by_a_hair = states[near & (value < 0) & (value > -0.01)][:15]
    assert len(doomed_by_a_hair) == 15
    assert (brute_force(doomed_by_a_hair, car.TURN_RATES, 10) < 0).all()


def test_oracle_is_the_best_of_all_sequences_in_sign():
    states = random_states(300, half_width=0.7)
    tried = brute_force(states, car.TURN_RATES, 7)
    np.testing.assert_array_equal(exact_value(states, n_steps=7) > 0, tried > 0)


def test_oracle_agrees_with_value_iteration():
    n, n_headings, half_width = 61, 48, 1.5
    V, sweeps = solve_grid(n, n_headings, half_width)
    assert V.shape == (n, n, n_headings) and sweeps > 10
    states = grid_states(((-half_width, half_width, n), (-half_width, half_width, n), (0, 2 * np.pi, n_headings)))
    V = V.reshape(-1)
    agree = (exact_value(states) > 0) == (V > 0)
    assert agree.mean() >= 0.999
    assert agree[np.abs(V) > 0.01].all()  # what is left is the grid's own error along the boundary


def test_value_is_symmetric_under_rotation_and_reflection():
    states = random_states(500)
    turn = 0.7
    c, s = np.cos(turn), np.sin(turn)
    rotated = np.stack(
        [c * states[:, 0] - s * states[:, 1], s * states[:, 0] + c * states[:, 1], states[:, 2] + turn], -1
    )
    np.testing.assert_allclose(exact_value(rotated), exact_value(states), atol=1e-9)
    np.testing.assert_allclose(exact_value(states * [1, -1, -1]), exact_value(states), atol=1e-9)


def test_fewer_actions_never_help():
    states = random_states()
    both, one_sided = exact_value(states), exact_value(states, (0.0, 1.25))
    assert (one_sided[both <= 0] <= 0).all()
    assert (one_sided <= 0).sum() > (both <= 0).sum()


def test_one_sided_oracle_misses_no_sequence():
    states = random_states(500, half_width=0.7)
    tried = brute_force(states, (0.0, 1.25), 9)
    assert ((exact_value(states, (0.0, 1.25), n_steps=9) > 0) == (tried > 0)).mean() > 0.99


def test_paper_grid():
    states = grid_states()
    assert len(states) == 51 * 51 * 53
    assert states[:, 2].max() == pytest.approx(2 * np.pi * 52 / 53)
    np.testing.assert_allclose(states[0], [-1.1, -1.1, 0.0])


@pytest.fixture(scope="module")
def continuous():
    pytest.importorskip("hj_reachability")
    return solve_continuous()


def test_continuous_truth_of_the_paper(continuous):
    assert continuous.shape == tuple(axis[2] for axis in PAPER_GRID)
    assert (continuous <= 0).mean() == pytest.approx(0.220, abs=0.003)
    discrete = exact_value(grid_states()) > 0
    assert (discrete == (continuous.reshape(-1) > 0)).mean() > 0.99


def test_continuous_truth_between_nodes(continuous):
    states, value = truth_on(None, "continuous")
    some = np.random.default_rng(0).integers(len(states), size=200)
    full_turns = np.array([0, 0, 2 * np.pi]) * np.array([[-1], [0], [1]] * 67)[:200]
    np.testing.assert_allclose(truth_on(states[some] + full_turns, "continuous")[1], value[some], atol=1e-4)
    beyond = truth_on(np.array([[3.0, 0.0, 0.0]]), "continuous")[1]
    assert beyond > 0


def test_discrete_truth_on_given_states():
    states = random_states(10)
    scored, value = truth_on(states, "discrete")
    np.testing.assert_array_equal(scored, states)
    np.testing.assert_array_equal(value, exact_value(states))


def test_unknown_truth_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"--truth is 'paper'.*'discrete' or 'continuous'"):
        truth_on(None, "paper")


def test_missing_extra_names_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "hj_reachability", None)
    with pytest.raises(ImportError, match=r"\[ground-truth\].*--truth=discrete"):
        solve_continuous.__wrapped__()  # not the cached solution


def test_states_are_read_back(tmp_path):
    np.save(tmp_path / "states.npy", np.arange(6).reshape(2, 3))
    assert load_states(tmp_path / "states.npy").dtype == float


@pytest.mark.parametrize(
    "array",
    [np.zeros((4, 2)), np.zeros(3), np.zeros((0, 3)), np.full((2, 3), np.nan), np.array([[0, np.inf, 0]])],
    ids=["two columns", "one row", "empty", "nan", "inf"],
)
def test_bad_states_are_refused(tmp_path, array):
    np.save(tmp_path / "states.npy", array)
    with pytest.raises(ValueError, match=r"expected finite \(N, 3\)"):
        load_states(tmp_path / "states.npy")
