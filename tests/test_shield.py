import math
import re
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch

from lerobot_latentsafe.critic import FallbackConfig
from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.decision import LawConfig, Overrides, Reason
from lerobot_latentsafe.limits import Limits
from lerobot_latentsafe.shield import Shield
from lerobot_latentsafe.units import Units

IMAGE = "observation.image"
STATES = ((-0.9, 0.1, 0.0), (-0.7, -0.3, 0.5), (0.6, 0.6, 2.0))
LEFT, STRAIGHT, RIGHT = ([rate, 1.0] for rate in (1.25, 0.0, -1.25))


def along(n_steps):
    """Observations of three cars along a way."""
    x = torch.tensor(STATES)
    return [tiny.observation((x + t * torch.tensor([0.05, 0.02, 0.1])).numpy()) for t in range(n_steps)]


def actions(*rows):
    return torch.tensor(rows if len(rows) == 3 else rows * 3)


@pytest.fixture
def permissive(policy):
    """Passes whatever is not faulty."""
    policy.config.law.epsilon = -math.inf
    return policy


@pytest.fixture
def strict(policy):
    """Passes nothing."""
    policy.config.law.epsilon = math.inf
    return policy


def encode(policy, observations, taken):
    """The world model's latent after a clip of observations, with the actions that led to each."""
    images = torch.stack([policy.model.images(o[IMAGE]) for o in observations], 1)
    state = torch.stack([policy.model.units.normalise_state(o["observation.state"]) for o in observations], 1)
    action = policy.model.units.normalise_action(torch.stack(taken, 1))
    is_first = torch.zeros(state.shape[:2], dtype=torch.bool)
    is_first[:, 0] = True
    action = torch.cat([torch.zeros_like(action[:, :1]), action], 1)
    none = torch.zeros_like(is_first, dtype=torch.long)
    with torch.no_grad():
        latents = policy.model.world_model.encode(Clip({IMAGE: images}, state, action, is_first, ~is_first, none, none))
    return {key: value[:, -1] for key, value in latents.items()}


def assert_same(latent, other):
    for key in latent:
        torch.testing.assert_close(latent[key], other[key])


# -- history ---


def test_history_is_the_world_models_encoding_of_the_clip(permissive):
    observations, taken = along(4), [actions(LEFT), actions(STRAIGHT), actions(LEFT, RIGHT, STRAIGHT)]
    for observation, action in zip(observations, [*taken, actions(STRAIGHT)]):
        decision = permissive.shield(observation, action)
        assert not decision.intervened.any()
    assert_same(permissive.shield.latent, encode(permissive, observations, taken))


@pytest.mark.parametrize(("memory", "remembered"), [(0, 7), (4, 3), (5, 3), (6, 4), (12, 7)])
def test_history_is_of_the_last_frames_only_if_asked(permissive, memory, remembered):
    permissive.config.law.history_frames = memory
    observations, taken = along(7), [actions(LEFT), actions(STRAIGHT), actions(LEFT, RIGHT, STRAIGHT)] * 2
    for observation, action in zip(observations, [*taken, actions(STRAIGHT)]):
        permissive.shield(observation, action)
    last = taken[len(taken) - remembered + 1 :]
    assert_same(permissive.shield.latent, encode(permissive, observations[-remembered:], last))


def test_executed_actions_enter_the_history_not_proposed_ones(strict):
    observations, taken = along(3), []
    for observation in observations:
        decision = strict.shield(observation, actions([0.3, 1.0]))
        assert decision.intervened.all()
        taken.append(decision.action)
    assert_same(strict.shield.latent, encode(strict, observations, taken[:-1]))
    proposed = [actions([0.3, 1.0])] * 2
    assert not torch.allclose(strict.shield.latent["h"], encode(strict, observations, proposed)["h"])


