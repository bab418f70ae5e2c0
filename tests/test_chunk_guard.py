"""A chunk is checked whole, before its first action is sent: by a shield, and as a step of LeRobot's processors."""

import logging

import numpy as np
import pytest
import tiny
import tiny_policies
import torch
from lerobot.processor import PolicyProcessorPipeline
from test_base_policies import base_of

from lerobot_latentsafe import ChunkGuardStep
from lerobot_latentsafe.chunk_guard import UnsafeActionError
from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.guard import check_plan
from lerobot_latentsafe.limits import Limits
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.units import TrainedOn, Units

N, AT = 8, 5
"""Actions of a chunk, and that from which on something is wrong."""
TARGETS = TrainedOn(
    stage="guard", fps=30, state_names=["a.pos", "b.pos"], action_names=["a.pos", "b.pos"],
    meanings={"a.pos": "target", "b.pos": "target"}, action_low=[-10.0, -10.0], action_high=[10.0, 10.0],
    action_varies=[True, True], displacement_low=[-2.0, -2.0], displacement_high=[2.0, 2.0],
    displacement_scale=[1.0, 1.0], state_low=[-10.0, -10.0], state_high=[10.0, 10.0], state_step=[1.0, 1.0],
    state_mean=[0.0, 0.0], state_std=[3.0, 3.0], action_step=[1.0, 1.0], action_jerk=[0.5, 0.5],
)  # fmt: skip
LIMITS = Limits(TARGETS, Units(TARGETS, []))


def chunk(start=0.0, step=0.5):
    """Two robots' targets that go on steadily: (2, N, 2)."""
    return start + step * torch.arange(1.0, N + 1)[None, :, None].expand(2, N, 2).clone()


def jump(x):
    x[0, AT:, 1] += 4.0
    return x


def jerk(x):
    x[0, AT:, 1] -= 1.3 * (torch.arange(N - AT) + 1.0)  # it turns round at once, each step is small
    return x


def out_of_range(x):
    x[0, AT:, 1] = 25.0
    return x


def no_number(x):
    x[0, AT, 0] = torch.nan
    return x


WRONG = {
    "jump": (jump, Reason.ACTION_JUMPS),
    "jerk": (jerk, Reason.ACTION_JUMPS),
    "out of range": (out_of_range, Reason.ACTION_OUT_OF_RANGE),
    "no number": (no_number, Reason.ACTION_NOT_FINITE),
}


def test_a_steady_plan_passes():
    plan = chunk().numpy()
    assert not check_plan(LIMITS, plan).any()
    assert not check_plan(LIMITS, plan, [plan[:, 0] - 1.0, plan[:, 0] - 0.5]).any()


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_found_where_it_is(name):
    change, reason = WRONG[name]
    fault = check_plan(LIMITS, change(chunk()).numpy())
    assert fault[0, AT] == reason and not fault[0, :AT].any() and not fault[1].any()


def test_the_first_action_follows_those_before():
    fault = check_plan(LIMITS, chunk().numpy(), [np.full((2, 2), -9.0, np.float32)])
    assert (fault[:, 0] == Reason.ACTION_JUMPS).all() and not fault[:, 2:].any()


# -- where a policy's chunk can be read ---


@pytest.mark.parametrize("kind", tiny_policies.COUNTING)
def test_what_is_planned_is_read_once_from_every_type_of_lerobot(kind):
    base = base_of(tiny_policies.counting(kind))
    base.reset()
    first = base.propose(tiny_policies.seen(0))
    planned, proposed = base.planned, [first]
    assert planned.shape[:2] == (2, tiny_policies.PLAYED - 1)
    for tick in range(1, tiny_policies.PLAYED):
        proposed.append(base.propose(tiny_policies.seen(tick)))
        assert base.planned is None
        left = planned[:, tick:]
        assert torch.equal(base.coming, left) if left.shape[1] else base.coming is None
    assert torch.equal(planned, torch.stack(proposed[1:], 1))
    base.propose(tiny_policies.seen(tiny_policies.PLAYED))
    assert base.planned is not None and base.coming is base.planned


def test_what_was_to_come_is_forgotten_with_the_plan():
    base = base_of(tiny_policies.counting("act"))
    for forget in (base.reset, lambda: base.replan(torch.zeros(2, 2))):
        base.reset()
        base.propose(tiny_policies.seen(0))
        assert base.coming is not None
        forget()
        assert base.coming is None


def test_what_is_planned_ahead_is_read():
    base = base_of(tiny_policies.counting("act"), ahead=2)
    base.reset()
    base.propose(tiny_policies.seen(0))
    assert base.planned.shape[1] == tiny_policies.PLAYED - 1


def test_a_policy_whose_processors_take_single_actions_is_not_read(caplog):
    base = base_of(tiny_policies.counting("act"))

    def single(action):
        assert action.dim() == 2, "a single action"
        return action

    base.postprocessor = single
    with caplog.at_level(logging.WARNING):
        for tick in range(2 * tiny_policies.PLAYED):
            base.propose(tiny_policies.seen(tick))
            assert base.planned is None
    assert caplog.text.count("chunks of the base policy (act) cannot be read") == 1


