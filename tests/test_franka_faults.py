"""What the real Franka's robot class makes of each fault of arm, gripper, cameras, clock and threads."""

import threading
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from franka_stand_in import START, STILL, connected, make, standing_clock, stepping, unhurried, wait_for
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from scipy.spatial.transform import Rotation

from lerobot_latentsafe.franka.actions import (
    ACTION_NAMES,
    GRIPPER_WIDTH,
    HOME,
    JOINT_NAMES,
    MAX_SPEED,
    MAX_TURN_SPEED,
)
from lerobot_latentsafe.robots.franka import checked
from lerobot_latentsafe.robots.franka.driver import ArmFaultError, ArmState, FrankaError, GripperError
from lerobot_latentsafe.robots.franka.franka import DOWN
from lerobot_latentsafe.robots.franka.limits import KEPT, Pose


@pytest.fixture
def clock(monkeypatch):
    return standing_clock(monkeypatch)


@pytest.fixture
def robot(clock):
    with connected() as robot:
        yield robot


@pytest.fixture
def step(robot, clock):
    return stepping(robot, clock)


FOREVER = threading.Event()  # never set
NAN = float("nan")


def answers(**changed):
    """A driver's `state` with another value in it."""
    state = ArmState(HOME.copy(), START.copy(), DOWN, GRIPPER_WIDTH)
    return lambda: replace(state, **changed)


def failing(error):
    def fail(*args):
        raise error

    return fail


FAULTS = {
    "position NaN": ("state", answers(position=START * NAN), r"tells position \[nan"),
    "position infinite": ("state", answers(position=np.full(3, np.inf)), r"tells position \[inf"),
    "position in millimetres": ("state", answers(position=START * 1e3), r"tells position \[450"),
    "position of two numbers": ("state", answers(position=START[:2]), "tells position"),
    "joint NaN": ("state", answers(joints=HOME * NAN), r"tells joints \[nan"),
    "joints in degrees": ("state", answers(joints=np.rad2deg(HOME)), "tells joints"),
    "rotation NaN": ("state", answers(rotation=Rotation.from_rotvec([NAN, 0, 0])), r"tells rotation \[nan"),
    "rotation infinite": ("state", answers(rotation=Rotation.from_rotvec([np.inf, 0, 0])), "tells rotation"),
    "no rotation": ("state", answers(rotation=None), "expected an ArmState"),
    "width NaN": ("state", answers(width=NAN), "tells width nan"),
    "width in millimetres": ("state", answers(width=80.0), "tells width 80"),
    "width missing": ("state", answers(width=None), "tells width nan"),
    "state is None": ("state", lambda: None, "told None; expected an ArmState"),
    "state raises": ("state", failing(ValueError("odd")), r"driver's state failed \(ValueError: odd"),
    "state leaves the program": ("state", failing(SystemExit(1)), "state raised SystemExit"),
    "state hangs": ("state", FOREVER.wait, "does not answer: state did not end within"),
    "track raises": ("track", failing(ValueError("odd")), r"driver's track failed \(ValueError: odd"),
    "track leaves the program": ("track", failing(SystemExit(1)), r"stream failed \(SystemExit"),
    "track hangs": ("track", FOREVER.wait, "its stream hangs or has ended"),
}


@pytest.mark.parametrize(("name", "broken", "message"), FAULTS.values(), ids=FAULTS)
@pytest.mark.parametrize("noticed_by", ["an action", "an observation", "the watchdog"])
@pytest.mark.fault("F01", "a measured position is NaN", "The arm stops until it is connected anew (`ArmFaultError`)")
@pytest.mark.fault(
    "F03", "the driver raises in the stream thread", "The arm stops until it is connected anew (`ArmFaultError`)"
)
@pytest.mark.fault(
    "F04", "the driver raises in the watchdog", "The arm stops until it is connected anew (`ArmFaultError`)"
)
def test_a_fault_of_the_arm_stops_it_until_it_is_connected_anew(robot, clock, name, broken, message, noticed_by):
    hangs, act = broken == FOREVER.wait, lambda: robot.send_action(STILL | {"delta_x.pos": 0.01})
    act()
    calls, stream, robot._arm.patience = robot.driver.calls, robot._stream, 0.02 if hangs else 60.0
    setattr(robot.driver, name, broken if not hangs else lambda *given: broken())
    if noticed_by == "the watchdog" or name == "track":
        clock.now += 10 * robot.config.watchdog
    if not (hangs and name == "track") and (noticed_by == "the watchdog" or name == "track"):
        wait_for(lambda: stream.error is not None)
    with pytest.raises(ArmFaultError, match=message):
        robot.get_observation() if noticed_by == "an observation" else act()
    assert "stop" in calls and np.isfinite(robot.driver.tracked).all()
    delattr(robot.driver, name)  # the arm is well again
    del robot.driver.tracked[:]
    for call in (act, robot.get_observation):
        with pytest.raises(ArmFaultError, match=r"stopped before .*disconnect\(\) and connect\(\)"):
            call()
    assert not robot.driver.tracked
    robot.disconnect()
    robot.connect()
    unhurried(robot).get_observation()
    assert act()["delta_x.pos"] == pytest.approx(0.01)


