import json
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch

from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.dubins.ground_truth import exact_value
from lerobot_latentsafe.evaluation.statistics import confusion, provenance, wilson, write_json
from lerobot_latentsafe.experiments.dubins.figures import value_slices
from lerobot_latentsafe.experiments.dubins.monitor import (
    LatentMonitor,
    PlanMonitor,
    boundary_starts,
    evaluate_monitor,
    feasible_starts,
    safe_policy_rollouts,
)
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.reports.figures import save
from lerobot_latentsafe.safety_model import UntrainedFilterError

STATES = np.random.default_rng(0).uniform([-1.1, -1.1, -np.pi], [1.1, 1.1, np.pi], (20, 3))


class ExactMonitor:
    """The exact value, and the controller that goes with it."""

    def value(self, states):
        return exact_value(states)

    def start(self):
        def act(states, kept):
            after = [exact_value(car.step(states, np.full(len(states), u))) for u in car.TURN_RATES]
            return car.TURN_RATES[np.argmax(after, 0)]

        return act


@pytest.fixture(scope="module")
def latent(tiny_filter):
    return LatentMonitor(load_filter(tiny_filter).model, chunk=8)


# -- the numbers ---


def test_confusion_by_hand():
    predicted = np.array([1, 1, 1, 1, 0, 0, 0, 0, 0, 0], bool)
    truth = np.array([1, 1, 1, 0, 1, 1, 0, 0, 0, 0], bool)
    row = confusion(predicted, truth)
    cells = [row[k] for k in ("true_safe", "false_safe", "false_unsafe", "true_unsafe")]
    assert cells == pytest.approx([0.3, 0.1, 0.2, 0.4])
    assert row["f1_safe"] == pytest.approx(6 / 9)
    assert row["f1_unsafe"] == pytest.approx(8 / 11)
    assert row["false_safe_rate"] == pytest.approx(1 / 5)  # of the five that are unsafe
    assert row["false_unsafe_rate"] == pytest.approx(2 / 5)
    assert row["balanced_accuracy"] == pytest.approx((4 / 5 + 3 / 5) / 2)
    assert row["n"] == 10


def test_perfect_monitor_scores_one():
    truth = np.array([True, False, True])
    row = confusion(truth, truth)
    assert row["f1_safe"] == row["f1_unsafe"] == row["balanced_accuracy"] == 1.0


def test_confusion_refuses_what_cannot_be_compared():
    with pytest.raises(ValueError, match="equally long"):
        confusion(np.ones(3, bool), np.ones(4, bool))
    with pytest.raises(ValueError, match="not empty"):
        confusion(np.ones(0, bool), np.ones(0, bool))