def test_value_is_that_of_the_next_latent_under_the_proposed_action(permissive):
    observation = along(1)[0]
    decision = permissive.shield(observation, actions(LEFT))
    model, latent = permissive.model.world_model, permissive.shield.latent
    with torch.no_grad():
        after = permissive.model.value(model.step(latent, permissive.model.units.normalise_action(actions(LEFT))))
        now = permissive.model.margin.bounded(model.features(latent))
    torch.testing.assert_close(decision.value, torch.minimum(after, now))
    torch.testing.assert_close(decision.margin, now)


def test_reset_forgets(permissive):
    first = permissive.shield(along(1)[0], actions(LEFT)).value
    assert not torch.allclose(permissive.shield(along(2)[1], actions(LEFT)).value, first)
    permissive.shield.reset()
    torch.testing.assert_close(permissive.shield(along(1)[0], actions(LEFT)).value, first)


def test_batch_that_changes_size_within_an_episode_is_refused(permissive):
    permissive.shield(along(1)[0], actions(LEFT))
    two = {key: value[:2] for key, value in along(1)[0].items()}
    with pytest.raises(ValueError, match=r"reset\(\)"):
        permissive.shield(two, actions(LEFT)[:2])
    permissive.shield.reset()
    permissive.shield(two, actions(LEFT)[:2])


# -- faults of the observation ---