@pytest.mark.fault("F01", "the pose that is to be streamed is NaN", "It is not sent (`ArmFaultError`)")
def test_nothing_that_is_not_finite_is_streamed(robot):
    """Whatever becomes of the commanded pose inside."""
    robot._stream.set_target(Pose(START * NAN, DOWN))
    wait_for(lambda: robot._stream.error is not None)
    with pytest.raises(ArmFaultError, match="is not finite; it was not sent"):
        robot.send_action(STILL)
    assert np.isfinite(robot.driver.tracked).all()


@pytest.mark.fault("F05", "the arm does not answer the watchdog", "Nobody waits for it (`ArmFaultError`)")
def test_nobody_waits_for_an_arm_that_does_not_answer_the_watchdog(robot, clock):
    asked, answered = threading.Event(), threading.Event()
    robot.driver.state = lambda: asked.set() or answered.wait(60.0)
    clock.now += 10 * robot.config.watchdog
    robot._stream.set_target(robot._stream.target())
    clock.now += 10 * robot.config.watchdog
    assert asked.wait(60.0)
    robot._stream.target()  # its lock is free
    robot._arm.patience = 0.02
    with pytest.raises(ArmFaultError, match=r"does not answer|stream hangs"):
        robot.send_action(STILL)
    assert not answered.is_set()
    answered.set()


def test_an_action_that_comes_while_the_watchdog_asks_is_followed(robot, clock):
    asked, answered, state = threading.Event(), threading.Event(), robot.driver.state
    robot.send_action(STILL)
    robot.driver.state = lambda: asked.set() or (answered.wait(60.0) and state())
    clock.now += 10 * robot.config.watchdog
    assert asked.wait(60.0)
    wanted = Pose(START + 0.01, DOWN)
    robot._stream.set_target(wanted)
    answered.set()
    wait_for(lambda: robot._stream._sent >= clock.now)
    assert robot._stream.target() is wanted and robot._stream.error is None


@pytest.mark.fault(
    "F06b", "recovering fails, then the arm answers again", "Refused until it is connected anew (`ArmFaultError`)"
)
def test_an_arm_that_does_not_recover_is_refused_until_it_is_connected_anew(robot):
    robot.driver.reflex, robot.driver.recover = True, failing(FrankaError("release the user stop"))
    with pytest.raises(FrankaError, match="release the user stop"):
        robot.send_action(STILL)
    robot.driver.reflex = False  # the user stop was released
    with pytest.raises(ArmFaultError, match=r"stopped before \(release the user stop\)"):
        robot.send_action(STILL)
    del robot.driver.recover
    robot.disconnect()
    robot.connect()
    unhurried(robot).send_action(STILL)


def test_an_arm_that_does_not_stop_is_told(robot, caplog):
    robot.driver.stop, robot.driver.state = failing(FrankaError("no answer")), failing(ValueError("odd"))
    with pytest.raises(ArmFaultError, match="odd"):
        robot.send_action(STILL)
    assert "does not confirm that it stops (no answer); press the user stop" in caplog.text
    with pytest.raises(DeviceNotConnectedError):
        [robot.disconnect(), robot.disconnect()]


