"""In time: when decisions come, how old what they are made on is, and who is waited for, and how long."""

import math
import os
import threading
from asyncio import CancelledError

import pytest
import tiny
import torch

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.guard import Pace
from lerobot_latentsafe.runtime.time_limit import TimeLimit
from lerobot_latentsafe.shield import Shield

PERIOD = 0.05  # of the tiny filter, at 20 Hz


def at_rate(rate, n=6):
    return [i / rate for i in range(n)]


@pytest.mark.parametrize(
    ("times", "wrong"),
    [
        (at_rate(20), []),
        (at_rate(30), []),
        (at_rate(11), []),
        (at_rate(41), [2, 3, 4, 5]),  # more than twice as often: three decisions in a period
        (at_rate(2000), [1, 2, 3, 4, 5]),  # at once
        (at_rate(9), [1, 2, 3, 4, 5]),
        (at_rate(2), [1, 2, 3, 4, 5]),
        (at_rate(0.5), [1, 2, 3, 4, 5]),  # each after a pause
        ([0, 0.05, 0.1, 0.25, 0.30, 0.35], [3]),  # one late tick
        ([0, 0.05, 0.02, 0.07, 0.12], [2]),  # the clock went back
        ([0, 0.05, math.nan, 0.15, 0.2], [2, 3]),
        ([0, 0.05, 50.0, 50.05], [2]),  # and leapt
    ],
)
def test_a_real_loop_of_another_rate_is_told(times, wrong):
    pace = Pace(20)
    pace.strict = True
    found = [pace.tick(now, 0.0) for now in times]
    assert [i for i, reason in enumerate(found) if reason == Reason.WRONG_RATE] == wrong


def test_slack_is_for_late_ticks_and_old_observations():
    pace = Pace(20)
    pace.strict, pace.slack_s = True, 0.1
    assert [pace.tick(now, 100.0) for now in (0.0, 0.29, 0.6)] == [Reason.PASSED, Reason.PASSED, Reason.WRONG_RATE]
    assert pace.oldest(100.0) == pytest.approx(0.25) and pace.oldest(0.0, n=3) == pytest.approx(0.25)


@pytest.mark.parametrize("clock", [10.0, math.nan, -1.0])
def test_without_a_deadline_nothing_older_than_a_period_passes(policy, clock):
    policy.config.law.epsilon = -2.0
    times = iter([0.0, clock])
    policy.shield = Shield(policy.model, clock=lambda: next(times))
    decision = policy.shield(tiny.observation([[-0.9, 0.1, 0.0]]), torch.tensor([[0.0, 1.0]]))
    assert decision.reason.item() == Reason.DEADLINE_MISSED and decision.intervened.item()


@pytest.mark.parametrize(("age_s", "took_s", "late"), [(0.0, 0.04, False), (0.03, 0.03, True), (0.03, 0.01, False)])
def test_age_counts_until_the_action_leaves(policy, age_s, took_s, late):
    policy.config.law.epsilon = -2.0
    times = iter([0.0, took_s])
    policy.shield = Shield(policy.model, clock=lambda: next(times))
    decision = policy.shield(tiny.observation([[-0.9, 0.1, 0.0]]), torch.tensor([[0.0, 1.0]]), age_s)
    assert (decision.reason.item() == Reason.DEADLINE_MISSED) == late


# -- who is waited for ---


class Hanging:
    """A base policy whose answer comes when it is let go."""

    def __init__(self, policy):
        self.policy, self.go, self.asked = policy, threading.Event(), 0
        policy.select_action = self.select_action

    def select_action(self, batch):
        self.asked += 1
        self.go.wait()
        return torch.zeros(1, tiny.ACTION_DIM)


@pytest.fixture
def hanging(policy, tiny_diffusion):
    """The tiny filter around a base policy that hangs, while time passes as the test says."""
    base = BasePolicy.load(tiny_diffusion)
    hanging = Hanging(base.policy)
    policy.attach(base)
    policy.reset()
    policy.shield.time_left = lambda age_s, n: PERIOD
    policy.config.law.epsilon = -2.0
    yield policy, hanging
    hanging.go.set()


