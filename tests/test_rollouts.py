import math
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature

from lerobot_latentsafe import LatentSafeDubinsEnv
from lerobot_latentsafe.decision import LawOptions, Reason
from lerobot_latentsafe.dubins.car import step as car_step
from lerobot_latentsafe.envs import dubins_env
from lerobot_latentsafe.evaluation.rollouts import (
    Choice,
    Episodes,
    VectorWorld,
    check_environment,
    compare,
    run_episodes,
    steps,
)
from lerobot_latentsafe.experiments.dubins.figures import trajectories
from lerobot_latentsafe.modeling_latentsafe import load_filter

N, LENGTH = 4, 12


def car(**changes):
    return LatentSafeDubinsEnv(**{"episode_length": LENGTH, **changes})


@pytest.fixture(scope="module")
def shielded(tiny_filter, tiny_diffusion):
    return load_filter(tiny_filter, base_policy=tiny_diffusion)


@pytest.fixture(scope="module")
def result(shielded):
    return compare(shielded, car(), N, seed=0, n_videos=2)


class Countdown:
    """Two numbers that count down to 0 by what is taken off; `info` is their values."""

    def __init__(self, *numbers):
        self.info = np.array(numbers)

    @property
    def over(self):
        return self.info <= 0

    def observe(self):
        return {"left": self.info}

    def step(self, action):
        self.info = self.info - action


def test_an_environment_that_tells_no_failure_is_refused_and_one_without_a_task_is_not(monkeypatch):
    monkeypatch.setattr(dubins_env.DubinsEnv, "_info", lambda self, success: {"is_success": success})
    with pytest.raises(ValueError, match=r"latentsafe_dubins tells no `failure` in its info.*it tells is_success"):
        VectorWorld(car(), [0])
    monkeypatch.undo()
    known = dubins_env.DubinsEnv.reset

    def nameless(self, **options):
        del self.task_description, self.task
        return known(self, **options)

    monkeypatch.setattr(dubins_env.DubinsEnv, "reset", nameless)
    with closing(VectorWorld(car(), [0, 1])) as world:
        assert world.task == ["", ""]


def test_the_loop_goes_on_until_all_episodes_have_ended():
    seen, taken = [], np.array([1, 2])
    made = list(steps(Countdown(1, 5), lambda batch: seen.append(batch["left"].tolist()) or Choice(taken)))
    assert seen == [[1, 5], [0, 3], [-1, 1]]
    assert [step.alive.tolist() for step in made] == [[True, True], [False, True], [False, True]]
    assert [(step.before.tolist(), step.info.tolist()) for step in made[:2]] == [([1, 5], [0, 3]), ([0, 3], [-1, 1])]
    assert all(step.action is taken and step.decision is None for step in made)
    assert not list(steps(Countdown(0, 0), lambda batch: pytest.fail("nothing is left to do")))


def test_bare_and_shielded_start_from_the_same_states(result):
    bare, shielded = (result["episodes"][name] for name in ("bare", "shielded"))
    for a, b in zip(bare.traces, shielded.traces):
        assert a["state"][0] == pytest.approx(b["state"][0])
    assert len({tuple(t["state"][0]) for t in bare.traces}) == N


def test_starts_are_those_of_the_seeds(result, shielded):
    env = dubins_env.DubinsEnv()
    starts = [env.reset(seed=seed)[1]["state"] for seed in range(N)]
    np.testing.assert_allclose([t["state"][0] for t in result["episodes"]["bare"].traces], starts)
    later = run_episodes(shielded.base, car(episode_length=1), 1, seed=2)
    np.testing.assert_allclose(later.traces[0]["state"][0], starts[2])


def test_every_episode_is_counted_once(result):
    for name in ("bare", "shielded"):
        rates = result[name]
        counts = [rates[outcome]["k"] for outcome in ("success", "violation", "incompletion")]
        assert rates["stall"]["k"] <= rates["incompletion"]["k"]
        assert sum(counts) == N and all(rates[outcome]["n"] == N for outcome in ("success", "violation"))
        assert 0 <= rates["success"]["low"] <= rates["success"]["high"] <= 1


def test_bare_run_overrides_nothing(result):
    assert result["bare"]["overridden_share"] == 0.0 and result["bare"]["mean_action_change"] == 0.0


def test_steps_and_reasons_add_up(result):
    episodes = result["episodes"]["shielded"]
    assert sum(result["reasons"].values()) == episodes.steps.sum()
    assert set(result["reasons"]) <= {reason.name.lower() for reason in Reason}
    acted = sum(sum(t["intervened"]) for t in episodes.traces)
    assert result["shielded"]["overridden_share"] == pytest.approx(acted / episodes.steps.sum())
    for trace, n_steps in zip(episodes.traces, episodes.steps):
        assert len(trace["value"]) == len(trace["action"]) == n_steps
        assert len(trace["state"]) == n_steps + 1


