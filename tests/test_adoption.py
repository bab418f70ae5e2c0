"""What a filter takes over from the first dataset, and what it refuses of later ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_meanings import JOINTS, followed, moved_by, so101, uniform, walk

from lerobot_latentsafe.datasets.adoption import adopt_dataset, check_candidates, with_limits
from lerobot_latentsafe.datasets.contract import Contract, DatasetContractError
from lerobot_latentsafe.limits import Limits
from lerobot_latentsafe.meanings import MeaningError
from lerobot_latentsafe.units import TrainedOn, Units


def contract(state, action, names=JOINTS, repo_id="me/arm"):
    numbers = (np.asarray(values, np.float32) for values in (state, action))
    episode = np.arange(len(state)) // 200
    return Contract(repo_id, Path(), "so101_follower", 30, list(names), list(names), {}, {}, episode, *numbers)


@pytest.fixture(scope="module")
def arm():
    return contract(*so101())


def test_targets_are_scaled_by_their_displacements(arm):
    trained_on = adopt_dataset(TrainedOn(), arm)
    assert trained_on.meanings == dict.fromkeys(JOINTS, "target")
    moves = np.abs(arm.action - arm.state)
    np.testing.assert_allclose(trained_on.displacement_scale[:4], np.percentile(moves, 99, 0)[:4], rtol=1e-5)
    np.testing.assert_allclose(trained_on.displacement_high[:4], (arm.action - arm.state).max(0)[:4], rtol=1e-5)
    units = Units(trained_on, [])
    heard = units.heard_action(torch.from_numpy(arm.action), torch.from_numpy(arm.state))
    assert (heard.abs() <= 1).float().mean() > 0.98 and heard.std(0)[:4].min() > 0.2
    assert trained_on.action_varies == [True] * 6  # a joint whose target is always the same still has displacements


def test_a_jerk_of_the_operator_does_not_make_all_else_inaudible(arm):
    jerked = arm.action.copy()
    jerked[300] += 90
    before, after = (adopt_dataset(TrainedOn(), c) for c in (arm, replace(arm, action=jerked)))
    np.testing.assert_allclose(after.displacement_scale, before.displacement_scale, rtol=0.2)


def test_a_joint_that_never_moves_is_not_blown_up():
    state, target = so101()
    state[:, 4] = target[:, 4] = 20.0
    trained_on = adopt_dataset(TrainedOn(), contract(state, target))
    assert trained_on.action_varies[4] is False and trained_on.displacement_scale[4] > 0.01
    pose = np.float32(state[:1])
    clipped, out = Limits(trained_on, Units(trained_on, [])).clip(pose.copy(), pose)
    np.testing.assert_allclose(clipped, pose)
    assert not out.any()


def test_what_nobody_tells_is_refused_before_training_and_taken_from_the_user():
    noise = contract(uniform(600, 2), uniform(600, 2)[::-1], ["x.pos", "y.pos"])
    with pytest.raises(
        MeaningError, match=r"of me/arm tell what x.pos, y.pos means.*meanings='\{x.pos: delta, y.pos: delta\}'"
    ):
        adopt_dataset(TrainedOn(), noise)
    said = {"x.pos": "delta", "y.pos": "other"}
    assert adopt_dataset(TrainedOn(meanings=said), noise).meanings == said


def test_a_target_whose_state_has_another_name_is_found():
    state, target = followed(walk(2, 0.8) + 50), walk(2, 0.8) + 50
    other = replace(contract(state, target, ["a", "b"]), state_names=["s.pos", "t.pos"])
    trained_on = adopt_dataset(TrainedOn(), other)
    assert trained_on.meanings == {"a": "target s.pos", "b": "target t.pos"}
    limits, pose = Limits(trained_on, Units(trained_on, [])), np.float32([[48.0, 52.0]])
    np.testing.assert_allclose(limits.hold(pose), pose)


def test_later_datasets_must_mean_the_same(arm):
    trained_on = adopt_dataset(TrainedOn(), arm)
    assert adopt_dataset(trained_on, replace(arm, repo_id="me/more")) == trained_on
    deltas = uniform(600, 6)
    other = contract(moved_by(deltas), deltas, repo_id="me/deltas")
    with pytest.raises(ValueError, match=r"me/deltas is of a robot that takes .*: shoulder_pan\.pos is a delta"):
        adopt_dataset(trained_on, other)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(fps=15), "has fps = 15, this filter was trained with 30"),
        (dict(action_names=JOINTS[::-1]), "has action_names = "),
        (dict(action=np.float32(1) * so101()[1] / 57.3), "reaches from .*another unit"),
    ],
)
def test_other_robots_are_refused(arm, changes, message):
    trained_on = adopt_dataset(TrainedOn(), arm)
    other = replace(arm, **{name: np.float32(v) if name == "action" else v for name, v in changes.items()})
    if "action" in changes:
        other = replace(other, state=np.float32(arm.state / 57.3))
    with pytest.raises(ValueError, match=message):
        adopt_dataset(trained_on, other)


def test_rates_may_be_fractions(arm):
    assert adopt_dataset(TrainedOn(), replace(arm, fps=29.97)).fps == 29.97
    assert str(TrainedOn(fps=15.0).fps) == "15"


def test_candidates_of_targets_are_displacements(arm):
    trained_on = adopt_dataset(TrainedOn(), arm)
    check_candidates([[0.0] * 6, [1.0, 0, 0, 0, 0, 0]], trained_on, "me/arm")
    with pytest.raises(ValueError, match="outside of what me/arm covers"):
        check_candidates([[-70.0, 0, 0, 0, 0, 0]], trained_on, "me/arm")


@pytest.mark.parametrize("feature", ["action", "state"])
@pytest.mark.fault("N04", "one number of the data is 1e6", "Refused; frame and episode are named")
def test_a_glitch_does_not_become_the_range(arm, feature):
    values = getattr(arm, feature).copy()
    values[300, 2] = 1e6
    with pytest.raises(DatasetContractError, match=r"elbow_flex.pos of .* is 1e\+06 in frame 100 of episode 1 of"):
        adopt_dataset(TrainedOn(), replace(arm, **{feature: values}))


def test_a_command_that_hardly_ever_moves_is_no_glitch(arm):
    action, state = arm.action.copy(), arm.state.copy()
    action[:, 5] = state[:, 5] = 0.0
    action[300, 5] = state[301, 5] = 1.0
    assert adopt_dataset(TrainedOn(), replace(arm, action=action, state=state)).action_high[5] == 1.0


def test_changes_of_commands_are_known(arm):
    trained_on = adopt_dataset(TrainedOn(), arm)
    episodes = [arm.action[arm.episode == e] for e in np.unique(arm.episode)]
    for order, known in ((1, trained_on.action_step), (2, trained_on.action_jerk)):
        largest = np.max([np.abs(np.diff(action, order, axis=0)).max(0) for action in episodes], 0)
        small = 0.05 * np.subtract(trained_on.action_high, trained_on.action_low)
        np.testing.assert_allclose(known, np.maximum(largest, small), rtol=1e-5)


def test_how_far_commands_go_unanswered_is_known(arm):
    state = arm.state.copy()
    state[210:213] = state[209]  # meanwhile it does not answer
    went = np.abs(arm.action[209:212] - arm.action[208]).max(0)
    known = adopt_dataset(TrainedOn(), replace(arm, state=state)).unanswered
    assert (known >= went - 1e-4).all()
    before = adopt_dataset(TrainedOn(), arm).unanswered
    assert (np.array(before)[:4] < 3 * np.array(adopt_dataset(TrainedOn(), arm).action_step)[:4]).all()


def test_a_filter_of_before_learns_limits_and_keeps_what_it_knows(arm):
    new = adopt_dataset(TrainedOn(), arm)
    unknown = dict.fromkeys(("state_low", "state_high", "state_step", "action_step", "action_jerk", "unanswered"))
    old = replace(new, **unknown, state_mean=[7.0] * 6)
    assert with_limits(old, arm) == replace(new, state_mean=[7.0] * 6)
    assert with_limits(new, replace(arm, action=2 * arm.action)) == new
