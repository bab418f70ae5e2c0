"""A base policy that hangs, fails or gives something else: the robot gets a safe action in time, with its reason."""

import math
import threading
from asyncio import CancelledError
from collections import deque
from types import SimpleNamespace

import faulty
import numpy as np
import pytest
import torch
from faulty import STATE, row, stays

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.decision import Reason

UNKNOWN = SimpleNamespace(fps=None, action_names=None, state_names=None)
FAILED, LATE = Reason.BASE_POLICY_FAILED, Reason.DEADLINE_MISSED


class Pipeline:
    """Processors that change nothing."""

    steps = ()

    def __call__(self, given):
        return given

    def reset(self):
        pass


class Policy:
    """Wants the same at every tick.

    Args:
        act: observation -> what it gives instead.
    """

    name = "stand_in"

    def __init__(self, wanted, act=None):
        feature = SimpleNamespace(shape=tuple(wanted.shape[1:]))
        self.config = SimpleNamespace(type="stand_in", action_feature=feature, input_features={}, n_action_steps=6)
        self.wanted, self.act, self.told = wanted, act or (lambda batch: wanted.clone()), []

    def reset(self):
        self._queues = {STATE: deque(maxlen=1), "action": deque(maxlen=6)}

    def select_action(self, batch):
        return self.act(batch)

    def was_overridden(self, executed):
        self.told.append(executed)


def raises(error):
    def act(*_):
        raise error

    return act


@pytest.fixture(params=["car that forgets", "two cameras", "joint targets"])
def shielded(benches, request):
    """A bench's filter over a policy that wants what passes."""
    bench = benches[request.param]
    base = BasePolicy(
        Policy(bench.wanted),
        Pipeline(),
        Pipeline(),
        origin=UNKNOWN,
    )
    bench.begin()
    bench.policy._check_base(base, "stand-in")
    bench.policy._base, bench.policy._base_lost = [base], False
    bench.policy.reset()
    yield bench
    bench.policy._base = []


def stand_in(bench):
    return bench.policy.base.policy


def decide(bench, t):
    return bench.policy.decide(bench.see(t))


# -- what it gives, what it raises ---

GIVES = [
    stays("B04", "it gives a chunk of actions", lambda x: x[:, None].expand(-1, 8, -1), FAILED),
    stays("B05", "it gives the actions of one robot more, or of none", lambda x: torch.cat([x, x[:1]]), FAILED),
    stays("B05", "it gives the actions of one robot more, or of none", lambda x: x[:0], FAILED),
    stays("B06", "it gives an array, a list, a dictionary, nothing", lambda x: x.numpy(), FAILED),
    stays("B06", "it gives an array, a list, a dictionary, nothing", lambda x: x.tolist(), FAILED),
    stays("B06", "it gives an array, a list, a dictionary, nothing", lambda x: {"action": x}, FAILED),
    stays("B06", "it gives an array, a list, a dictionary, nothing", lambda x: None, FAILED),
    stays("B06", "its action lacks a number or is no row", lambda x: x[:, :-1], FAILED),
    stays("B06", "its action lacks a number or is no row", lambda x: x[0], FAILED),
    stays("B06", "its action is NaN", lambda x: x * math.nan, Reason.ACTION_NOT_FINITE),
    stays("B06", "its action is 1e9", lambda x: x + 1e9, Reason.ACTION_OUT_OF_RANGE),
]  # fmt: skip
RAISES = [
    stays("B08", "it raises, SystemExit too", raises(SystemExit(0)), FAILED),
    stays("B08", "it raises, SystemExit too", raises(GeneratorExit()), FAILED),
    stays("B08", "it raises, SystemExit too", raises(CancelledError()), FAILED),
    stays("B08", "it raises, SystemExit too", raises(RuntimeError("CUDA out of memory")), FAILED),
    stays("B08", "it raises, SystemExit too", raises(KeyError("observation.environment_state")), FAILED),
    stays("B08", "it raises, SystemExit too", raises(StopIteration()), FAILED),
    stays("B08", "it raises, SystemExit too", raises(AssertionError()), FAILED),
]  # fmt: skip