def test_frames_are_kept_of_the_episodes_asked_for(result):
    episodes = result["episodes"]["bare"]
    assert len(episodes.frames) == 2
    assert episodes.frames[0][0].shape == (128, 128, 3)


def test_traced_actions_lead_from_state_to_state(result):
    for trace in result["episodes"]["shielded"].traces:
        states, rates = np.array(trace["state"]), np.array(trace["action"])[:, 0]
        np.testing.assert_allclose(car_step(states[:-1], rates), states[1:], atol=1e-5)


@pytest.mark.parametrize(("epsilon", "share"), [(-math.inf, 0.0), (math.inf, 1.0)])
def test_extreme_epsilons_override_nothing_or_all(shielded, monkeypatch, epsilon, share):
    law = shielded.config.law.changed(LawOptions(epsilon=epsilon))
    monkeypatch.setattr(shielded.config, "law", law)
    row = compare(shielded, car(), 2, seed=0)
    assert row["shielded"]["overridden_share"] == share
    if share == 0.0:
        assert row["shielded"]["mean_action_change"] == 0.0 and row["violation_p_value"] == 1.0
        first = [row["episodes"][name].traces[0]["action"] for name in ("bare", "shielded")]
        np.testing.assert_allclose(*first)


def test_more_episodes_than_environments_run_in_batches(shielded):
    whole = run_episodes(shielded.base, car(), 3, seed=5, batch_size=3)
    parts = run_episodes(shielded.base, car(), 3, seed=5, batch_size=2)
    for a, b in zip(whole.traces, parts.traces):
        assert a["state"][0] == b["state"][0]
    assert len(parts.success) == 3


def test_outcomes_by_hand():
    flags = lambda *values: np.array(values, bool)  # noqa: E731
    episodes = Episodes(
        success=flags(1, 0, 0, 0),
        violation=flags(0, 1, 0, 0),
        stall=flags(0, 0, 1, 0),
        steps=np.array([10, 10, 10, 10]),
        overridden=np.array([0, 4, 0, 0]),
        action_change=np.array([0.0, 2.0, 0.0, 0.0]),
        severity=np.array([0.0, 0.5, 0.0, 0.0]),
    )
    rates = episodes.rates()
    assert [rates[k]["k"] for k in ("success", "violation", "stall", "incompletion")] == [1, 1, 1, 2]
    assert rates["overridden_share"] == pytest.approx(0.1) and rates["mean_action_change"] == pytest.approx(0.05)


def test_a_violation_counts_even_when_the_goal_is_reached(shielded, monkeypatch):
    """Straight through the disc, and on to the right edge."""
    straight = torch.from_numpy(shielded.model.limits.hold(np.zeros((1, 2), np.float32)))
    monkeypatch.setattr(shielded.base, "propose", lambda _: straight)
    monkeypatch.setattr(dubins_env, "sample_task_start", lambda _: np.array([-0.9, 0.0, 0.0]))
    episodes = run_episodes(shielded.base, car(episode_length=80), 1, seed=0)
    assert episodes.violation.all() and not episodes.success.any()
    assert episodes.traces[0]["state"][-1][0] > 0.899


def test_environment_of_another_rate_is_refused(shielded):
    with pytest.raises(ValueError, match=r"--env.fps is 10, the filter was trained at 20"):
        compare(shielded, car(fps=10), N, seed=0)


def test_environment_of_another_action_space_is_refused(policy):
    env = car()
    env.features["action"] = PolicyFeature(FeatureType.ACTION, (7,))
    with pytest.raises(ValueError, match=r"takes actions of shape \(7,\).*turn_rate.vel, speed.vel"):
        check_environment(policy, env)


def test_environment_without_the_camera_is_refused(policy):
    env = car()
    del env.features["pixels"]
    with pytest.raises(ValueError, match=r"lacks observation.image; it offers"):
        check_environment(policy, env)


def test_nothing_to_shield_is_refused(policy):
    with pytest.raises(ValueError, match=r"nothing to shield.*--base_policy_path"):
        compare(policy, car(), N, seed=0)


def test_figures_and_videos_are_written(result, tmp_path):
    from lerobot_latentsafe.reports import figures

    episodes = result["episodes"]
    figures.save(trajectories(episodes), tmp_path / "new" / "trajectories.png")
    spilled = {"bare": replace(episodes["bare"], severity=np.array([0.0, 0.04, 0.5, 1.0]))}
    figures.save(figures.severities(spilled), tmp_path / "severities.png")
    figures.save(figures.value_trace(episodes["shielded"].traces[0], 0.0), tmp_path / "trace.png")
    videos = figures.write_videos(episodes, tmp_path / "videos")
    assert len(videos) == 2
    for file in (tmp_path / "new" / "trajectories.png", tmp_path / "severities.png", tmp_path / "trace.png", *videos):
        assert file.stat().st_size > 1000