def test_wilson_by_hand():
    k, n, z = 3, 20, 1.959964
    centre = (k / n + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(k / n * (1 - k / n) / n + z**2 / (4 * n**2))
    assert wilson(k, n) == pytest.approx({"k": 3, "n": 20, "low": centre - half, "high": centre + half})
    assert wilson(0, 5)["low"] == 0.0 and wilson(5, 5)["high"] == 1.0


def test_wilson_of_nothing_is_refused():
    with pytest.raises(ValueError, match="no rollouts"):
        wilson(0, 0)


def test_results_say_where_they_came_from(tmp_path):
    row = provenance([0, 1])
    assert set(row) == {"command", "commit", "seeds", "cpu_minutes", "machine", "date"}
    write_json(tmp_path / "new" / "row.json", row)
    assert json.loads((tmp_path / "new" / "row.json").read_text())["seeds"] == [0, 1]


# -- starts ---


def test_feasible_starts_can_all_be_kept_safe():
    starts = feasible_starts()
    assert 150 < len(starts) < 300 and starts.shape[1] == 3
    assert (exact_value(starts) > 0).all()
    assert len(np.unique(starts[:, 2])) == 3


def test_boundary_starts_are_safe_by_a_hair():
    starts = boundary_starts(50, seed=1)
    value = exact_value(starts)
    assert starts.shape == (50, 3) and (value > 0).all() and (value < 0.05).all()
    np.testing.assert_array_equal(starts, boundary_starts(50, seed=1))
    assert not np.array_equal(starts, boundary_starts(50, seed=2))


def test_exact_controller_keeps_all_feasible_starts_safe():
    row, value = evaluate_monitor(ExactMonitor(), STATES, exact_value(STATES))
    assert row["balanced_accuracy"] == 1.0
    assert row["safe_policy"]["safe"] == row["safe_policy"]["n"] == len(feasible_starts())
    np.testing.assert_array_equal(value, exact_value(STATES))


class Straight(ExactMonitor):
    def start(self):
        return lambda states, kept: np.zeros(len(states))


def test_rollouts_notice_a_violation_on_the_way():
    starts = np.array([[-0.9, 0.0, 0.0], [-0.9, 0.8, 0.0], [0.9, 0.0, 0.0]])
    runs = safe_policy_rollouts(Straight(), starts)
    assert runs["failed"].tolist() == [True, False, False]
    assert (runs["safe"], runs["n"]) == (2, 3)
    assert runs["trajectories"].shape[0] == 3


def test_a_run_is_over_after_a_failure():
    runs = safe_policy_rollouts(Straight(), np.array([[-0.9, 0.0, 0.0], [-0.9, 0.8, 0.0]]))
    stopped, driven = runs["trajectories"][:, -1, 0]
    assert -0.5 < stopped < -0.4 and driven > 1.1


def test_what_is_out_of_view_cannot_fail():
    runs = safe_policy_rollouts(Straight(), np.array([[1.08, 0.0, 0.0]]), n_steps=5)
    assert runs["safe"] == 1
    assert np.abs(runs["trajectories"][0, -1, 0]) < 1.3  # the run is over


def test_value_that_is_not_finite_is_refused():
    class Broken(ExactMonitor):
        def value(self, states):
            return np.where(np.arange(len(states)) == 2, np.nan, 1.0)

    with pytest.raises(FloatingPointError, match="not finite on 1 of 20 states"):
        evaluate_monitor(Broken(), STATES, exact_value(STATES))


# -- learned monitors ---


@pytest.mark.parametrize("kind", [LatentMonitor, PlanMonitor])
def test_learned_monitors_run(latent, kind):
    monitor = latent if kind is LatentMonitor else PlanMonitor(latent, horizon=3)
    value = monitor.value(STATES)
    assert value.shape == (20,) and np.isfinite(value).all() and np.ptp(value) > 0
    assert (value <= latent.margin(STATES) + 1e-6).all()
    act = monitor.start()
    for states in (STATES, car.step(STATES, np.zeros(20))):
        assert set(np.round(act(states, np.ones(20, bool)), 4)) <= set(car.TURN_RATES)


def test_who_drives_alone_drives_as_beside_others(latent):
    """Runs that are over are left out of the batch."""
    together, alone = latent.start(), latent.start()
    kept = np.arange(20) % 3 > 0
    together(STATES, np.ones(20, bool))
    alone(STATES[kept], np.ones(kept.sum(), bool))
    after = car.step(STATES, np.zeros(20))[kept]
    np.testing.assert_allclose(together(after, kept), alone(after, np.ones(kept.sum(), bool)), atol=1e-5)


@pytest.mark.parametrize("law", [{}, {"lookahead": 0}, {"name": "plan"}])
def test_the_verdict_is_the_sign_of_v(latent, law):
    config = latent.model.config
    before = config.law
    config.change(law=replace(before, **law))
    verdicts = torch.cat([latent.safe(z) for z in latent.latents(STATES)])
    np.testing.assert_array_equal(verdicts.numpy(), latent.value(STATES) > 0)
    config.change(law=before)


def test_value_does_not_depend_on_the_chunk(latent):
    whole = LatentMonitor(latent.model, chunk=2048)
    np.testing.assert_allclose(latent.value(STATES), whole.value(STATES), atol=1e-5)


def test_plan_without_a_horizon_is_the_margin(latent):
    np.testing.assert_allclose(PlanMonitor(latent, horizon=0).value(STATES), latent.margin(STATES), atol=1e-6)
    longer, shorter = (PlanMonitor(latent, horizon=h).value(STATES) for h in (6, 2))
    assert (longer <= shorter + 1e-6).all()


def test_plan_does_not_look_beyond_the_end_of_the_episode(latent, monkeypatch):
    one_step = PlanMonitor(latent, horizon=1).value(STATES)
    assert not np.allclose(PlanMonitor(latent, horizon=8).value(STATES), one_step)
    over = lambda z: torch.ones(len(z["h"]), dtype=torch.bool)  # noqa: E731
    monkeypatch.setattr(latent.model.world_model, "ended", over)
    np.testing.assert_allclose(PlanMonitor(latent, horizon=8).value(STATES), one_step, atol=1e-6)


def test_fallback_remembers_within_a_rollout_only(latent):
    act, all_drive = latent.start(), np.ones(20, bool)
    first = act(STATES, all_drive)
    act(STATES + 0.1, all_drive)
    np.testing.assert_array_equal(latent.start()(STATES, all_drive), first)


def test_monitor_sees_what_the_shield_sees(latent, policy):
    """The second frame of a straight drive gives the same latent in deployment."""
    heading = STATES[:, 2]
    before = STATES.copy()
    before[:, :2] -= car.DT * np.stack([np.cos(heading), np.sin(heading)], -1)
    policy.config.change(law=policy.config.law.changed(LawOptions(epsilon=0.0, mode="monitor")))
    policy.reset()
    straight = torch.from_numpy(policy.model.limits.hold(np.zeros((20, 2), np.float32)))
    for states in (before, STATES):
        policy.shield(tiny.observation(states), straight)
    for key, value in latent.latent(STATES).items():
        np.testing.assert_allclose(policy.shield.latent[key], value, atol=1e-5)


def test_value_slices_are_drawn(latent, tmp_path):
    figure = value_slices({"latent": latent, "exact": ExactMonitor()}, n=9)
    assert len(figure.axes) == 8  # two headings and their colour bars, for each monitor
    save(figure, tmp_path / "slices.png")
    assert (tmp_path / "slices.png").stat().st_size > 1000


def test_filter_without_a_critic_is_no_monitor(tiny_world_model):
    with pytest.raises(UntrainedFilterError):
        LatentMonitor(load_filter(tiny_world_model).model)


def test_filter_of_another_rate_is_no_monitor_of_the_car(policy):
    policy.config.change(trained_on=replace(policy.config.trained_on, fps=15))
    with pytest.raises(ValueError, match=r"trained at 15 fps.*runs at 20 fps"):
        LatentMonitor(policy.model)
