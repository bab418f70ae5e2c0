"""Whatever a robot shows and is told, it is judged or held: tables of what can be wrong."""

import numpy as np
import pytest
import torch
from lerobot.robots.utils import make_robot_from_config
from shielded_robots import ALWAYS, PERIOD, PUSH, STILL, config, last

from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.franka.actions import STATE_NAMES
from lerobot_latentsafe.guard import UnknownPoseError

pytestmark = pytest.mark.usefixtures("virtual_time")


PICTURE = np.random.default_rng(0).integers(0, 255, (32, 32, 3), np.uint8)
MALFORMED, MISSING = Reason.OBSERVATION_MALFORMED, Reason.OBSERVATION_MISSING
SEEN = {
    "black": ({"wrist": np.zeros((32, 32, 3), np.uint8)}, MISSING),
    "NaN": ({"joint_1.pos": float("nan")}, Reason.OBSERVATION_NOT_FINITE),
    "no camera": ({"wrist": ...}, MISSING),
    "no picture": ({"wrist": None}, MISSING),
    "no joint": ({"joint_1.pos": ...}, Reason.OBSERVATION_NOT_FINITE),
    "no reading": ({"joint_1.pos": None}, Reason.OBSERVATION_NOT_FINITE),
    "a reading in words": ({"joint_1.pos": "0.3"}, Reason.OBSERVATION_NOT_FINITE),
    "two readings": ({"joint_1.pos": np.zeros(2)}, Reason.OBSERVATION_NOT_FINITE),
    "no state": (dict.fromkeys(STATE_NAMES, ...), Reason.OBSERVATION_NOT_FINITE),
    "another size": ({"wrist": np.zeros((24, 32, 3), np.uint8)}, MALFORMED),
    "a thumbnail": ({"wrist": PICTURE[:4, :4]}, MALFORMED),
    "grey": ({"wrist": PICTURE[:, :, 0]}, MALFORMED),
    "transparent": ({"wrist": PICTURE[:, :, [0, 1, 2, 0]]}, MALFORMED),
    "channels first": ({"wrist": PICTURE.transpose(2, 0, 1)}, MALFORMED),
    "floats": ({"wrist": PICTURE / np.float32(255)}, MALFORMED),
    "16 bits": ({"wrist": PICTURE.astype(np.uint16)}, MALFORMED),
    "words": ({"wrist": "frame.png"}, MALFORMED),
    "objects": ({"wrist": np.full((32, 32, 3), None)}, MALFORMED),
}
"""What is wrong with an observation (... leaves it out), and why the robot then stays."""


def altered(seen, change):
    return {name: value for name, value in {**seen, **change}.items() if value is not ...}


@pytest.mark.parametrize("fault", SEEN)
@pytest.mark.parametrize("first", [True, False])
@pytest.mark.fault("R10", "a camera is missing from an observation", "The robot stays: `OBSERVATION_MISSING`")
@pytest.mark.fault("R11", "the state is missing from an observation", "The robot stays: `OBSERVATION_NOT_FINITE`")
@pytest.mark.fault("R13", "a picture of another size", "The robot stays: `OBSERVATION_MALFORMED`")
@pytest.mark.fault("R14", "a grey picture", "The robot stays: `OBSERVATION_MALFORMED`")
@pytest.mark.fault("R15", "a picture with an alpha channel", "The robot stays: `OBSERVATION_MALFORMED`")
@pytest.mark.fault("R16", "a picture of floats in 0 to 1", "The robot stays: `OBSERVATION_MALFORMED`")
def test_what_cannot_be_seen_is_never_safe(robot, monkeypatch, virtual_time, fault, first):
    """Also in the first tick of an episode, of which nobody knows anything yet. LeRobot gets what was there last."""
    change, reason = SEEN[fault]
    if not first:
        seen = robot.get_observation()
        robot.send_action(PUSH)
        virtual_time.sleep(PERIOD)
    read = robot.inner.get_observation
    with monkeypatch.context() as m:
        m.setattr(robot.inner, "get_observation", lambda: altered(read(), change))
        shown = robot.get_observation()
        assert first or fault == "black" or all(np.array_equal(shown[name], seen[name]) for name in change)
        sent = robot.send_action(PUSH)
    if fault == "no state" and first:  # nobody knows how wide the fingers are
        sent["gripper.pos"] = STILL["gripper.pos"]
    assert sent == pytest.approx(STILL)
    if last(robot) is not None:
        assert last(robot).reason.item() == reason and last(robot).intervened.item()
    for _ in range(2):
        virtual_time.sleep(PERIOD)
        sent = robot.send_action(PUSH)
    assert sent == pytest.approx(PUSH)


