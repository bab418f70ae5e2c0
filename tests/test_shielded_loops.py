"""When a shielded robot looks, is told and begins anew; and robots that fail meanwhile."""

import importlib.util
import logging
import threading
import types
from pathlib import Path

import numpy as np
import pytest
from lerobot.robots.utils import make_robot_from_config
from lerobot_loops import RECORD_LOOP, Recorded, looping
from shielded_robots import ALWAYS, PERIOD, PUSH, STILL, config, last

from lerobot_latentsafe._compat import BETWEEN, RECORDING
from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.robots.shielded.shielded import MAX_FAILURES

pytestmark = pytest.mark.usefixtures("virtual_time")


def test_an_action_decided_on_an_old_observation_is_not_trusted(robot, virtual_time):
    robot.get_observation()
    virtual_time.sleep(robot.slack_s + 2 * PERIOD)
    robot.send_action(PUSH)
    assert last(robot).reason.item() == Reason.OBSERVATION_STALE and last(robot).intervened.item()


@pytest.mark.parametrize(
    ("slack_s", "took_s", "stale"),
    [(0.0, 0.2, True), (0.0, 0.5, True), (0.0, 2.0, True), (0.0, 0.04, False), (0.5, 0.5, False)],
)
@pytest.mark.fault("R06", "reading the robot takes 2 s", "The robot stays: `OBSERVATION_STALE`")
@pytest.mark.fault("R07", "reading the robot takes half a second", "The robot stays: `OBSERVATION_STALE`")
def test_the_age_counts_from_before_the_robot_was_read(trained, virtual_time, monkeypatch, slack_s, took_s, stale):
    with make_robot_from_config(config(trained, slack_s=slack_s)) as robot:
        read = robot.inner.get_observation
        monkeypatch.setattr(robot.inner, "get_observation", lambda: (read(), virtual_time.sleep(took_s))[0])
        robot.send_action(PUSH)
        assert (last(robot).reason.item() == Reason.OBSERVATION_STALE) == stale


@pytest.mark.parametrize("slack_s", [-1, float("nan"), float("inf")])
def test_a_slack_that_is_none_is_refused(trained, slack_s):
    with pytest.raises(ValueError, match="expected seconds, 0 or more"):
        config(trained, slack_s=slack_s)


RESETS = {
    "reset of lerobot-record": (RECORD_LOOP, {"dataset": None, "start_episode_t": 5.0}),
    **{name: ((module, name), {}) for module, name in sorted(BETWEEN)},
}


@pytest.mark.parametrize("where", RECORDING)
def test_lerobots_loops_are_called_and_name_what_they_record_as_before(where):
    """A new LeRobot that fails here is to be read anew: which of its loops records what?"""
    module, function = where
    found = compiled(module, function)
    assert set(RECORDING[where]) <= {*found.co_varnames} and {"get_observation"} <= {*found.co_names}


@pytest.mark.parametrize("where", sorted(BETWEEN))
def test_lerobots_moves_between_episodes_are_called_as_before(where):
    assert {"get_observation"} <= {*compiled(*where).co_names}


def compiled(module, function):
    """The code of a function of a module's file, or of a method in it."""
    spec = importlib.util.find_spec(module)
    waiting = [compile(Path(spec.origin).read_text(), spec.origin, "exec")]
    while waiting:
        code = waiting.pop()
        if code.co_name == function:
            return code
        waiting += [inner for inner in code.co_consts if isinstance(inner, types.CodeType)]
    raise AssertionError(f"{module} has no {function}")


@pytest.mark.parametrize("reset", RESETS)
@pytest.mark.parametrize("unfiltered", [False, True])
def test_moves_between_episodes_are_filtered_unless_allowed(trained, caplog, virtual_time, reset, unfiltered):
    """LeRobot returns an arm that acts in joint positions by commands of the usual names."""
    place, variables = RESETS[reset]
    far = PUSH | {"delta_x.pos": float("inf")}

    def tick(action=PUSH):
        virtual_time.sleep(PERIOD)
        robot.get_observation()
        return robot.send_action(action)

    with make_robot_from_config(config(trained, {"epsilon": ALWAYS}, unfiltered_moves=unfiltered)) as robot:
        recorded = {"dataset": Recorded(4), "start_episode_t": 1.0}
        assert looping(RECORD_LOOP, tick, **recorded) != pytest.approx(PUSH)
        assert (looping(place, tick, **variables) == pytest.approx(PUSH)) == unfiltered
        assert np.isfinite(list(looping(place, lambda: tick(far), **variables).values())).all()
        assert looping(RECORD_LOOP, tick, **recorded) != pytest.approx(PUSH)


@pytest.mark.fault("R46", "a library logs 'Reset the environment'", "Nothing: the filter goes on")
def test_what_anybody_logs_switches_no_filter_off(trained, virtual_time):
    with make_robot_from_config(config(trained, {"epsilon": ALWAYS}, unfiltered_moves=True)) as robot:
        for line in ("Recording episode 3", "Reset the environment", "Returning robot to initial position"):
            logging.getLogger().info(line)
            virtual_time.sleep(PERIOD)
            robot.get_observation()
            assert robot.send_action(PUSH) != pytest.approx(PUSH)


def test_another_thread_than_the_loops_moves_nothing_unfiltered(trained):
    with make_robot_from_config(config(trained, {"epsilon": ALWAYS}, unfiltered_moves=True)) as robot:
        sent = []

        def reset():
            robot.get_observation()
            other = threading.Thread(target=lambda: sent.append(robot.send_action(PUSH)))
            other.start()
            other.join()

        looping(sorted(BETWEEN)[0], reset)
        assert sent != [pytest.approx(PUSH)]