@pytest.mark.parametrize(("change", "reason"), GIVES)
def test_what_is_no_action_is_not_executed(shielded, change, reason):
    decide(shielded, 0)
    policy = stand_in(shielded)
    policy.act = lambda batch: change(shielded.wanted.clone())
    decision = decide(shielded, 1)
    assert decision.reason.eq(reason).all()
    shielded.assert_stays(decision)
    policy.act = lambda batch: shielded.wanted.clone()
    for t in (2, 3, 4):  # to come back from 1e9 is a jump
        decision = decide(shielded, t)
    assert decision.reason.eq(Reason.PASSED).all()


@pytest.mark.parametrize(("act", "reason"), RAISES)
def test_what_it_raises_does_not_get_out(shielded, act, reason, caplog):
    decide(shielded, 0)
    policy = stand_in(shielded)
    policy.act = act
    for t in (1, 2):
        decision = decide(shielded, t)
        assert decision.reason.eq(reason).all()
        shielded.assert_stays(decision)
    failures = shielded.shield.failures
    assert failures["the base policy failed"] == 2 and sum(bool(record.exc_info) for record in caplog.records) == 1
    policy.act = lambda batch: shielded.wanted.clone()
    assert decide(shielded, 3).reason.eq(Reason.PASSED).all()


@faulty.fault("B08", "somebody presses Ctrl-C", "The program ends, as it should")
@pytest.mark.parametrize("method", ["select_action", "was_overridden"])
def test_an_interrupt_is_not_held_back(shielded, method):
    setattr(stand_in(shielded), method, raises(KeyboardInterrupt()))
    shielded.policy.config.law.epsilon = faulty.PASSES_NOTHING
    with pytest.raises(KeyboardInterrupt):
        decide(shielded, 0)


PLANS = {
    "nothing": lambda x: None,
    "words": lambda x: "left",
    "single actions": lambda x: x[0],
    "actions of more numbers": lambda x: torch.cat([x, x], 1),
    "actions of more robots": lambda x: torch.cat([x, x]),
    "complex numbers": lambda x: x.to(torch.complex64),
}


@faulty.fault("B04", "what it plans is no chunk of actions", "Each action is judged when it is due, and that is said")
@pytest.mark.parametrize("plan", PLANS)
def test_plans_that_are_no_actions_hold_nothing_up(shielded, plan, caplog):
    decide(shielded, 0)
    policy = stand_in(shielded)

    def act(batch):
        policy._queues["action"].extend([PLANS[plan](shielded.wanted)] * 3)
        return shielded.wanted.clone()

    policy.act = act
    for t in (1, 2):
        assert decide(shielded, t).reason.eq(Reason.PASSED).all()
    assert caplog.text.count("cannot be read") == 1


class Raising(torch.Tensor):
    """A tensor with which nothing can be done."""

    @classmethod
    def __torch_function__(cls, *_, **__):
        raise RuntimeError("no")


@faulty.fault("B06", "its action is a tensor with which nothing can be done", "The robot stays: `BASE_POLICY_FAILED`")
def test_an_action_with_which_nothing_can_be_done_is_none(shielded):
    decide(shielded, 0)
    stand_in(shielded).act = lambda batch: shielded.wanted.clone().as_subclass(Raising)
    decision = decide(shielded, 1)
    assert decision.reason.eq(FAILED).all()
    shielded.assert_stays(decision)


@faulty.fault("B18", "it changes what it proposed afterwards", "What was judged counts")
def test_what_it_does_to_its_action_afterwards_changes_nothing(shielded):
    action = shielded.wanted.clone()
    stand_in(shielded).act = lambda batch: action
    decision = decide(shielded, 0)
    action.fill_(math.nan)
    torch.testing.assert_close(decision.proposed, shielded.wanted)
    torch.testing.assert_close(decision.action, shielded.wanted)


# -- planning anew ---

REPLANNED = "The robot gets the fallback's action; the policy is asked nothing until it could plan anew"
REPLANS = [
    row("B17", "it fails while it plans anew after an override", error, outcome=REPLANNED)
    for error in (RuntimeError("no plan"), SystemExit(1), GeneratorExit(), AttributeError("no queue"))
]


