"""Law `nearest`: what is executed is near the proposal and safe, or it is the fallback; nothing faulty is adjusted."""

import math

import numpy as np
import pytest
import tiny
import torch

from lerobot_latentsafe.calibration import belonging
from lerobot_latentsafe.datasets.decisions import Journal, decision_columns
from lerobot_latentsafe.decision import LawConfig, LawOptions, Reason
from lerobot_latentsafe.evaluation.decision_values import RecordedShield
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.nearest import Asked, Candidates, choose, shortlist
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.shield import Shield

PICTURE, STATE = "observation.images.front", "observation.state"
POSE = torch.tensor([tiny.ARM_POSE])
AHEAD = torch.tensor([[2.0, -1.0, 0.5]])
"""What the arm's policy wants: some degrees from the pose."""


@pytest.fixture(scope="module")
def arm_folder(tmp_path_factory):
    return tiny.save_arm_filter(tmp_path_factory.mktemp("arm") / "filter")


@pytest.fixture
def arm(arm_folder):
    policy = LatentSafePolicy.from_pretrained(arm_folder).eval()
    policy.config.law.name = "nearest"
    return policy


@pytest.fixture
def safer_when_slower(monkeypatch):
    """In place of imagination: V falls from 1 as the first command of an action grows, and is 0 at a motion of .3."""
    value = lambda heard: 1 - heard[:, 0].abs() / 0.3  # noqa: E731
    monkeypatch.setattr(SafetyModel, "value_of_holding", lambda self, latent, heard, roughly=False: value(heard))
    original = SafetyModel.through

    def through(self, latent, margin, least, v):
        return torch.full_like(original(self, latent, margin, least, v), -0.9)  # no proposal passes

    monkeypatch.setattr(SafetyModel, "through", through)


def seen(pose=POSE, t=0):
    picture = torch.rand(len(pose), 3, 32, 32, generator=torch.Generator().manual_seed(t))
    return {PICTURE: picture, STATE: pose.clone()}


# -- the choice ---

COLUMN = lambda *values: np.float32(values)[:, None]  # noqa: E731


@pytest.mark.parametrize(
    ("value", "away", "kappa", "last", "expected"),
    [
        ((0.5, 0.9, 0.8), (0.1, 0.3, 0.2), 2, None, 0),  # the nearest that passes
        ((0.1, 0.9, 0.8), (0.1, 0.3, 0.2), 2, None, 2),  # at the threshold is not above it
        ((0.5, 0.9, 0.8), (0.1, 0.3, 0.2), 0.2, None, 2),  # not too far below the safest
        ((0.5, 0.9, 0.8), (0.1, 0.3, 0.2), 0, None, 1),
        ((math.nan, math.inf, 0.8), (0.1, 0.2, 0.3), 2, None, 2),  # what is no number is not safe
        ((0.1, -0.9, math.nan), (0.1, 0.3, 0.2), 2, None, -1),
        ((0.5, 0.5, 0.5), (0.2, 0.2, 0.2), 2, None, 0),
        ((0.5, 0.5, 0.5), (0.2, 0.2, 0.2), 2, 1, 1),  # of those as near, the last accepted
        ((0.5, 0.5, 0.5), (0.2, 0.3, 0.3), 2, 1, 0),
    ],
)
def test_the_nearest_that_passes_is_chosen(value, away, kappa, last, expected):
    accepted = (np.arange(3) == last)[:, None] if last is not None else np.zeros((3, 1), bool)
    assert choose(COLUMN(*value), COLUMN(*away), np.float32([0.1]), kappa, accepted).tolist() == [expected]


def test_the_shortlist_holds_the_safest_and_the_nearest_that_seem_safe():
    value, away = COLUMN(0.0, 0.5, 0.6, 0.95, 0.7, 0.99), COLUMN(0.0, 0.5, 0.4, 2.0, 0.3, 0.1)
    sound = np.array([True] * 5 + [False])[:, None]
    assert shortlist(value, away, sound, np.array([0.1]), 2)[:, 0].tolist() == [3, 4, 2]


# -- the candidates ---


def asked(arm, proposed, hold=POSE):
    numbers = [x.numpy() for x in (proposed, hold, hold, POSE)]
    return Asked({}, *numbers, [], np.zeros(1), np.full(1, 0.5), np.full(1, -1))