@pytest.mark.parametrize("rate", [15, 60, 200])
@pytest.mark.fault("F11", "a loop four times too fast", "The arm goes no faster than its limit")
def test_the_speed_limit_is_by_time_not_by_action(robot, step, rate):
    sent = [step(robot.config.fps / rate, delta_y=0.02, delta_rz=0.13) for _ in range(rate // 5)]
    assert sum(action["delta_y.pos"] for action in sent) <= MAX_SPEED * (0.2 + KEPT / 15) + 1e-9
    assert sum(action["delta_rz.pos"] for action in sent) <= MAX_TURN_SPEED * (0.2 + KEPT / 15) + 1e-9
    assert sum(action["delta_y.pos"] for action in sent) > 0.8 * MAX_SPEED * 0.2


def test_what_is_streamed_is_no_faster_than_the_limit_however_actions_come(robot, clock):
    clock.runs = True
    for _ in range(20):
        for _ in range(3):  # in a burst
            robot.send_action(STILL | {"delta_y.pos": 0.02, "delta_rz.pos": 0.13})
        until = clock.now + 1 / robot.config.fps
        wait_for(lambda until=until: clock.now >= until)
    times, poses = zip(*robot.driver.streamed)
    speed = np.abs(np.diff([position[1] for position, _ in poses])) / np.diff(times)
    turning = [(b * a.inv()).magnitude() for (_, a), (_, b) in pairwise(poses)] / np.diff(times)
    assert speed.max() <= 1.01 * MAX_SPEED and turning.max() <= 1.01 * MAX_TURN_SPEED


def test_a_loop_that_is_not_quite_regular_loses_nothing(robot, step):
    robot.driver.follow = 1.0
    late = [1.2, 0.8, 1.0, 0.7, 1.3, 0.9, 1.1] * 3
    assert [step(periods, delta_y=0.01)["delta_y.pos"] for periods in late] == pytest.approx([0.01] * len(late))


@pytest.mark.parametrize("moment", [-1.0, NAN, -np.inf])
def test_a_clock_that_goes_back_gives_no_speed(robot, clock, moment):
    robot.send_action(STILL | {"delta_x.pos": 0.02})
    clock.now += moment
    with suppress(FrankaError):  # a time that is no number is a fault of the stream
        assert robot.send_action(STILL | {"delta_x.pos": 0.02})["delta_x.pos"] == 0.0
    assert np.isfinite(robot.driver.tracked).all()


@pytest.mark.parametrize("outside", [(0.85, 0.0, 0.30), (0.45, 0.0, 0.01), (0.2, -0.5, 0.6)])
@pytest.mark.fault("F15", "the arm was guided out of the workspace", "It does not jump back")
def test_an_arm_that_was_led_out_of_the_workspace_does_not_jump(robot, step, outside):
    robot.driver.position = np.array(outside)
    robot.driver.blocked = True
    low, high = robot.config.workspace_low, robot.config.workspace_high
    for _ in range(40):
        sent = step()
        assert max(abs(sent[name]) for name in ACTION_NAMES[:6]) <= MAX_SPEED / robot.config.fps + 1e-9
    robot.driver.blocked = False
    out = robot._stream.target().position
    np.testing.assert_allclose(np.abs(out - outside).max(), robot.config.max_lead, atol=1e-9)
    away = np.sign(np.clip(out, low, high) - out)  # it may come back, and not go further out
    further = step(**{f"delta_{axis}": -0.02 * d for axis, d in zip("xyz", away)})
    assert all(further[f"delta_{axis}.pos"] * d >= 0 for axis, d in zip("xyz", away) if d)
    back = step(**{f"delta_{axis}": 0.02 * d for axis, d in zip("xyz", away)})
    assert all(back[f"delta_{axis}.pos"] * d > 0 for axis, d in zip("xyz", away) if d)


@pytest.mark.fault("F09", "the gripper does not move", "It is told once more, and that is said")
def test_a_gripper_that_stays_is_told_again_once(robot, step, caplog):
    told = lambda: [call for call in robot.driver.calls if call.startswith("gripper")]  # noqa: E731
    robot.driver.move_gripper = lambda width: robot.driver.calls.append(f"gripper {width:.3f}")
    for _ in range(3):
        seen = robot.get_observation()["gripper.pos"]
        step(12.0, gripper=0.0)
    assert seen == 1.0 and told() == ["gripper 0.000"] and "told again" not in caplog.text
    for _ in range(8):
        step(12.0, gripper=0.0)
    assert told() == ["gripper 0.000"] * 2 and caplog.text.count("stays at 0.080 m: told again") == 1


def test_a_gripper_that_holds_something_is_not_told_again(robot, step, caplog):
    robot.driver.move_gripper = lambda width: setattr(robot.driver, "width", 0.03)
    for _ in range(8):
        step(12.0, gripper=0.0)
    assert "told again" not in caplog.text


@pytest.mark.parametrize("fault", [failing(ValueError("odd")), lambda width: FOREVER.wait()], ids=["raises", "hangs"])
def test_a_gripper_that_is_not_told_is_a_lost_gripper(robot, fault, monkeypatch):
    robot.driver.move_gripper = fault
    monkeypatch.setitem(checked.LIMIT_S, "move_gripper", 0.02)
    with pytest.raises(GripperError, match="move_gripper"):
        robot.send_action(STILL | {"gripper.pos": 0.0})
    with pytest.raises(ArmFaultError, match="stopped before"):
        robot.send_action(STILL)


class Camera:
    """One that knows whether it is connected, as LeRobot's do."""

    height = width = 64
    connected = broken = False

    def connect(self):
        if self.connected:
            raise DeviceAlreadyConnectedError("connected already")
        self.connected = True
        if self.broken:
            raise ConnectionError("no picture")

    def disconnect(self):
        if not self.connected:
            raise DeviceNotConnectedError("not connected")
        self.connected = False


HALF_WAY = {
    "a camera": lambda robot: setattr(robot.cameras["wrist"], "broken", True),
    "the driver": lambda robot: setattr(robot.driver, "connect", failing(FrankaError("no Franka at 172.16.0.2"))),
    "the first state": lambda robot: setattr(robot.driver, "state", failing(GripperError("no gripper"))),
    "the start": lambda robot: setattr(robot.driver, "start", failing(FrankaError("locked"))),
    "Ctrl-C": lambda robot: setattr(robot.driver, "connect", failing(KeyboardInterrupt())),
}


@pytest.mark.parametrize("break_it", HALF_WAY.values(), ids=HALF_WAY)
@pytest.mark.fault("F10", "connecting fails half way", "Cameras are closed, and it can be connected again")
def test_connecting_that_ends_half_way_leaves_nothing_open(clock, break_it):
    robot = unhurried(make())
    robot.cameras = {"front": Camera(), "wrist": Camera()}
    break_it(robot)
    with pytest.raises((FrankaError, GripperError, ConnectionError, KeyboardInterrupt)):
        robot.connect()
    assert not robot.is_connected and not any(camera.connected for camera in robot.cameras.values())
    robot.disconnect()  # as a `finally` does
    robot.cameras["wrist"].broken = False
    for name in ("connect", "state", "start"):
        robot.driver.__dict__.pop(name, None)
    robot.connect()
    assert robot.is_connected and robot.send_action(STILL)
    robot.disconnect()
    assert not any(camera.connected for camera in robot.cameras.values())


def test_two_threads_do_not_move_the_arm_at_once(robot):
    asked, answered, state = threading.Event(), threading.Event(), robot.driver.state
    robot.driver.state = lambda: asked.set() or (answered.wait(60.0) and state())
    other = threading.Thread(target=lambda: robot.send_action(STILL))
    other.start()
    assert asked.wait(60.0)
    with pytest.raises(ArmFaultError, match="another thread uses the arm; nothing was sent"):
        robot.send_action(STILL)
    answered.set()
    other.join(60.0)
    assert robot.send_action(STILL)  # it was only busy


def test_disconnecting_ends_a_call_of_another_thread(robot):
    asked, answered, errors = threading.Event(), threading.Event(), []
    robot.driver.move_joints = lambda joints: asked.set() or answered.wait(60.0)

    def go_home():
        try:
            robot.send_action(dict(zip(JOINT_NAMES, HOME + 0.1)))
        except DeviceNotConnectedError as e:
            errors.append(e)

    other = threading.Thread(target=go_home)
    other.start()
    assert asked.wait(60.0)
    robot.disconnect()
    answered.set()
    other.join(60.0)
    assert errors and robot.driver.calls[-1] == "disconnect"  # it does not start again