@pytest.mark.parametrize("error", REPLANS)
def test_a_failure_while_planning_anew_keeps_no_decision_back(shielded, error):
    decide(shielded, 0)
    policy, asked = stand_in(shielded), []
    policy.was_overridden = policy.reset = raises(error)
    shielded.policy.config.law.epsilon = faulty.PASSES_NOTHING
    assert decide(shielded, 1).intervened.all()
    shielded.policy.config.law.epsilon = faulty.PASSES_ALL
    policy.act = lambda batch: asked.append(1) or shielded.wanted.clone()
    decision = decide(shielded, 2)
    assert decision.reason.eq(FAILED).all() and not asked
    np.testing.assert_array_equal(decision.action, shielded.shield.guard.stay)
    del policy.was_overridden, policy.reset
    assert decide(shielded, 3).reason.eq(Reason.PASSED).all() and asked


@faulty.fault(
    "B17",
    "it hangs while it plans anew after an override",
    "The robot gets the fallback's action within a period; the policy is asked again when it is back",
)
def test_a_policy_that_hangs_while_it_plans_anew_holds_nothing_up(shielded):
    decide(shielded, 0)
    policy, shield, over = stand_in(shielded), shielded.shield, threading.Event()
    policy.was_overridden = lambda executed: over.wait(60.0)
    shield.patience = lambda n=1: 0.02 if shield.decision.intervened.any() else 60.0
    shielded.policy.config.law.epsilon = faulty.PASSES_NOTHING
    assert decide(shielded, 1).intervened.all()
    del shield.patience
    shielded.policy.config.law.epsilon = faulty.PASSES_ALL
    assert decide(shielded, 2).reason.eq(FAILED).all()
    over.set()
    shielded.policy._in_time._last.result(60.0)
    assert decide(shielded, 3).reason.eq(Reason.PASSED).all()


# -- what it does to the observation ---


def spoil(batch):
    for value in batch.values():
        value.uniform_(-1, 2)


@faulty.fault("B18", "it changes the observation in place", "The filter judges what the robot showed")
def test_what_it_does_to_the_observation_is_not_judged(shielded):
    policy = stand_in(shielded)
    expected = [decide(shielded, t).value for t in (0, 1)]
    shielded.begin()
    shielded.policy.reset()
    policy.act = lambda batch: spoil(batch) or shielded.wanted.clone()
    for t, value in enumerate(expected):
        observation = shielded.see(t)
        torch.testing.assert_close(shielded.policy.decide(observation).value, value)
        for key, kept in shielded.see(t).items():
            torch.testing.assert_close(observation[key], kept)


# -- in time ---


@pytest.fixture
def hanging(shielded):
    """A policy that hangs until the test ends, and a shield whose clock is the test's."""
    over = threading.Event()
    stand_in(shielded).act = lambda batch: over.wait(60.0) and shielded.wanted.clone()
    times = [0.0]
    shielded.shield.clock = lambda: times[0]
    shielded.policy._in_time.__init__("cpu")
    shielded.shield.time_left = lambda age_s, n: 0.02
    yield shielded, over, times
    over.set()
    shielded.policy._in_time.__init__("cpu")


@faulty.fault(
    "B11",
    "a base policy hangs for seconds",
    "The robot stays within a period: `DEADLINE_MISSED`; the policy is asked again when it is back",
)
@faulty.fault("B12", "a base policy hangs, and a deadline is set", "The robot stays within a period: `DEADLINE_MISSED`")
@pytest.mark.parametrize("deadline_ms", [None, 50.0])
def test_a_policy_that_hangs_holds_nothing_up(hanging, deadline_ms):
    shielded, over, times = hanging
    shielded.policy.config.law.deadline_ms = deadline_ms
    try:
        for t in range(3):
            times[0] = t / 30
            decision = decide(shielded, t)
            assert decision.reason.eq(LATE).all()
            shielded.assert_stays(decision) if t else None
        over.set()
        shielded.policy._in_time._last.result(60.0)
        del shielded.shield.time_left
        shielded.shield.clock = faulty.standing_still
        shielded.shield.pace.forget()
        decision = decide(shielded, 3)
    finally:
        shielded.policy.config.law.deadline_ms = None
    assert decision.reason.eq(Reason.PASSED).all()