@pytest.mark.parametrize("key", [IMAGE, "observation.state"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_an_observation_that_is_not_finite_falls_back_and_says_why(permissive, key, bad):
    observation = along(1)[0]
    observation[key][1, 0] = bad
    decision = permissive.shield(observation, actions(LEFT))
    assert decision.reason.tolist() == [Reason.PASSED, Reason.OBSERVATION_NOT_FINITE, Reason.PASSED]
    assert decision.intervened.tolist() == [False, True, False]
    assert decision.action.isfinite().all() and decision.value.isfinite().all()


def test_blind_steps_go_on_by_imagination_and_sight_recovers(permissive):
    observations = along(4)
    permissive.shield(observations[0], actions(LEFT))
    before = {key: value.clone() for key, value in permissive.shield.latent.items()}
    observations[1][IMAGE][:] = math.nan
    permissive.shield(observations[1], actions(LEFT))
    with torch.no_grad():
        imagined = permissive.model.world_model.step(before, permissive.model.units.normalise_action(actions(LEFT)))
    assert_same(permissive.shield.latent, imagined)
    for observation in observations[2:]:
        decision = permissive.shield(observation, actions(LEFT))
        assert decision.reason.eq(Reason.PASSED).all()


def test_blind_rows_do_not_disturb_the_others(permissive):
    observations = along(3)
    for observation in observations:
        clean = permissive.shield(observation, actions(LEFT))
    permissive.shield.reset()
    for t, observation in enumerate(observations):
        if t == 1:
            observation["observation.state"][1] = math.nan
        disturbed = permissive.shield(observation, actions(LEFT))
    torch.testing.assert_close(disturbed.value[[0, 2]], clean.value[[0, 2]])
    assert not torch.allclose(disturbed.value[1], clean.value[1])


@pytest.mark.parametrize("missing", [IMAGE, "observation.state"])
def test_missing_key_is_named_with_what_there_is(permissive, missing):
    observation = along(1)[0]
    observation["observation.images.other"] = observation.pop(missing)
    with pytest.raises(KeyError, match=rf"lacks {missing}.*observation\.images\.other.*rename_map"):
        permissive.shield(observation, actions(LEFT))


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_covered_camera_is_missing(permissive, level):
    observation = along(1)[0]
    observation[IMAGE][2] = level
    decision = permissive.shield(observation, actions(LEFT))
    assert decision.reason.tolist() == [0, 0, Reason.OBSERVATION_MISSING]


def test_image_in_bytes_is_not_taken_for_one_in_0_to_1(permissive):
    observation = along(1)[0]
    observation[IMAGE] = observation[IMAGE] * 255
    assert permissive.shield(observation, actions(LEFT)).intervened.all()


@pytest.mark.parametrize("shape", [(3, 3, 128, 96), (3, 1, 128, 128), (3, 128, 128, 3)])
def test_image_of_other_proportions_is_refused(permissive, shape):
    observation = {**along(1)[0], IMAGE: torch.rand(shape)}
    with pytest.raises(ValueError, match=r"observation\.image has shape .*trained on \(3, \d+, \d+\).*crop"):
        permissive.shield(observation, actions(LEFT))


def test_image_of_another_size_is_averaged(permissive):
    seen = along(1)[0]
    observation = {**seen, IMAGE: seen[IMAGE].repeat_interleave(2, -1).repeat_interleave(2, -2)}
    assert permissive.shield(observation, actions(LEFT)).reason.eq(Reason.PASSED).all()


@pytest.mark.parametrize(
    ("age_s", "stale"), [(0.0, False), (0.05, False), (0.051, True), (-0.01, True), (math.nan, True)]
)
def test_old_observation_is_stale(permissive, age_s, stale):
    decision = permissive.shield(along(1)[0], actions(LEFT), age_s=age_s)
    assert decision.reason.tolist() == [Reason.OBSERVATION_STALE if stale else Reason.PASSED] * 3


def test_stale_observation_does_not_enter_the_history(permissive):
    first, second = along(2)
    permissive.shield(first, actions(LEFT))
    before = {key: value.clone() for key, value in permissive.shield.latent.items()}
    permissive.shield(second, actions(LEFT), age_s=1.0)
    with torch.no_grad():
        imagined = permissive.model.world_model.step(before, permissive.model.units.normalise_action(actions(LEFT)))
    assert_same(permissive.shield.latent, imagined)


# -- faults of the action ---


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_action_that_is_not_finite_falls_back(permissive, bad):
    decision = permissive.shield(along(1)[0], actions(LEFT, [bad, 1.0], LEFT))
    assert decision.reason.tolist() == [0, Reason.ACTION_NOT_FINITE, 0]
    assert decision.action.isfinite().all() and permissive.shield.executed[-1].isfinite().all()


@pytest.mark.parametrize("bad", [[1.6, 1.0], [-9.0, 1.0], [0.0, 2.0]])
def test_action_out_of_the_datas_range_falls_back(permissive, bad):
    decision = permissive.shield(along(1)[0], actions(LEFT, bad, LEFT))
    assert decision.reason.tolist() == [0, Reason.ACTION_OUT_OF_RANGE, 0]


def test_float_error_is_not_out_of_range(permissive):
    assert permissive.shield(along(1)[0], actions([1.2501, 1.0001])).reason.eq(Reason.PASSED).all()


@pytest.mark.parametrize("shape", [(3, 1), (3, 7), (2, 2), (3,)])
def test_action_of_another_shape_is_no_action_and_the_log_names_both(permissive, shape, caplog):
    decision = permissive.shield(along(1)[0], torch.zeros(shape))
    assert decision.reason.eq(Reason.BASE_POLICY_FAILED).all() and decision.intervened.all()
    assert re.search(r"shape \(.*expected a tensor of shape \(3, 2\).*turn_rate.vel, speed.vel", caplog.text)


def test_no_action_at_all_falls_back(permissive):
    decision = permissive.shield(along(1)[0], None)
    assert decision.reason.eq(Reason.BASE_POLICY_FAILED).all() and decision.intervened.all()


def test_first_fault_is_the_one_reported(permissive):
    observation = along(1)[0]
    observation["observation.state"][:] = math.nan
    decision = permissive.shield(observation, actions([math.nan, 1.0]), age_s=9.0)
    assert decision.reason.eq(Reason.OBSERVATION_NOT_FINITE).all()


# -- time, and when nothing can be known ---


@pytest.mark.parametrize(("took_ms", "missed"), [(9, False), (11, True)])
def test_missed_deadline_falls_back(permissive, took_ms, missed):
    times = iter([0.0, took_ms / 1e3])
    permissive.config.law.deadline_ms = 10
    permissive.shield = Shield(permissive.model, clock=lambda: next(times))
    decision = permissive.shield(along(1)[0], actions(LEFT))
    assert decision.reason.tolist() == [Reason.DEADLINE_MISSED if missed else Reason.PASSED] * 3
    assert decision.intervened.tolist() == [missed] * 3


@pytest.mark.parametrize("lookahead", [0, 3])
def test_fallback_is_the_plans_first_action_in_robot_units(strict, lookahead):
    strict.config.law.lookahead = lookahead
    decision = strict.shield(along(1)[0], actions([0.3, 1.0]))
    with torch.no_grad():
        latent = strict.shield.latent
        expected = strict.model.units.denormalise_action(strict.model.plan(latent)[1])
        if not lookahead:
            critics = strict.model.critic.fallback(strict.model.world_model.features(latent))
            torch.testing.assert_close(expected, strict.model.units.denormalise_action(critics))
    torch.testing.assert_close(decision.action, expected)
    assert all(action in [*map(tuple, tiny.CANDIDATES)] for action in map(tuple, decision.action.tolist()))


def test_one_step_is_the_papers_law_and_more_steps_look_further(strict):
    latents, margins = [], []
    for guard in (1, 3):
        strict.config.law.proposal_steps = guard
        strict.shield.reset()
        strict.shield(along(1)[0], actions(LEFT))
        action = strict.model.units.normalise_action(actions(LEFT))
        latent, least = strict.model.go_on(strict.shield.latent, action[:, None])
        expected = strict.shield.latent
        for _ in range(guard):
            expected = strict.model.world_model.step(expected, action)
        torch.testing.assert_close(latent["h"], expected["h"])
        latents.append(latent["h"])
        margins.append(least)
    assert not torch.allclose(*latents)
    assert (margins[1] <= margins[0]).all()  # what happens on the way counts


def test_once_the_filter_acts_the_policy_is_released_above_another_value(permissive):
    config, shield = permissive.config, permissive.shield
    value = shield(along(1)[0], actions(LEFT)).value
    for acting, release in ((False, 1.0), (True, value.min().item() - 1e-3), (True, value.max().item() + 1e-3)):
        shield.reset()
        shield.overrides = Overrides(3)
        config.law.resume_above, shield.overrides.recent[:, -1] = release, acting
        assert (shield(along(1)[0], actions(LEFT)).intervened == (release > value) & acting).all()
        assert shield.overrides.recent[:, -2].all() == acting


RETREAT, OUTSIDE = {"turn_rate.vel": -0.5}, [9.0, 1.0]


@pytest.fixture
def restless(permissive, monkeypatch):
    """Passes whatever is not faulty, and finds it unsafe to stay."""
    monkeypatch.setattr(permissive.shield, "_stays", lambda fault, *_: torch.zeros(len(fault), 1, dtype=torch.bool))
    return permissive


def retreats(decision):
    return (decision.action == torch.tensor([-0.5, 1.0])).all(-1).tolist()


def test_after_some_overrides_the_retreat_acts_and_goes_on(restless):
    config, shield = restless.config, restless.shield
    config.law.retreat, config.law.retreat_after, config.law.min_retreat_steps = RETREAT, 2, 3
    one = actions(OUTSIDE, LEFT, LEFT)
    for seen, (proposed, acts, retreat) in zip(along(8), (
        (one, True, False),  # the critic's action is tried twice,
        (actions(LEFT), False, False),
        (one, True, False),
        (one, True, True),  # then the retreat acts, for three steps
        (actions(LEFT), True, True),
        (actions(LEFT), True, True),
        (actions(LEFT), False, False),
        (one, True, True),  # and again, for that is not long ago
    )):  # fmt: skip
        decision = shield(seen, proposed)
        assert decision.intervened.tolist() == [acts, False, False]
        assert retreats(decision) == [retreat, False, False]
    shield.reset()
    assert retreats(shield(along(1)[0], one)) == [False] * 3


def test_a_retreat_that_does_not_help_makes_way_for_the_critic(restless):
    config, shield = restless.config, restless.shield
    config.law.retreat, config.law.min_retreat_steps, config.law.max_retreat_steps = RETREAT, 2, 3
    one = actions(OUTSIDE, LEFT, LEFT)
    for seen, (proposed, retreat) in zip(along(9), (
        *[(one, True)] * 3,  # it acts for as long as it may,
        *[(one, False)] * 3,  # then the critic's action has its turn,
        (actions(LEFT), False),  # until an action passes
        *[(one, True)] * 2,
    )):  # fmt: skip
        decision = shield(seen, proposed)
        assert decision.intervened.tolist() == [proposed is one, False, False]
        assert retreats(decision) == [retreat, False, False]


def test_overrides_of_long_ago_do_not_count(restless):
    restless.config.law.retreat, restless.config.law.retreat_after = RETREAT, 1
    for pause, retreat in ((8, True), (10, False)):
        restless.shield.reset()
        first, *between, last = along(pause + 2)
        restless.shield(first, actions(OUTSIDE))
        for seen in between:
            assert not restless.shield(seen, actions(LEFT)).intervened.any()
        assert retreats(restless.shield(last, actions(OUTSIDE))) == [retreat] * 3


def test_retreat_is_a_move_of_the_fallback_not_of_v(tiny_continuous_filter):
    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

    policy = LatentSafePolicy.from_pretrained(tiny_continuous_filter).eval()
    policy.config.law.epsilon, policy.config.law.min_retreat_steps = math.inf, 5
    before = policy.shield(along(1)[0], actions([0.3, 1.0]))
    policy.shield.reset()
    policy.config.law.retreat = RETREAT
    decision = policy.shield(along(1)[0], actions([0.3, 1.0]))
    assert retreats(decision) == [True] * 3 and retreats(before) == [False] * 3
    torch.testing.assert_close(decision.value, before.value)
    policy.config.law.mode = "monitor"
    policy.shield.reset()
    assert not policy.shield(along(1)[0], actions([0.3, 1.0])).intervened.any()
    assert not policy.shield.overrides.recent.any() and not policy.shield.overrides.retreated.any()


@pytest.mark.parametrize(
    ("retreat", "wrong"),
    [
        ({"down.pos": -0.1}, r"retreat moves down.pos; the actions are turn_rate.vel"),
        ({"turn_rate.vel": 9.0}, r"retreat moves turn_rate.vel by 9; the filter was trained on -1.25 to 1.25"),
        ({"turn_rate.vel": math.nan}, r"retreat moves turn_rate.vel by nan"),
    ],
)
def test_retreat_that_cannot_be_is_refused(tiny_continuous_filter, retreat, wrong):
    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

    policy = LatentSafePolicy.from_pretrained(tiny_continuous_filter)
    with pytest.raises(ValueError, match=wrong):
        policy.config.change(law=replace(policy.config.law, retreat=retreat))
    assert not policy.config.law.retreat
    policy.config.law.retreat = retreat
    with pytest.raises(ValueError, match=wrong):
        LatentSafePolicy(policy.config)


def test_retreat_leaves_frozen_commands_alone(policy):
    law, fallback = replace(policy.config.law, retreat=RETREAT), FallbackConfig(frozen_commands=["turn_rate.vel"])
    with pytest.raises(ValueError, match=r"moves turn_rate.vel, one of fallback.frozen_commands"):
        policy.config.change(law=law, fallback=fallback)


def test_what_was_executed_instead_is_remembered(policy):
    for told in (actions(LEFT), actions(STRAIGHT)):
        policy.shield.reset()
        policy.shield(along(1)[0], actions(LEFT))
        policy.shield.was_executed(told)
        predicted = policy.model.world_model.step(policy.shield.latent, policy.model.units.normalise_action(told))
        policy.shield(along(1)[0], actions(LEFT))
        torch.testing.assert_close(policy.shield.latent["h"], predicted["h"])


@pytest.mark.parametrize(
    ("name", "wrong", "expected"),
    [
        ("resume_above", 1.0, "less than 1"),
        ("resume_above", math.nan, "less than 1"),
        ("min_retreat_steps", 0, "at least 1 step"),
        ("max_retreat_steps", -1, "0 .no end., or at least the 1 of min_retreat_steps"),
        ("retreat_after", 11, "10 overrides"),
        ("history_frames", 1, "at least 2 frames"),
        ("history_frames", -4, "at least 2 frames"),
    ],
)
def test_settings_that_make_no_sense_are_refused(name, wrong, expected):
    with pytest.raises(ValueError, match=rf"--policy.law.{name} is {wrong}; .*{expected}"):
        LawConfig(**{name: wrong})


def test_continuous_fallback_stays_in_range(tiny_continuous_filter):
    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

    policy = LatentSafePolicy.from_pretrained(tiny_continuous_filter)
    policy.config.law.epsilon = math.inf
    action = policy.shield(along(1)[0], actions([0.3, 1.0])).action
    assert action[:, 0].abs().max() <= 1.25
    torch.testing.assert_close(action[:, 1], torch.ones(3))


def test_robot_is_held_when_even_the_latent_is_not_finite(permissive):
    with torch.no_grad():
        permissive.model.world_model.posterior_out.bias.fill_(math.nan)
    for permissive.config.law.retreat in ({}, RETREAT):
        decision = permissive.shield(along(1)[0], actions(LEFT))
        assert decision.reason.eq(Reason.VALUE_NOT_FINITE).all()
        torch.testing.assert_close(decision.action, staying(permissive, 3))


@pytest.mark.parametrize(
    "plan",
    [torch.zeros(3, 2), torch.zeros(2, 4, 2), torch.zeros(3, 4, 3), torch.zeros(3, 4, 2).to_sparse(), [[0.0, 1.0]]],
    ids=["of one action", "of two robots", "of a number more", "sparse", "a list"],
)
def test_a_plan_of_another_shape_does_not_pass(permissive, plan, caplog):
    decision = permissive.shield(along(1)[0], actions(LEFT, LEFT, LEFT), planned=plan)
    assert decision.reason.eq(Reason.BASE_POLICY_FAILED).all() and decision.intervened.all()
    assert "expected one of (robots, actions, 2)" in caplog.text


def staying(policy, n):
    """What it is for n robots to stay."""
    return torch.from_numpy(policy.model.limits.hold(np.zeros((n, 2), np.float32)))


def test_hold_is_zero_motion_or_the_nearest_the_range_allows(policy):
    assert staying(policy, 2).tolist() == [[0.0, 1.0]] * 2  # the speed never varies
    forward = replace(policy.config.trained_on, action_low=[0.25, 1.0], action_high=[0.75, 1.0])
    limits = Limits(forward, Units(forward, []))
    assert limits.hold(np.zeros((1, 2), np.float32)).tolist() == [[0.25, 1.0]]


def test_monitor_mode_lets_everything_through_and_reports(strict):
    strict.config.law.mode = "monitor"
    proposed = actions(LEFT, [9.0, 1.0], STRAIGHT)
    decision = strict.shield(along(1)[0], proposed)
    torch.testing.assert_close(decision.action, proposed)
    assert not decision.intervened.any() and decision.unsafe.all()
    assert decision.reason.tolist() == [Reason.UNSAFE_VALUE, Reason.ACTION_OUT_OF_RANGE, Reason.UNSAFE_VALUE]


@pytest.mark.parametrize(("mode", "does"), [("filter", "acts"), ("monitor", "would act")])
def test_the_first_override_of_an_episode_is_logged(strict, caplog, mode, does):
    strict.config.law.mode = mode
    for _ in range(2):
        strict.reset()
        with caplog.at_level("INFO"):
            for observation in along(3):
                strict.shield(observation, actions(STRAIGHT))
    said = f"the filter {does} for the first time in this episode: unsafe value"
    assert [message for message in caplog.messages if "first time" in message] == [said] * 2


def test_fallback_keeps_its_grip(cache_meta, tmp_path):
    """A kept command stays as it was last executed, whatever is proposed; the rest is the fallback's."""
    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
    from lerobot_latentsafe.training import train_reachability

    options = dict(fallback_action_candidates=None, fallback_frozen_commands=["turn_rate.vel"])
    stage_one = tiny.train_stage_one(cache_meta, tmp_path / "one", **options)
    train_reachability(stage_one, cache_meta, tmp_path / "two")
    policy = LatentSafePolicy.from_pretrained(tmp_path / "two")
    seen = tiny.observation([[-0.9, 0.1, 0.0]])
    policy.config.law.epsilon = -2.0  # all passes
    assert policy.shield(seen, torch.tensor([[0.7, 1.0]])).action[0, 0] == pytest.approx(0.7)
    policy.config.law.epsilon = 2.0  # nothing passes
    for _ in range(2):
        decision = policy.shield(seen, torch.tensor([[-1.0, 1.0]]))
        assert decision.intervened.all() and decision.action[0, 0] == pytest.approx(0.7, abs=1e-5)
    assert policy.shield(seen, torch.full((1, 2), torch.nan)).action[0, 0] == pytest.approx(0.7, abs=1e-5)


def test_before_anything_was_executed_the_grip_is_that_which_is_seen(tmp_path):
    """A kept command whose name the state has, in the same unit."""
    from lerobot_latentsafe.franka.actions import ACTION_NAMES, STATE_NAMES
    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

    policy = LatentSafePolicy.from_pretrained(tiny.save_franka_filter(tmp_path / "filter", law_epsilon=2.0))
    assert "gripper.pos" in STATE_NAMES
    state = torch.zeros(2, len(STATE_NAMES))
    state[:, STATE_NAMES.index("gripper.pos")] = torch.tensor([0.8, 1.2])  # beyond what can be commanded
    images = {f"observation.images.{name}": torch.rand(2, 3, 32, 32) for name in ("front", "wrist")}
    nothing, broken = None, torch.full((2, len(ACTION_NAMES)), torch.nan)
    for proposed in (nothing, broken):
        policy.shield.reset()
        decision = policy.shield({**images, "observation.state": state}, proposed)
        torch.testing.assert_close(decision.action[:, ACTION_NAMES.index("gripper.pos")], torch.tensor([0.8, 1.0]))


@pytest.mark.parametrize("law", ["plan", "margin"])
def test_baseline_laws_need_no_critic(tiny_world_model, law):
    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
    from lerobot_latentsafe.safety_model import UntrainedFilterError

    policy = LatentSafePolicy.from_pretrained(tiny_world_model)
    seen, proposed = tiny.observation([[-0.9, 0.1, 0.0]]), torch.tensor([[0.0, 1.0]])
    with pytest.raises(UntrainedFilterError, match="safety critic was never"):
        policy.shield(seen, proposed)
    policy.config.law.name = law
    decision = policy.shield(seen, proposed)
    assert decision.value.isfinite().all()
    if law == "margin":
        policy.config.law.epsilon = 2.0
        torch.testing.assert_close(policy.shield(seen, proposed).action, staying(policy, 1))


def test_unknown_law_is_refused():
    with pytest.raises(
        ValueError, match=r"law.name is 'luck'; expected one of reachability, nearest, risk, plan, margin"
    ):
        tiny.config(law_name="luck")
