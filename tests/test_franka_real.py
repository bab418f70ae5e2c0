"""The real Franka's robot class against a stand-in driver that lags, stops and loses its gripper."""

import logging
import time

import numpy as np
import pytest
from franka_stand_in import START, STILL, connected, make, standing_clock, stepping, wait_for
from lerobot.robots.utils import make_robot_from_config
from lerobot.utils.errors import DeviceNotConnectedError

from lerobot_latentsafe.franka.actions import ACTION_NAMES, HOME, JOINT_NAMES, STATE_NAMES
from lerobot_latentsafe.robots.franka.config_franka import LatentSafeFrankaConfig
from lerobot_latentsafe.robots.franka.driver import FrankaError, FrankyDriver, GripperError
from lerobot_latentsafe.robots.franka.franka import DOWN, LatentSafeFranka


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


def test_features_are_the_simulations(robot):
    assert list(robot.action_features) == ACTION_NAMES and list(robot.observation_features) == STATE_NAMES
    seen = robot.get_observation()
    assert list(seen) == STATE_NAMES and seen["gripper.pos"] == 1.0
    np.testing.assert_allclose(
        [seen[f"ee_{axis}.pos"] for axis in ("x", "y", "z", "rx", "ry", "rz")], [*START, 0, 0, 0]
    )


def test_a_delta_is_streamed_smoothly(robot, clock):
    clock.runs = True
    sent = robot.send_action(STILL | {"delta_x.pos": 0.02})
    assert sent["delta_x.pos"] == pytest.approx(0.02)
    wait_for(lambda: abs(robot.driver.position[0] - 0.47) < 1e-3)
    steps = np.diff([position[0] for position in robot.driver.tracked])
    assert steps.max() < 0.02 and steps.min() > -1e-9  # in between, not in one jump


def test_the_commanded_pose_stays_in_the_workspace_and_near_the_arm(robot, step):
    robot.driver.blocked = True
    for _ in range(5):
        step(delta_x=0.03, delta_rz=0.13)
    position, rotation = robot._stream.target()
    assert position[0] == pytest.approx(START[0] + robot.config.max_lead)
    assert (rotation * DOWN.inv()).magnitude() == pytest.approx(robot.config.max_lead_turn)
    robot.driver.position = np.array([0.45, 0.0, 0.03])
    sent = [step(delta_z=-0.03)["delta_z.pos"] for _ in range(30)]
    assert robot._stream.target()[0][2] == pytest.approx(robot.config.workspace_low[2])
    assert sum(sent) == pytest.approx(robot.config.workspace_low[2] - 0.30)  # what was commanded, not what was asked


def test_without_new_actions_the_arm_holds(robot, clock, caplog):
    robot.driver.follow, clock.runs = 0.01, True
    with caplog.at_level(logging.WARNING):
        robot.send_action(STILL | {"delta_y.pos": 0.03})
        wait_for(lambda: robot._stream._holds)  # the log comes first, then the arm is asked where it is
    assert "holding" in caplog.text and robot._stream.target()[0][1] < 0.02


def test_the_gripper_moves_when_the_wish_changes(robot):
    for opening in (1.0, 0.98, 0.0, 0.0, 1.0):
        robot.send_action(STILL | {"gripper.pos": opening})
    assert [call for call in robot.driver.calls if call.startswith("gripper")] == ["gripper 0.000", "gripper 0.080"]


def test_returning_to_the_start_is_a_slow_joint_move(robot):
    goal = dict(zip(STATE_NAMES, [*(HOME + 0.1), 1.0, *START, 0, 0, 0]))
    sent = robot.send_action(goal)
    assert set(sent) == {*JOINT_NAMES, "gripper.pos"}
    assert robot.driver.calls[-3:] == ["stop", "move_joints", "start"]
    robot.send_action(goal)  # LeRobot repeats it at 50 Hz
    assert robot.driver.calls.count("move_joints") == 1
    robot.send_action(STILL)


def test_reflexes_are_recovered_from_a_few_times(robot, caplog):
    for _ in range(robot.config.max_recoveries):
        robot.driver.reflex = True
        assert robot.get_observation()["ee_x.pos"] == pytest.approx(START[0])
        robot.send_action(STILL)
    assert robot.driver.calls.count("recover") == 3 and "recovering (3 of 3)" in caplog.text
    robot.driver.reflex = True
    with pytest.raises(FrankaError, match="cartesian reflex"):
        robot.send_action(STILL)


def test_disconnecting_stops_the_arm_in_any_state(robot):
    stream = robot._stream
    robot.driver.gripper_lost = True
    robot.disconnect()
    stream.join(60)
    assert robot.driver.calls[-2:] == ["stop", "disconnect"] and not stream.is_alive() and not robot.is_connected


def test_monitor_mode_never_moves(caplog):
    robot = make(monitor=True)
    with caplog.at_level(logging.INFO):
        robot.connect()
        sent = robot.send_action(STILL | {"delta_x.pos": 0.02, "gripper.pos": 0.0})
        robot.send_action(dict(zip(JOINT_NAMES, HOME + 0.2)))
        robot.disconnect()
    assert sent["delta_x.pos"] == pytest.approx(0.02) and "not executed" in caplog.text
    assert set(robot.driver.calls) == {"connect", "disconnect"} and not robot.driver.tracked


def test_lerobot_makes_it_from_its_configuration():
    robot = make_robot_from_config(LatentSafeFrankaConfig(ip="172.16.0.2"))
    assert isinstance(robot, LatentSafeFranka) and isinstance(robot.driver, FrankyDriver)


# Bad input