@faulty.fault(
    "B11",
    "a base policy takes seconds, and then gives an action",
    "The robot stays: `DEADLINE_MISSED`, for what it wants is of an old picture",
)
@pytest.mark.parametrize("deadline_ms", [None, 5000.0])
def test_the_time_that_it_took_counts(shielded, deadline_ms):
    times = [0.0]
    shielded.shield.clock = lambda: times[0]

    def slow(batch):
        times[0] += 0.5
        return shielded.wanted.clone()

    shielded.shield.time_left = lambda age_s, n: 60.0  # it is in time for nobody but the shield
    stand_in(shielded).act = slow
    shielded.policy.config.law.deadline_ms = deadline_ms
    try:
        decision = decide(shielded, 0)
    finally:
        shielded.policy.config.law.deadline_ms = None
        del shielded.shield.time_left
    assert decision.intervened.all() and not decision.reason.eq(Reason.PASSED).any()


# -- chunks that are made ahead ---


class Chunks(Policy):
    """Plans six actions of what is wanted, as LeRobot's policies do."""

    def select_action(self, batch):
        if not self._queues["action"]:
            self._queues["action"].extend(self.predict_action_chunk(batch).unbind(1))
        return self._queues["action"].popleft()

    def predict_action_chunk(self, batch):
        return self.act(batch)[:, None].expand(-1, 6, -1)


def ahead(bench, act=None):
    """The bench's filter over a policy whose chunks are made in a thread of their own."""
    policy = Chunks(bench.wanted, act)
    policy.reset()
    bench.policy._base = [BasePolicy(policy, Pipeline(), Pipeline(), 2, origin=UNKNOWN)]
    bench.policy.reset()
    return policy


@faulty.fault("B13", "the thread that makes chunks ahead hangs", "The robot stays within a period: `DEADLINE_MISSED`")
def test_a_thread_that_hangs_holds_nothing_up(hanging):
    shielded, over, times = hanging
    ahead(shielded, lambda batch: over.wait(60.0) and shielded.wanted.clone())
    for t in range(4):
        times[0] = t / 30
        decision = decide(shielded, t)
        assert decision.reason.eq(LATE).all() and decision.intervened.all()


@faulty.fault("B15", "the thread that makes chunks ahead raises, SystemExit too", f"The robot stays: `{FAILED.name}`")
@pytest.mark.parametrize("error", [SystemExit(0), RuntimeError("cannot schedule new futures after shutdown")])
def test_what_the_thread_raises_does_not_get_out(shielded, error):
    policy = ahead(shielded, raises(error))
    decision = decide(shielded, 0)
    assert decision.reason.eq(FAILED).all() and decision.intervened.all()
    policy.act = lambda batch: shielded.wanted.clone()
    for t in (1, 2, 3):  # a chunk that had been begun before may still fail
        decision = decide(shielded, t)
    assert decision.reason.eq(Reason.PASSED).all()


# -- whose numbers are whose ---


@faulty.fault(
    "B21", "its actions are in another order, and its data are here", "They are put in order, and that is said"
)
def test_actions_in_another_order_are_put_in_order(benches, caplog):
    bench = benches["car"].begin()
    names = bench.policy.config.trained_on.action_names
    turned = Policy(bench.wanted.flip(1))
    origin = SimpleNamespace(fps=None, action_names=names[::-1], state_names=None)
    base = BasePolicy(turned, Pipeline(), Pipeline(), origin=origin)
    base.speak(names, None)
    torch.testing.assert_close(base.propose(bench.see(0)), bench.wanted)
    assert "in another order" in caplog.text


# -- what never changes ---


@pytest.fixture(scope="module")
def watchful(tmp_path_factory):
    """An arm of two cameras whose data tell how far commands go before the state answers."""
    return faulty.franka_bench(tmp_path_factory.mktemp("watchful") / "filter", unanswered=[0.01] * 7)


@faulty.fault("B20", "the very same observation at every tick", "The robot goes no further: `OBSERVATION_STALE`")
@pytest.mark.parametrize("through", ["policy", "shield"])
def test_a_robot_whose_observation_never_changes_goes_no_further(watchful, through):
    watchful.begin()
    policy, seen, reasons = watchful.policy, watchful.see(0), []
    policy._base = [BasePolicy(Policy(watchful.wanted), Pipeline(), Pipeline(), origin=UNKNOWN)]
    for _ in range(30):
        decision = policy.decide(seen) if through == "policy" else watchful.shield(seen, watchful.wanted)
        reasons.append(decision.reason.item())
    assert reasons[0] == Reason.PASSED and set(reasons[10:]) == {Reason.OBSERVATION_STALE}
    watchful.assert_stays(decision)
