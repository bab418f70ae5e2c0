"""An arm that takes joint targets, behind a filter: between episodes, and from places that nobody knows."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
import tiny
from lerobot.robots.config import RobotConfig
from lerobot.robots.robot import Robot
from lerobot_loops import looping

from lerobot_latentsafe._compat import BETWEEN
from lerobot_latentsafe.decision import LawOptions, Reason
from lerobot_latentsafe.guard import UnknownPoseError
from lerobot_latentsafe.robots.shielded import shielded
from lerobot_latentsafe.robots.shielded.config_shielded import LatentSafeShieldedConfig
from lerobot_latentsafe.robots.uncalibrated import Uncalibrated

pytestmark = pytest.mark.usefixtures("virtual_time")
POSE, LARGEST, PERIOD = dict(zip(tiny.ARM, tiny.ARM_POSE)), 6.0, 1 / 30
"""Where the arm is, by how much it moved at once in the data, and how often."""
RETURN = ("lerobot.rollout.strategies.core", "_return_to_initial_position")


@RobotConfig.register_subclass("test_arm")
@dataclass(kw_only=True)
class ArmConfig(RobotConfig):
    """An arm of tests."""


class Arm(Uncalibrated, Robot):
    """It is where it was told to be. `shows` replaces readings, `took_s` is how long one takes."""

    config_class, name = ArmConfig, "test_arm"
    is_connected = True
    observation_features = property(lambda self: {**self.action_features, "front": (32, 32, 3)})
    action_features = property(lambda self: dict.fromkeys(tiny.ARM, float))

    def __init__(self, config):
        super().__init__(config)
        self.cameras, self.pose, self.shows, self.told, self.took_s = {"front": None}, dict(POSE), {}, [], 0.0
        self.pictures, self.wait = np.random.default_rng(0), None

    def connect(self, calibrate=True):
        pass

    def disconnect(self):
        pass

    def get_observation(self):
        if self.took_s:
            self.wait(self.took_s)
        return {**self.pose, "front": self.pictures.integers(0, 255, (32, 32, 3), np.uint8), **self.shows}

    def send_action(self, action):
        self.told.append(action)
        self.pose.update(action)
        return dict(action)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return tiny.save_arm_filter(tmp_path_factory.mktemp("arm") / "filter")


@pytest.fixture
def arm(trained, monkeypatch, virtual_time):
    monkeypatch.setattr(shielded, "make_robot_from_config", Arm)
    config = LatentSafeShieldedConfig(inner=ArmConfig(), filter=str(trained), law=LawOptions(epsilon=-2.0))
    made = shielded.LatentSafeShielded(config)
    made.inner.wait = virtual_time.sleep
    made.connect()
    yield made
    made.disconnect()


def beyond(degrees):
    return POSE | {"lift.pos": POSE["lift.pos"] + degrees}


def test_between_episodes_no_joint_goes_further_at_once_than_in_the_data(arm):
    arm.get_observation()
    sent = [looping(RETURN, lambda: arm.send_action(beyond(20.0))) for _ in range(4)]
    at = [action["lift.pos"] - POSE["lift.pos"] for action in sent]
    assert at == pytest.approx([LARGEST, 2 * LARGEST, 3 * LARGEST, 20.0])
    assert RETURN in BETWEEN


@pytest.mark.parametrize("shown", [math.nan, math.inf, 1e6, None, "-71"])
@pytest.mark.parametrize("known", [False, True])
@pytest.mark.fault(
    "A04", "an arm of joint targets moves, and no joint can be read", "Nothing is sent (`UnknownPoseError`)"
)
def test_nothing_moves_from_a_place_that_nobody_knows(arm, virtual_time, shown, known):
    if known:
        assert arm.send_action(beyond(0.5)) == pytest.approx(beyond(0.5))
        virtual_time.sleep(PERIOD)
    arm.inner.shows, arm.inner.told = {"lift.pos": shown}, []
    for move in (
        lambda: looping(RETURN, lambda: arm.send_action(beyond(20.0))),
        lambda: arm.send_action({"hand.pos": 1.0}),
        lambda: arm.send_action(beyond(0.5)),
    ):
        if known:
            assert abs(move()["lift.pos"] - POSE["lift.pos"]) <= LARGEST + 1
            arm.get_observation()
        else:
            with pytest.raises(UnknownPoseError):
                move()
    assert all(math.isfinite(x) for action in arm.inner.told for x in action.values()) and bool(arm.inner.told) == known


@pytest.mark.parametrize(("took_s", "stale"), [(0.02, False), (0.04, True), (0.5, True)])
def test_a_real_robot_has_a_period(arm, took_s, stale):
    arm.inner.took_s = took_s
    arm.send_action(beyond(0.5))
    assert (arm.filter.shield.decision.reason.item() == Reason.OBSERVATION_STALE) == stale


@pytest.mark.parametrize(
    ("action", "words"),
    [
        ({"hand.pos": 1.0}, "instead of a command of hand.pos"),
        ({}, "instead of a command of nothing"),
        ({"lift.pos": -60.0}, "lacks elbow.pos, gripper.pos"),
    ],
)
@pytest.mark.fault("A04", "an arm of joint targets gets an action of other names", "It holds still where it is")
def test_what_is_no_action_of_the_arm_leaves_it_where_it_is(arm, caplog, virtual_time, action, words):
    for _ in range(3):
        arm.get_observation()
        assert arm.send_action(action) == pytest.approx(POSE, abs=1e-4)
        virtual_time.sleep(PERIOD)
    assert caplog.text.count(words) == 1