def test_a_lost_gripper_ends_the_episode(robot):
    robot.driver.gripper_lost = True
    with pytest.raises(GripperError, match="does not answer"):
        robot.get_observation()


def test_a_gripper_lost_between_actions_is_told_at_the_next(robot, clock):
    robot.send_action(STILL)
    robot.driver.gripper_lost = clock.runs = True
    wait_for(lambda: robot._stream.error is not None)  # the stream asked for the state, in which to hold
    robot.driver.gripper_lost = False
    with pytest.raises(GripperError, match="does not answer"):
        robot.send_action(STILL)


def test_an_error_in_the_middle_of_an_episode_keeps_the_recording(robot, tmp_path):
    """What lerobot-record does: frames until the driver fails, then finalize."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features = {
        "observation.state": {"dtype": "float32", "shape": (14,), "names": STATE_NAMES},
        "action": {"dtype": "float32", "shape": (7,), "names": ACTION_NAMES},
    }
    dataset = LeRobotDataset.create("me/real", 15, features, root=tmp_path / "real", use_videos=False)
    with pytest.raises(GripperError):
        try:
            for step in range(10):
                robot.driver.gripper_lost = step == 6
                seen = robot.get_observation()
                sent = robot.send_action(STILL)
                state = np.array([seen[name] for name in STATE_NAMES], np.float32)
                action = np.array([sent[name] for name in ACTION_NAMES], np.float32)
                dataset.add_frame({"observation.state": state, "action": action, "task": "x"})
                if step == 4:
                    dataset.save_episode()
        finally:
            dataset.finalize()
    assert LeRobotDataset("me/real", root=tmp_path / "real").num_frames == 5


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (STILL | {"delta_x.pos": np.nan}, "non-finite"),
        ({"delta_x": 1.0}, r"expected delta_x\.pos"),
        ({}, r"has the names \(none\)"),
        (None, "does not name numbers"),
        (STILL | {"delta_x.pos": None}, "does not name numbers"),
        (STILL | {"delta_x.pos": "fast"}, "does not name numbers"),
        (STILL | {"delta_x.pos": np.zeros(2)}, "does not name numbers"),
    ],
    ids=str,
)
def test_broken_actions_move_nothing(robot, broken, message):
    before = robot._stream.target()[0].copy()
    with pytest.raises(ValueError, match=message):
        robot.send_action(broken)
    np.testing.assert_array_equal(robot._stream.target()[0], before)
    assert robot.send_action(STILL)  # the arm is well


def test_an_unconnected_robot_says_so():
    robot = make()
    for call in (robot.get_observation, lambda: robot.send_action(STILL), robot.disconnect):
        with pytest.raises(DeviceNotConnectedError, match=r"call connect\(\) first"):
            call()


def test_a_camera_of_another_size_is_refused(robot):
    class Camera:
        height = width = 64

        def async_read(self):
            return np.zeros((48, 64, 3), np.uint8)

        def disconnect(self):
            pass

    robot.cameras = {"front": Camera()}
    robot.config.cameras = {"front": Camera()}
    robot.__dict__.pop("observation_features", None)
    with pytest.raises(ValueError, match=r"'front' gives images of shape \(48, 64, 3\), configured is \(64"):
        robot.get_observation()


@pytest.mark.parametrize(
    "options, message",
    [
        ({"workspace_low": (0.8, 0, 0)}, "must be below workspace_high"),
        ({"workspace_low": (np.nan, 0, 0)}, "both finite"),
        ({"workspace_high": (np.inf, 1, 1)}, "both finite"),
        ({"stiffness": -1.0}, "stiffness is -1"),
        ({"max_lead": np.nan}, "max_lead is nan"),
        ({"watchdog": np.inf}, "watchdog is inf"),
        ({"force_threshold": 0.0}, "force_threshold is 0"),
        ({"fps": 0}, "fps is 0"),
        ({"tool_offset": np.nan}, "tool_offset is nan"),
        ({"max_recoveries": -1}, "max_recoveries is -1"),
        ({"watchdog": 0.05}, r"watchdog is 0\.05 s; at 15 Hz expected at least 0\.100 s"),
    ],
)
def test_unsafe_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        LatentSafeFrankaConfig(ip="172.16.0.2", **options)


def test_a_missing_driver_names_the_extra(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "franky", None)
    with pytest.raises(ImportError, match=r"pip install 'lerobot_policy_latentsafe\[franka\]'"):
        make(FrankyDriver(LatentSafeFrankaConfig(ip="172.16.0.2"))).connect()


def test_end_to_end_against_the_protocol_simulator():
    """The real driver, over libfranka's protocol on loopback; needs the extra `franka` and franky-sim."""
    pytest.importorskip("franky")
    franky_sim = pytest.importorskip("franky_sim")
    from franky_sim.mujoco_simulator import MujocoSimulator

    with MujocoSimulator(enable_visualization=False) as simulator:
        model = simulator.add_robot()
        with franky_sim.SimulationServer(simulator) as server:
            server.run_async()
            robot = LatentSafeFranka(LatentSafeFrankaConfig(ip=model.hostname, realtime=False, watchdog=2.0))
            robot.connect()
            start = robot.get_observation()
            goal = start["ee_z.pos"]
            for _ in range(15):
                robot.send_action(STILL | {"delta_z.pos": -0.004, "gripper.pos": start["gripper.pos"]})
                goal -= 0.004
                time.sleep(1 / 15)
            wait_for(lambda: robot.get_observation()["ee_z.pos"] == pytest.approx(goal, abs=0.02))
            robot.disconnect()