@pytest.mark.parametrize("level", [logging.WARNING, logging.INFO])
@pytest.mark.fault("R47", "episodes begin while logging is at WARNING", "The history starts anew")
def test_each_episode_starts_anew_even_one_that_is_recorded_again(robot, monkeypatch, level, virtual_time):
    """Whatever is logged, and also if no tick comes between two episodes."""
    logging.getLogger().setLevel(level)
    starts, reset = [], robot.filter.shield.reset
    monkeypatch.setattr(robot.filter.shield, "reset", lambda: starts.append(robot.episode) or reset())
    for episode, began in [(0, 1.0), (0, 1.0), (0, 2.0), (1, 3.0), (1, 3.0)]:
        virtual_time.sleep(PERIOD)
        looping(RECORD_LOOP, robot.get_observation, dataset=Recorded(episode), start_episode_t=began)
        looping(RECORD_LOOP, lambda: robot.send_action(PUSH), dataset=Recorded(episode), start_episode_t=began)
    assert len(starts) == 3 and robot.inner.episode == 4  # once as it was connected


RATES = {
    "as in the data": (0.05, False),
    "a bit slower": (0.06, False),
    "ten times slower": (0.5 + 1e-3, True),
    "slow, and seen in time": (0.99, True),
    "hundred times faster": (0.0005, True),
}


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.fault("R40", "a loop ten times too slow or too fast", "The robot stays: `WRONG_RATE`")
def test_a_loop_of_another_rate_is_not_trusted_from_the_second_tick_on(robot, caplog, virtual_time, rate):
    gap, wrong = RATES[rate]
    for _ in range(2):
        robot.get_observation()
        robot.send_action(PUSH)
        virtual_time.sleep(gap)
    assert (last(robot).reason.item() == Reason.WRONG_RATE) == wrong and ("--fps=20" in caplog.text) == wrong


def failing(*_):
    raise ConnectionError("no answer from the arm")


@pytest.mark.fault(
    "R25",
    "reading the robot raises an error",
    "The robot stays: `OBSERVATION_STALE`; the fifth time in a row the error is raised",
)
def test_a_robot_that_is_not_read_stays_and_fails_aloud_the_fifth_time(robot, monkeypatch, virtual_time):
    first = robot.get_observation()
    robot.send_action(PUSH)
    told, send = [], robot.inner.send_action
    monkeypatch.setattr(robot.inner, "send_action", lambda action: told.append(action) or send(action))
    with monkeypatch.context() as m:
        m.setattr(robot.inner, "get_observation", failing)
        for _ in range(MAX_FAILURES - 1):
            virtual_time.sleep(PERIOD)
            again = robot.get_observation()
            assert all(np.array_equal(again[name], first[name]) for name in robot.observation_features)
            assert robot.send_action(PUSH) == pytest.approx(STILL)
            assert last(robot).reason.item() == Reason.OBSERVATION_STALE
        told.clear()
        with pytest.raises(ConnectionError):
            robot.get_observation()
        assert told == [pytest.approx(STILL)]
    virtual_time.sleep(PERIOD)
    assert robot.send_action(PUSH) == pytest.approx(PUSH) and last(robot).reason.item() == Reason.PASSED


def test_a_robot_that_shows_nothing_at_all_fails_at_once(robot, monkeypatch):
    monkeypatch.setattr(robot.inner, "get_observation", failing)
    calls = []
    monkeypatch.setattr(robot.inner, "send_action", lambda action: calls.append(action) or action)
    for call in (
        robot.get_observation,
        lambda: robot.send_action(PUSH),
        lambda: robot.send_action({"joint_1.pos": 0.0}),
    ):
        with pytest.raises(ConnectionError):
            call()
    assert not any(action == PUSH for action in calls)


@pytest.mark.fault(
    "R37", "sending to the robot raises an error", "It is logged; the fifth time in a row the error is raised"
)
def test_a_robot_that_takes_no_action_fails_aloud_the_fifth_time(robot, monkeypatch, virtual_time):
    with monkeypatch.context() as m:
        m.setattr(robot.inner, "send_action", failing)
        for _ in range(MAX_FAILURES - 1):
            assert robot.send_action(PUSH) == pytest.approx(PUSH)  # what it was told, if not what it did
            virtual_time.sleep(PERIOD)
        with pytest.raises(ConnectionError):
            robot.send_action(PUSH)
    assert sum(robot.filter.shield.failures.values()) == MAX_FAILURES - 1
    virtual_time.sleep(PERIOD)
    assert robot.send_action(PUSH) == pytest.approx(PUSH)


REPORTS = {
    "nothing": None,
    "no names": [0.0],
    "not a number": PUSH | {"delta_y.pos": float("nan")},
    "no value": PUSH | {"delta_y.pos": None},
    "other names": {"joint_1.pos": 0.3},
    "fewer names": {"gripper.pos": 1.0},
}


@pytest.mark.parametrize("report", REPORTS)
@pytest.mark.fault(
    "R37", "the robot returns None, NaN or other names", "What it was told counts as executed, and that is said"
)
def test_a_robot_that_does_not_say_what_it_did_did_what_it_was_told(robot, monkeypatch, caplog, virtual_time, report):
    monkeypatch.setattr(robot.inner, "send_action", lambda _: REPORTS[report])
    for _ in range(3):
        assert robot.send_action(PUSH) == pytest.approx(PUSH)
        assert robot.filter.shield.guard.told.tolist() == [pytest.approx([*PUSH.values()])]
        virtual_time.sleep(PERIOD)
    assert caplog.text.count("does not say what it executed") == 1