def test_candidates_are_in_range_and_the_same_at_every_tick(arm):
    model = arm.model
    one, other = (Candidates(model.units, model.limits) for _ in range(2))
    given = asked(arm, POSE + AHEAD)
    actions, sound = one.checked(given, one.beside(given))
    np.testing.assert_array_equal(actions, other.checked(given, other.beside(given))[0])
    np.testing.assert_allclose(actions[0], given.proposed)
    assert sound.all() and np.abs(actions - POSE.numpy()).max() <= 6 + 1e-4  # the largest displacement of the data


def test_one_command_is_dropped_or_reversed_and_a_grip_is_only_dropped(tmp_path):
    tiny.save_franka_filter(tmp_path / "filter")
    model = LatentSafePolicy.from_pretrained(tmp_path / "filter").model
    size, grip = len(model.units.action_low), model.units.action_names.index("gripper.pos")
    proposed, hold = np.full((1, size), 0.01, np.float32), np.zeros((1, size), np.float32)
    hold[0, grip] = 0.7
    given = Asked({}, proposed, hold, hold, np.zeros((1, 1)), [], np.zeros(1), np.full(1, 0.5), np.full(1, -1))
    single = Candidates(model.units, model.limits).beside(given)[9 : 9 + 2 * size - 1, 0]
    changed = single != proposed
    assert (changed.sum(1) == 1).all()
    assert (single[:size][np.eye(size, dtype=bool)] == hold[0]).all()
    assert not changed[size:, grip].any() and (single[size:][changed[size:]] == np.float32(-0.01)).all()


def test_a_step_along_the_slope_of_v_would_pass_if_v_were_linear(arm):
    candidates, slope = Candidates(arm.model.units, arm.model.limits), np.float32([0.5, -0.2, 0.1])
    given = asked(arm, POSE + AHEAD)
    actions = candidates.beside(given)
    value = ((actions - given.proposed) / candidates.half_range) @ slope
    step = (candidates.along(given, actions, value)[0, 0] - given.proposed[0]) / candidates.half_range
    assert step @ slope == pytest.approx(1.5 * 0.5, rel=0.01)  # 1.5 times what lacks
    broken = np.where(np.arange(len(value))[:, None] % 3 == 1, np.nan, value)
    assert np.isfinite(candidates.along(given, actions, broken)).all()


def test_what_is_no_number_or_jumps_is_no_candidate(arm):
    arm.model.limits._largest_step = np.full(3, 1.0, np.float32)
    candidates, given = arm.shield.nearest.candidates, asked(arm, POSE)._replace(before=[POSE.numpy()])
    actions = POSE.numpy() + np.float32([[0.5, 0, 0], [2, 0, 0], [math.nan, 0, 0]])[:, None]
    assert candidates.checked(given, actions)[1][:, 0].tolist() == [True, False, False]
    nowhere = given._replace(pose=np.full((1, 3), np.nan, np.float32))
    assert not candidates.checked(nowhere, actions)[1].any()  # a target from a place that is not known


# -- the decision ---


def test_the_filter_changes_as_little_as_it_must(arm, safer_when_slower):
    arm.config.law.epsilon, arm.config.law.kappa = 0.2, 2
    decision = arm.shield(seen(), POSE + AHEAD)
    assert decision.intervened and decision.adjusted and not decision.falls_back
    assert decision.reason.item() == Reason.UNSAFE_VALUE and decision.value.item() == pytest.approx(-0.9)
    motion = (decision.action - POSE)[0] / 3
    assert 0 <= motion[0] < 0.24 and not torch.equal(decision.action, decision.proposed)
    dropped = POSE + AHEAD * torch.tensor([0.0, 1.0, 1.0])
    nearest = arm.shield.nearest
    assert nearest.deviation(decision) <= nearest.distance(dropped.numpy(), (POSE + AHEAD).numpy()) + 1e-5
    assert not arm.shield.overrides.recent.any()  # the fallback did not act