@pytest.mark.parametrize("broken", [None, 3, "words"])
def test_an_observation_that_is_none_counts_as_not_read(robot, monkeypatch, virtual_time, broken):
    robot.send_action(PUSH)
    virtual_time.sleep(PERIOD)
    monkeypatch.setattr(robot.inner, "get_observation", lambda: broken)
    assert robot.send_action(PUSH) == pytest.approx(STILL) and last(robot).reason.item() == Reason.OBSERVATION_STALE


def without(*names):
    return {name: value for name, value in PUSH.items() if name not in names}


NOT_FINITE, OUT_OF_RANGE = Reason.ACTION_NOT_FINITE, Reason.ACTION_OUT_OF_RANGE
ACTIONS = {
    "None": (PUSH | {"delta_x.pos": None}, NOT_FINITE),
    "a string": (PUSH | {"delta_x.pos": "0.015"}, NOT_FINITE),
    "NaN": (PUSH | {"delta_x.pos": float("nan")}, NOT_FINITE),
    "infinite": (PUSH | {"delta_x.pos": float("-inf")}, NOT_FINITE),
    "beyond floats": (PUSH | {"delta_x.pos": 10**400}, NOT_FINITE),
    "beyond single floats": (PUSH | {"delta_x.pos": 1e300}, NOT_FINITE),
    "two numbers": (PUSH | {"delta_x.pos": np.zeros(2)}, NOT_FINITE),
    "1e9": (PUSH | {"delta_x.pos": 1e9}, OUT_OF_RANGE),
    "without a name": (without("delta_x.pos"), NOT_FINITE),
    "with one name": ({"gripper.pos": 1.0}, NOT_FINITE),
    "empty": ({}, None),
    "None at all": (None, None),
    "a list": ([0.0] * 7, None),
    "of other names": ({"joint_1.pos": 0.3}, None),
    "of some other names": (without("delta_x.pos") | {"joint_1.pos": 0.3}, None),
}
"""An action, and why the robot then stays; None: there is nothing to judge."""


@pytest.mark.parametrize("fault", ACTIONS)
@pytest.mark.fault("R28", "an action value that is None", "The robot stays: `ACTION_NOT_FINITE`")
@pytest.mark.fault("R29", "an action value that is a string", "The robot stays: `ACTION_NOT_FINITE`")
@pytest.mark.fault("R30", "an action that lacks a name", "The robot stays: `ACTION_NOT_FINITE`")
@pytest.mark.fault("R33", "an action value of 1e9", "The robot stays: `ACTION_OUT_OF_RANGE`")
def test_an_action_that_is_none_of_this_robot_holds_it_still_and_is_told_once(
    robot, caplog, virtual_time, monkeypatch, fault
):
    action, reason = ACTIONS[fault]
    told, send = [], robot.inner.send_action
    monkeypatch.setattr(robot.inner, "send_action", lambda action: told.append(action) or send(action))
    for _ in range(3):
        robot.get_observation()
        assert robot.send_action(action) == pytest.approx(STILL)
        virtual_time.sleep(PERIOD)
    assert told == [pytest.approx(STILL)] * 3
    if reason is None:
        assert last(robot) is None and caplog.text.count("the robot holds still") == 1
    else:
        assert last(robot).reason.item() == reason
    assert robot.send_action(PUSH) == pytest.approx(PUSH)


