"""Robots whose commands are joint targets: whatever is wrong, nothing jumps, and a robot at rest stays at rest."""

import math
from contextlib import nullcontext

import numpy as np
import pytest
import tiny
import torch

from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.evaluation.faults import BROKEN, FAULTS, FAULTS_OF_DEGREES
from lerobot_latentsafe.guard import UnknownPoseError
from lerobot_latentsafe.meanings import MeaningError
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

PICTURE, STATE = "observation.images.front", "observation.state"
POSE = torch.tensor([tiny.ARM_POSE])
LARGEST, USUAL = 6.0, 3.0
"""Displacements of the data: the largest, and the 99th percentile."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tiny.save_arm_filter(tmp_path_factory.mktemp("arm") / "filter")


@pytest.fixture
def arm(folder):
    """A filter that passes whatever is not faulty."""
    policy = LatentSafePolicy.from_pretrained(folder).eval()
    policy.config.law.epsilon = -2.0
    return policy


def seen(pose=POSE, t=0):
    picture = torch.rand(len(pose), 3, 32, 32, generator=torch.Generator().manual_seed(t))
    return {PICTURE: picture, STATE: pose.clone()}


def proposes(*degrees):
    return lambda given: {**given, "proposed": given["proposed"] + torch.tensor([degrees])}


def shows(number):
    """A reading of the first joint."""

    def inject(given):
        given["observation"][STATE][:, 0] = number
        return given

    return inject


GIVEN = {
    **FAULTS,
    **FAULTS_OF_DEGREES,
    "a joint in another unit": shows(math.radians(-71) * 100),
    "a jump of twenty degrees": proposes(20, 0, 0),
    "a target beyond the data": proposes(0, 0, 45),
}


def broken(arm, fault):
    """While a fault of the shield itself lasts."""
    return BROKEN[fault](arm.shield) if fault in BROKEN else nullcontext()


def given(fault, pose, t):
    """What the shield is given of an arm that is to stay, with a fault of that."""
    return GIVEN.get(fault, dict)({"observation": seen(pose, t), "proposed": pose.clone()})


@pytest.mark.parametrize("fault", [*GIVEN, *BROKEN])
def test_a_robot_at_rest_that_is_to_stay_does_not_move_whatever_is_wrong(arm, fault):
    arm.shield(seen(), POSE)
    with broken(arm, fault):
        for t in range(8):
            decision = arm.shield(**given(fault, POSE, t))
            assert decision.reason.item() != Reason.PASSED
            torch.testing.assert_close(decision.action, POSE)


@pytest.mark.parametrize("fault", [*GIVEN, *BROKEN, None])
@pytest.mark.parametrize("lookahead", [0, 4])
def test_no_step_is_larger_than_the_usual_ones_of_the_data_even_where_nothing_is_safe(arm, fault, lookahead):
    arm.config.law.epsilon, arm.config.law.lookahead = 2.0, lookahead
    pose = POSE.clone()
    arm.shield(seen(pose), pose)
    with broken(arm, fault):
        for t in range(8):
            action = arm.shield(**given(fault, pose, t)).action
            assert (action - pose).abs().max() <= USUAL + 1e-4, (t, action, pose)
            pose = action  # an arm that goes where it is told


@pytest.mark.parametrize("law", ["margin", "plan"])
def test_laws_that_read_no_critic_stay_or_move_within_the_data(arm, law):
    arm.config.law.epsilon, arm.config.law.name = 2.0, law
    action = arm.shield(seen(), POSE).action
    assert (action - POSE).abs().max() <= (USUAL if law == "plan" else 0.0) + 1e-4


def test_holding_keeps_a_grip_and_carries_a_sagging_arm(arm):
    told = POSE + torch.tensor([[1.0, 0.0, -2.5]])  # the arm hangs a degree below, the fingers press on an object
    arm.shield(seen(), told)
    torch.testing.assert_close(arm.shield(seen(), None).action, told)


def test_an_arm_on_its_way_stops_where_it_is_seen_and_then_does_not_sink(arm):
    """It comes after its targets: to stay what it was told last would be to go on."""
    ahead = torch.tensor([[2.5, 0.0, 0.0]])
    for degrees in (0.0, 1.0):
        arm.shield(seen(POSE + degrees), POSE + degrees + ahead)
    stopped = POSE + 2.0
    torch.testing.assert_close(arm.shield(seen(stopped), None).action, stopped)
    for sag in (0.7, 1.2, 1.2):  # by its weight, and no further
        torch.testing.assert_close(arm.shield(seen(stopped - sag), None).action, stopped)


def test_an_arm_that_is_moved_away_by_hand_stays_where_it_is(arm):
    arm.shield(seen(), POSE)
    for degrees in (4.0, 8.0, 12.0):
        moved = POSE + torch.tensor([[degrees, 0.0, 0.0]])
        action = arm.shield(seen(moved), None).action
    torch.testing.assert_close(action, moved)


def test_where_told_and_seen_are_far_apart_no_step_is_one_that_the_data_lack(arm):
    """The arm is where it was told to be, or where it is seen, and nobody knows which."""
    limits, pose = arm.model.limits, POSE.numpy()
    for degrees, expected in ((2.0, 0.0), (5.0, 5.0), (8.0, LARGEST), (-12.0, -LARGEST), (13.0, 13.0)):
        np.testing.assert_allclose(limits.hold(pose + np.float32(degrees), pose), pose + expected, rtol=1e-6)


def test_a_reading_that_leaps_is_believed_only_if_time_has_passed(arm):
    """From tick to tick the data change by 2 degrees, and twice as much is believed."""
    leap = lambda degrees: arm.shield(seen(POSE + degrees), POSE + degrees).reason.item()  # noqa: E731
    assert leap(0.0) == Reason.PASSED
    assert leap(7.0) == Reason.OBSERVATION_OUT_OF_RANGE
    assert leap(7.0) == Reason.PASSED  # two ticks from the last reading
    for _ in range(20):
        assert leap(40.0) == Reason.OBSERVATION_OUT_OF_RANGE  # however long it says so
    assert leap(8.0) == Reason.PASSED
    arm.reset()
    assert leap(29.0) == Reason.PASSED


def test_without_a_usable_state_the_last_goal_stays(arm):
    told = POSE + torch.tensor([[5.0, 0.0, 0.0]])
    arm.shield(seen(), told)
    nothing = torch.full_like(POSE, math.nan)
    arm.config.law.epsilon = 2.0  # not even the fallback moves from a place that nobody knows
    for t in range(4):
        torch.testing.assert_close(arm.shield(seen(nothing, t), POSE).action, told)


def test_a_monitor_lets_all_pass_whatever_it_sees(arm):
    arm.config.law.mode = "monitor"
    for wanted in (POSE + 50, torch.full_like(POSE, math.nan), torch.zeros_like(POSE)):
        decision = arm.shield(seen(torch.full_like(POSE, math.nan)), wanted)
        torch.testing.assert_close(decision.action, wanted, equal_nan=True)
        assert decision.unsafe.all() and not decision.intervened.any()


def test_nothing_is_commanded_to_an_arm_that_nobody_has_seen(arm):
    with pytest.raises(UnknownPoseError, match="nobody knows where the robot is, so nothing is commanded"):
        arm.shield(seen(torch.full_like(POSE, math.nan)), POSE)


@pytest.mark.parametrize(
    ("wanted", "reason", "executed"),
    [
        ([-70.0, 68.0, 20.0], Reason.PASSED, [-70.0, 68.0, 20.0]),
        ([-71.0 + 6.5, 68.0, 20.0], Reason.PASSED, [-65.0, 68.0, 20.0]),  # a little too far at once
        ([-71.0 - 11.0, 68.0, 20.0], Reason.PASSED, [-77.0, 68.0, 20.0]),
        ([-71.0 + 12.5, 68.0, 20.0], Reason.ACTION_OUT_OF_RANGE, tiny.ARM_POSE),
        ([109.0, -112.0, 20.0], Reason.ACTION_OUT_OF_RANGE, tiny.ARM_POSE),
    ],
)
def test_an_action_a_little_out_of_range_is_clipped_and_others_are_stopped(arm, wanted, reason, executed, caplog):
    for _ in range(2):
        decision = arm.shield(seen(), torch.tensor([wanted]))
        assert decision.reason.item() == reason
        torch.testing.assert_close(decision.action, torch.tensor([executed]))
        torch.testing.assert_close(decision.proposed, torch.tensor([wanted]))
    clipped = reason == Reason.PASSED and executed != wanted
    assert sum("what is executed is clipped: lift.pos" in message for message in caplog.messages) == clipped


def test_targets_beyond_the_datas_range_are_clipped_to_it(arm):
    pose = torch.tensor([[-41.5, 68.0, 20.0]])  # the data end at -41
    decision = arm.shield(seen(pose), pose + torch.tensor([[2.0, 0.0, 0.0]]))
    assert decision.reason.item() == Reason.PASSED and decision.action[0, 0] == -41.0
    outside = torch.tensor([[-40.0, 68.0, 20.0]])  # an arm that hangs beyond may stay there
    torch.testing.assert_close(arm.shield(seen(outside), outside).action, outside)


def test_the_world_model_hears_one_degree_and_standing_still_is_zero(arm):
    units = arm.model.units
    one = POSE + torch.tensor([[1.0, 0.0, 0.0]])
    torch.testing.assert_close(units.heard_action(one, POSE), torch.tensor([[1 / USUAL, 0.0, 0.0]]))
    torch.testing.assert_close(units.denormalise_action(units.normalise_action(one, POSE), POSE), one)
    torch.testing.assert_close(units.still, torch.zeros(1, 3))
    assert units.heard_action(POSE + 1000, POSE).max() <= 4.0
    with pytest.raises(ValueError, match="mean nothing without the state"):
        units.normalise_action(one)
    arm.shield(seen(), one)
    torch.testing.assert_close(arm.shield.executed[-1], units.heard_action(one, POSE))


def test_a_retreat_is_a_motion(arm):
    arm.config.law.epsilon, arm.config.law.retreat = 2.0, {"lift.pos": -2.0}
    torch.testing.assert_close(arm.shield(seen(), POSE).action, POSE - torch.tensor([[2.0, 0.0, 0.0]]))
    with pytest.raises(ValueError, match=r"retreat moves lift.pos by -71; the filter was trained on -6 to 6"):
        arm.config.change(law=tiny.LawConfig(retreat={"lift.pos": -71.0}))


def test_a_robot_of_targets_and_velocities_stops_and_stays(tmp_path):
    names = ["arm_lift.pos", "arm_elbow.pos", "x.vel"]
    meanings = {"arm_lift.pos": "target", "arm_elbow.pos": "target", "x.vel": "velocity"}
    low, high = [-101.0, 38.0, -0.3], [-41.0, 98.0, 0.3]
    trained = tiny.save_arm_filter(
        tmp_path / "base", names, meanings, trained_on_action_low=low, trained_on_action_high=high,
        trained_on_state_low=low, trained_on_state_high=high,
    )  # fmt: skip
    policy = LatentSafePolicy.from_pretrained(trained).eval()
    policy.config.law.epsilon = -2.0
    pose = torch.tensor([[-71.0, 68.0, 0.2]])
    policy.shield(seen(pose), pose)
    torch.testing.assert_close(policy.shield(seen(pose), None).action, torch.tensor([[-71.0, 68.0, 0.0]]))


def test_a_switch_is_left_as_it_is(tmp_path):
    names = ["lift.pos", "suction"]
    trained = tiny.save_arm_filter(
        tmp_path / "switch", names, {"lift.pos": "target", "suction": "other"}, law_epsilon=2.0,
        trained_on_action_low=[-101.0, 0.0], trained_on_action_high=[-41.0, 1.0],
        trained_on_state_low=[-101.0, 0.0], trained_on_state_high=[-41.0, 1.0],
    )  # fmt: skip
    policy, pose = LatentSafePolicy.from_pretrained(trained).eval(), torch.tensor([[-71.0, 1.0]])
    assert policy.shield(seen(pose), torch.tensor([[-71.0, 0.0]])).action[0, 1] == 1.0  # as seen
    policy.config.law.epsilon = -2.0
    policy.shield(seen(pose), torch.tensor([[-71.0, 0.0]]))
    policy.config.law.epsilon = 2.0
    assert policy.shield(seen(pose), torch.tensor([[-71.0, 1.0]])).action[0, 1] == 0.0  # as told


def test_rows_of_a_batch_are_judged_by_themselves(arm):
    poses = torch.cat([POSE, POSE + 10])
    arm.shield(seen(poses), poses)
    wrong = seen(poses, 1)
    wrong[STATE][0, 0] = math.nan
    decision = arm.shield(wrong, poses + 1)
    torch.testing.assert_close(decision.action, torch.cat([POSE, POSE + 11]))


def test_a_filter_of_before_is_refused_where_its_hold_could_be_a_jump(tmp_path):
    trained = tiny.save_arm_filter(tmp_path / "old", trained_on_meanings=None)
    with pytest.raises(MeaningError, match=r"take lift.pos, elbow.pos, gripper.pos for motions.*Train the world model"):
        LatentSafePolicy.from_pretrained(trained).decide(seen())
    frozen = tiny.save_arm_filter(tmp_path / "frozen", trained_on_meanings=None, fallback_frozen_commands=tiny.ARM)
    decision = LatentSafePolicy.from_pretrained(frozen).decide(seen())
    torch.testing.assert_close(decision.action, POSE)