def test_a_small_kappa_takes_a_safer_action(arm, safer_when_slower):
    arm.config.law.epsilon, motions = 0.2, []
    for arm.config.law.kappa in (2, 0.1):
        arm.shield.reset()
        motions.append((arm.shield(seen(), POSE + AHEAD).action - POSE)[0, 0].abs().item())
    assert motions[1] < motions[0] and motions[1] / 3 / 0.3 <= 0.1 + 1e-4


@pytest.mark.parametrize("value", [-1.0, 0.2, math.nan, math.inf])
def test_where_no_candidate_passes_the_fallback_acts_as_by_reachability(arm, safer_when_slower, monkeypatch, value):
    monkeypatch.setattr(SafetyModel, "value_of_holding", lambda self, z, heard, roughly=False: heard[:, 0] * 0 + value)
    arm.config.law.epsilon, decisions = 0.2, []
    for arm.config.law.name in ("nearest", "reachability"):
        arm.shield.reset()
        decisions.append(arm.shield(seen(), POSE + AHEAD))
    assert decisions[0].falls_back and not decisions[0].adjusted
    torch.testing.assert_close(decisions[0].action, decisions[1].action)


FAULTS = {
    "no number": dict(proposed=torch.full((1, 3), math.nan)),
    "a jump": dict(proposed=POSE + 25),
    "nothing proposed": dict(proposed=None),
    "an old picture": dict(age_s=3.0),
    "no place": dict(observation={**seen(), STATE: torch.full((1, 3), math.nan)}),
    "a black camera": dict(observation={**seen(), PICTURE: torch.zeros(1, 3, 32, 32)}),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_faulty_is_not_adjusted(arm, safer_when_slower, fault):
    arm.config.law.epsilon, given = 0.2, {"observation": seen(t=1), "proposed": POSE + AHEAD, **FAULTS[fault]}
    decisions = []
    for arm.config.law.name in ("nearest", "reachability"):
        arm.shield.reset()
        arm.shield(seen(), POSE + AHEAD)
        arm.shield.was_executed(POSE + AHEAD)
        decisions.append(arm.shield(**given))
    ours, theirs = decisions
    assert not ours.adjusted.any() and ours.reason.item() == theirs.reason.item() != Reason.UNSAFE_VALUE
    torch.testing.assert_close(ours.action, theirs.action)


def test_a_failure_while_looking_is_a_fault(arm, safer_when_slower, monkeypatch):
    def broken(*given, **options):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(SafetyModel, "value_of_holding", broken)
    decision = arm.shield(seen(), POSE + AHEAD)
    assert decision.reason.item() == Reason.FILTER_FAILED and not decision.adjusted
    torch.testing.assert_close(decision.action, POSE)


@pytest.mark.parametrize("shield", [Shield, RecordedShield])
def test_a_monitor_and_a_recording_look_for_nothing(arm, safer_when_slower, monkeypatch, shield):
    monkeypatch.setattr(SafetyModel, "value_of_holding", lambda *given, **options: pytest.fail("looked"))
    if shield is Shield:
        arm.config.law.mode = "monitor"
        torch.testing.assert_close(arm.shield(seen(), POSE + AHEAD).action, POSE + AHEAD)
    else:
        found = RecordedShield(arm.model)._find_nearest({}, np.zeros(2, np.float32))
        assert np.isnan(found.action).all()


def test_during_a_retreat_nothing_is_adjusted(arm, safer_when_slower):
    law = arm.config.law
    law.epsilon, law.retreat, law.min_retreat_steps = 1.0, {"lift.pos": -1.0}, 3
    assert arm.shield(seen(), POSE + AHEAD).falls_back  # no V is above 1
    law.epsilon = 0.2
    acted = [arm.shield(seen(t=t), POSE + AHEAD).falls_back.item() for t in range(1, 4)]
    assert acted == [True, True, False]


@pytest.mark.parametrize(("retreat", "adjusts"), [({}, [True] * 6), ({"lift.pos": -1.0}, [True] * 3 + [False] * 3)])
def test_where_a_retreat_is_known_it_comes_after_a_few_adjusted_steps(arm, safer_when_slower, retreat, adjusts):
    law = arm.config.law
    law.epsilon, law.retreat, law.min_retreat_steps = 0.2, retreat, 3
    decisions = [arm.shield(seen(t=t), POSE + AHEAD) for t in range(6)]
    assert [decision.adjusted.item() for decision in decisions] == adjusts
    assert all(decision.intervened.item() for decision in decisions)


def test_what_is_verified_is_a_lower_bound_of_v(policy):
    law = policy.config.law
    law.epsilon, law.lookahead, law.proposal_steps = -1.0, 4, 2
    for decision in tiny.drive(policy, 5):
        with torch.no_grad():
            held = policy.model.value_of_holding(policy.shield.latent, decision.heard)
        assert (held <= decision.value + 1e-5).all()


def test_robots_side_by_side_are_decided_as_each_alone(policy):
    policy.config.law.name, policy.config.law.epsilon = "nearest", 0.0
    starts = ((-0.9, 0.1, 0.0), (-0.7, -0.3, 0.5))
    together = tiny.executed(tiny.drive(policy, 4, starts))
    alone = [tiny.executed(tiny.drive(policy, 4, (start,))) for start in starts]
    torch.testing.assert_close(together, torch.cat(alone, 1), atol=1e-4, rtol=1e-4)


# -- around it ---


@pytest.mark.parametrize(("above", "told", "replans"), [(0.0, False, 1), (5.0, False, 0), (5.0, True, 1)])
def test_the_policy_plans_anew_only_after_a_large_change(arm, safer_when_slower, above, told, replans):
    asked_anew = []

    class Base:
        planned = coming = None
        is_told = told
        propose = staticmethod(lambda seen: POSE + AHEAD)
        replan = staticmethod(asked_anew.append)

    arm.config.law.epsilon, arm.config.law.replan_above, arm._base = 0.2, above, [Base()]
    assert arm.decide(seen()).adjusted
    assert len(asked_anew) == replans


@pytest.mark.parametrize(
    ("name", "value"),
    [("kappa", -0.1), ("kappa", 2.1), ("kappa", math.nan), ("replan_above", -1.0), ("replan_above", math.inf)],
)
def test_settings_that_mean_nothing_are_refused(name, value):
    with pytest.raises(ValueError, match=f"law.{name} is {value}; expected"):
        LawConfig(name="nearest", **{name: value})


def test_a_law_that_no_value_stops_says_so():
    assert "epsilon is -1" in LawConfig(name="nearest", epsilon=-1).disarmed


@pytest.mark.parametrize(
    ("ours", "theirs", "expected"),
    [
        (dict(name="nearest", kappa=0.1), dict(name="reachability"), True),
        (dict(name="reachability"), dict(name="nearest", replan_above=1), True),
        (dict(name="nearest", epsilon=-0.1), dict(name="reachability"), False),
        (dict(name="nearest"), dict(name="plan"), False),
        (dict(name="nearest", lookahead=0), dict(name="risk", lookahead=0), False),
        (dict(name="nearest", mode="monitor"), dict(name="reachability"), False),
    ],
)
def test_who_passes_no_more(ours, theirs, expected):
    assert LawConfig(**ours).passes_nothing_more_than(LawConfig(**theirs)) is expected


def test_it_reads_the_critic_of_reachability():
    with pytest.raises(ValueError, match="'nearest', but this filter's critic was trained for 'risk'"):
        tiny.config(law_name="nearest", trained_on_stage="critic", trained_on_target="risk")
    assert LawConfig().changed(LawOptions(name="nearest")).critic == "reachability"


def test_a_calibration_belongs_to_the_law_with_its_options():
    laws = {name: belonging(LawConfig(name=name), "w", None)["law"] for name in ("nearest", "reachability")}
    assert laws["nearest"]["kappa"] == LawConfig().kappa and "kappa" not in laws["reachability"]


def test_a_journal_tells_what_was_adjusted(arm, safer_when_slower, tmp_path):
    arm.config.law.epsilon, journal = 0.2, Journal(tmp_path / "decisions.parquet")
    decision = arm.shield(seen(), POSE + AHEAD)
    journal.add(decision, decision.action[0].tolist())
    journal.write()
    frames = {"episode_index": np.zeros(1, int), "frame_index": np.zeros(1, int), "action": decision.action.numpy()}
    found = decision_columns(tmp_path / "decisions.parquet", frames)
    assert found["adjusted"].tolist() == found["intervened"].tolist() == [1]