@pytest.mark.parametrize(
    "kind",
    [float, np.float32, np.float64, np.array, torch.tensor, lambda x: torch.tensor([x]), lambda x: np.array([x])],
)
def test_numbers_of_every_kind_are_judged(robot, kind):
    assert robot.send_action({name: kind(value) for name, value in PUSH.items()}) == pytest.approx(PUSH)


@pytest.mark.parametrize("unfiltered", [False, True])
@pytest.mark.fault("R31", "an action with one more name", "The rest is judged; the name is left out, and that is said")
def test_what_the_filter_does_not_know_never_reaches_the_robot_unless_allowed(
    trained, caplog, monkeypatch, virtual_time, unfiltered
):
    with make_robot_from_config(config(trained, unfiltered_moves=unfiltered)) as robot:
        told = []
        monkeypatch.setattr(robot.inner, "send_action", lambda action: told.append(action) or action)
        for more in (0.5, float("nan"), None):
            robot.send_action(PUSH | {"hand.pos": more})
            virtual_time.sleep(PERIOD)
        allowed = PUSH | ({"hand.pos": 0.5} if unfiltered else {})
        assert told == [pytest.approx(allowed), pytest.approx(PUSH), pytest.approx(PUSH)]
        assert caplog.text.count("knows nothing of hand.pos") == 1


@pytest.mark.parametrize("fault", [*ACTIONS, "too many"])
@pytest.mark.fault("R34", "a monitor is given any action, also joint moves", "It changes nothing")
def test_a_monitor_changes_no_action(trained, monkeypatch, virtual_time, fault):
    action = PUSH | {"hand.pos": 0.5} if fault == "too many" else ACTIONS[fault][0]
    with make_robot_from_config(config(trained, {"epsilon": ALWAYS, "mode": "monitor"})) as robot:
        told = []
        monkeypatch.setattr(robot.inner, "send_action", lambda action: told.append(action) or action)
        for _ in range(2):
            assert robot.send_action(action) == action
            virtual_time.sleep(PERIOD)
        assert told == [action] * 2
        assert last(robot) is None or last(robot).unsafe.item()


@pytest.mark.parametrize("fault", SEEN)
def test_a_monitor_acts_on_no_fault_either(trained, monkeypatch, fault):
    with make_robot_from_config(config(trained, {"mode": "monitor"})) as robot:
        read = robot.inner.get_observation
        monkeypatch.setattr(robot.inner, "get_observation", lambda: altered(read(), SEEN[fault][0]))
        assert robot.send_action(PUSH) == pytest.approx(PUSH)


def test_an_action_that_is_not_finite_never_reaches_the_robot(robot):
    sent = robot.send_action(PUSH | {"delta_y.pos": float("nan")})
    assert last(robot).reason.item() == Reason.ACTION_NOT_FINITE and np.isfinite(list(sent.values())).all()


@pytest.mark.parametrize("told", [None, 0.25])
@pytest.mark.fault(
    "R35",
    "the gripper's reading is NaN, and its command is unknown",
    "The grip is kept as it was told; if nothing was told yet, nothing is sent (`UnknownPoseError`)",
)
def test_a_grip_that_cannot_be_read_is_kept_as_it_was_told_and_else_nothing_is_sent(
    robot, monkeypatch, virtual_time, told
):
    if told is not None:
        robot.send_action(PUSH | {"gripper.pos": told})
        virtual_time.sleep(PERIOD)
    read, sent = robot.inner.get_observation, []
    monkeypatch.setattr(robot.inner, "get_observation", lambda: read() | {"gripper.pos": float("nan")})
    monkeypatch.setattr(robot.inner, "send_action", lambda action: sent.append(action) or action)
    if told is None:
        with pytest.raises(UnknownPoseError, match=r"no usable reading of gripper\.pos, and was told nothing yet"):
            robot.send_action({"joint_1.pos": 0.3})
        assert not sent
    else:
        assert robot.send_action({"joint_1.pos": 0.3}) == pytest.approx(STILL | {"gripper.pos": told})