@pytest.mark.parametrize("name", WRONG)
def test_a_shield_lets_no_action_of_a_wrong_chunk_pass(name, tmp_path):
    step = {"trained_on_action_step": [6.0] * 3, "trained_on_action_jerk": [2.0] * 3}
    shielded = load_filter(tiny.save_arm_filter(tmp_path / "filter", law_epsilon=-1.5, **step))
    pose = torch.tensor([tiny.ARM_POSE])
    seen = {"observation.images.front": torch.rand(1, 3, 32, 32), "observation.state": pose}
    steady = pose[:, None] + 0.5 * torch.arange(1.0, N)[None, :, None]
    wrong = {"jump": 20.0, "jerk": None, "out of range": 90.0, "no number": torch.nan}[name]
    assert shielded.shield(seen, pose, planned=steady).reason == Reason.PASSED
    broken = steady.clone()
    if wrong is None:
        broken[:, AT:] -= 4.0 * torch.arange(1.0, N - AT)[None, :, None]
    else:
        broken[:, AT] += wrong
    decision = shielded.shield(seen, pose, planned=broken)
    assert decision.reason == WRONG[name][1] and decision.intervened


# -- as a processor step ---


def step_of(trained_on=TARGETS, on_fault="hold"):
    return ChunkGuardStep(trained_on, on_fault)


def test_what_keeps_to_the_data_passes_to_the_bit():
    assert torch.equal(step_of().action(chunk()), chunk())
    step = step_of()
    for t in range(N):
        assert torch.equal(step.action(chunk()[:, t]), chunk()[:, t])
        assert torch.equal(step_of().action(chunk()[0, t]), chunk()[0, t])


def test_what_leaves_the_range_a_little_is_clipped():
    assert step_of().action(torch.tensor([[10.5, -11.0]])).tolist() == [[10.0, -10.0]]


@pytest.mark.parametrize("name", WRONG)
def test_the_robot_holds_from_what_is_wrong_on(name, caplog):
    step, wrong = step_of(), WRONG[name][0](chunk())
    with caplog.at_level(logging.WARNING):
        out = step.action(wrong)
    assert torch.equal(out[1], chunk()[1]) and torch.equal(out[0, :AT], chunk()[0, :AT])
    assert torch.equal(out[0, AT:], chunk()[0, AT - 1].expand(N - AT, 2))
    assert f"in step {AT}" in caplog.text and "holds" in caplog.text
    with pytest.raises(UnsafeActionError, match="Nothing was sent"):
        step_of(on_fault="raise").action(wrong)


@pytest.mark.parametrize("name", WRONG)
def test_single_actions_are_compared_with_those_before(name):
    step, wrong = step_of(), WRONG[name][0](chunk())
    out = torch.stack([step.action(wrong[:, t]) for t in range(N)], 1)
    assert torch.equal(out[:, :AT], wrong[:, :AT]) and torch.equal(out[0, AT], wrong[0, AT - 1])


def test_deltas_stop():
    deltas = TrainedOn(**{**vars(TARGETS), "meanings": {"a.pos": "delta", "b.pos": "velocity"}})
    out = step_of(deltas).action(jump(chunk(step=0.0) + 1.0))
    assert out[0, AT - 1].tolist() == [1.0, 1.0] and not out[0, AT:].any() and (out[1] == 1.0).all()


def test_nothing_is_sent_while_nobody_knows_where_the_robot_is():
    with pytest.raises(UnsafeActionError, match="nobody knows where the robot is"):
        step_of().action(torch.full((1, 2), 50.0))


def test_each_episode_begins_anew():
    step = step_of()
    step.action(torch.full((1, 2), -9.0))
    step.reset()
    assert step.action(torch.full((1, 2), 9.0)).tolist() == [[9.0, 9.0]]


@pytest.mark.parametrize("shape", [(2, 3), (2, N, 3), (1, 1, 1, 2)])
def test_actions_of_another_robot_are_refused(shape):
    with pytest.raises(UnsafeActionError, match=r"expected \(robots, 2\) or \(robots, steps, 2\): a.pos, b.pos"):
        step_of().action(torch.zeros(shape))


def test_settings_that_say_nothing_are_refused():
    with pytest.raises(ValueError, match="on_fault is 'clip'; expected one of hold, raise"):
        step_of(on_fault="clip")
    with pytest.raises(ValueError, match="latentsafe guard"):
        step_of(TrainedOn())


def test_a_policy_takes_the_step_along_when_it_is_saved(tmp_path):
    pipeline = PolicyProcessorPipeline(steps=[step_of(on_fault="raise")], name="policy_postprocessor")
    pipeline.save_pretrained(tmp_path)
    again = PolicyProcessorPipeline.from_pretrained(tmp_path, config_filename="policy_postprocessor.json")
    assert again.steps[0].trained_on == TARGETS and again.steps[0].on_fault == "raise"


def test_the_step_of_a_guard_or_filter(tmp_path):
    folder = tiny.save_arm_filter(tmp_path / "filter")
    assert ChunkGuardStep.of(folder).limits.action_names == tiny.ARM


def test_looking_ahead_is_no_action():
    step = step_of()
    for t in range(N):
        assert torch.equal(step.action(chunk()[:, t]), chunk()[:, t])
        assert torch.equal(step.action(chunk(start=3.0)), chunk(start=3.0))  # as a shield that reads what is planned