def seen():
    return {**tiny.observation([[-0.9, 0.1, 0.0]]), "task": ["drive"]}


def test_a_base_policy_that_hangs_is_waited_for_a_period_and_asked_again_when_it_has_ended(hanging):
    policy, base = hanging
    for _ in range(3):
        decision = policy.decide(seen())
        assert decision.reason.item() == Reason.DEADLINE_MISSED and decision.action.isfinite().all()
    assert base.asked == 1 and policy.shield.failures["the base policy was late"] == 3
    base.go.set()
    policy._in_time._last.result()
    policy.shield.time_left = lambda age_s, n: 60.0  # however busy the machine is
    assert policy.decide(seen()).reason.item() == Reason.PASSED and base.asked == 2


def test_an_episode_may_begin_while_the_base_policy_still_hangs(hanging):
    policy, base = hanging
    policy.decide(seen())
    policy.reset()
    assert policy.decide(seen()).reason.item() == Reason.BASE_POLICY_FAILED
    base.go.set()
    policy._in_time._last.result()
    policy.shield.time_left = lambda age_s, n: 60.0
    assert policy.decide(seen()).reason.item() == Reason.PASSED


@pytest.mark.parametrize("more", [{}, {"observation.language": torch.zeros(1000, 4)}, {"index": torch.zeros(9)}])
def test_a_period_is_for_each_robot_that_the_filter_sees(policy, tiny_diffusion, more):
    policy.attach(tiny_diffusion)
    policy.reset()
    asked = []
    policy.shield.time_left = lambda age_s, n: asked.append(n)
    policy.decide({**seen(), **more})
    assert asked == [1]


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode, torch.enable_grad])
def test_work_with_a_limit_finds_torch_as_whoever_asks(mode):
    def modes():
        return torch.is_grad_enabled(), torch.is_inference_mode_enabled(), torch.is_autocast_enabled("cpu")

    limit = TimeLimit()
    with mode():
        for mixed in (False, True):
            with torch.autocast("cpu", enabled=mixed):
                assert limit(modes, 60.0) == modes()
                assert limit(torch.get_num_threads, 60.0) == torch.get_num_threads()


@pytest.mark.parametrize("seconds", [60.0, math.inf, None])
@pytest.mark.parametrize(
    ("error", "raised"),
    [(ValueError, ValueError), (KeyboardInterrupt, KeyboardInterrupt), (TimeoutError, TimeoutError),
     (SystemExit, RuntimeError), (GeneratorExit, RuntimeError), (CancelledError, RuntimeError)],
)  # fmt: skip
def test_work_with_a_limit_ends_no_program_and_holds_no_interrupt_back(error, raised, seconds):
    def fail():
        raise error("no")

    with pytest.raises(raised):
        TimeLimit()(fail, seconds)


@pytest.mark.parametrize("seconds", [math.nan, -1.0, 0.0, -math.inf])
def test_of_a_time_that_is_none_nothing_is_waited_for(seconds):
    limit, over = TimeLimit(), threading.Event()
    with pytest.raises(TimeoutError):
        limit(over.wait, seconds)
    for further in (60.0, None):
        with pytest.raises(TimeoutError, match="not ended yet"):
            limit(over.wait, further)
    over.set()


def test_a_thread_ends_with_whoever_it_works_for():
    limit = TimeLimit()
    thread = limit(threading.current_thread, 60.0)
    del limit
    thread.join(60.0)
    assert not thread.is_alive()


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_in_a_forked_process_work_is_done_by_a_thread_of_its_own():
    limit, over = TimeLimit(), threading.Event()
    with pytest.raises(TimeoutError):
        limit(over.wait, 0.0)
    child = os.fork()
    if not child:
        os._exit(0 if limit(lambda: 3, 60.0) == 3 else 1)
    over.set()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
