"""Filters that fail, are late or are set so that they protect nothing: nothing passes for that, and robots stay."""

import math
import threading

import faulty
import numpy as np
import pytest
import torch
from faulty import IMAGE, STATE, row, stays

from lerobot_latentsafe.decision import LawConfig, Reason
from lerobot_latentsafe.evaluation.faults import BROKEN, replaced, shown, wild

# -- what decides ---


def ends(error):
    """A fault of the world model that would end the program."""

    def end(*_):
        raise error

    return lambda shield: replaced(shield.model.world_model, "step", end)


LATE, NO_NUMBER, FAILED = Reason.DEADLINE_MISSED, Reason.VALUE_NOT_FINITE, Reason.FILTER_FAILED
DECIDING = [
    stays("S38", "a clock that returns NaN", BROKEN["a clock that tells nothing"], LATE),
    stays("S40", "a decision takes half a second, and no deadline is set", BROKEN["a decision that is late"], LATE),
    stays("S42", "the critic's Q is infinite", BROKEN["a value that is infinite"], NO_NUMBER),
    stays("S42", "the critic's weights are NaN or infinite", BROKEN["a critic of no numbers"], NO_NUMBER),
    stays("S42", "the critic's weights are NaN or infinite", BROKEN["a critic of infinite numbers"], NO_NUMBER),
    stays("S42", "the margin is infinite, or 1e30", BROKEN["a margin that is infinite"], NO_NUMBER),
    stays("S42", "the margin is infinite, or 1e30", BROKEN["a margin of 1e30"], NO_NUMBER),
    stays("S49", "the world model raises", BROKEN["a world model that raises"], FAILED),
    stays("S49", "the world model raises", BROKEN["a world model that cannot correct"], FAILED),
    stays("S49", "the world model wants to end the program", ends(SystemExit(0)), FAILED),
    stays("S49", "the world model wants to end the program", ends(GeneratorExit()), FAILED),
    stays("S49", "the margin or the critic raises", BROKEN["a margin that raises"], FAILED),
    stays("S49", "the margin or the critic raises", BROKEN["a critic that raises"], FAILED),
    stays("S50", "the encoder raises", BROKEN["an encoder that raises"], FAILED),
    stays("S52", "the encoder gives numbers of 1e20", BROKEN["an encoder of absurd numbers"], FAILED),
]


@pytest.mark.parametrize(("broken", "reason"), DECIDING)
def test_robots_stay_while_the_filter_is_broken_and_go_on_afterwards(bench, broken, reason):
    bench.begin(1)
    with broken(bench.shield):
        for t in (1, 2):
            decision = bench.decide(t)
            assert decision.reason.eq(reason).all()
            bench.assert_stays(decision)
    bench.shield.pace.forget()  # its clock is another now
    for t in (3, 4):
        after = bench.decide(t)
    assert after.reason.eq(Reason.PASSED).all() and after.value.isfinite().all()


@faulty.fault(
    "S54",
    "the fallback asks for five times the robot's largest motion",
    "The robot stays; the range holds for the fallback, too",
)
def test_a_fallback_out_of_range_is_not_executed(bench):
    bench.begin(1)
    bench.policy.config.law.epsilon = faulty.PASSES_NOTHING
    low, high = bench.policy.model.units.action_low, bench.policy.model.units.action_high
    with wild(bench.shield):
        for t in (1, 2):
            decision = bench.decide(t)
            assert decision.intervened.all()
            assert ((decision.action >= low) & (decision.action <= high)).all()


@pytest.mark.parametrize("spoil", [math.nan, 1e20])
@faulty.fault(
    "S55b", "one tick spoils what a filter remembers", "The robot stays in that tick, and goes on in the next"
)
def test_one_bad_tick_does_not_poison_an_episode(bench, spoil):
    bench.begin(2)
    belief = bench.shield.beliefs[-1]
    for latent in (belief.latent, belief.younger):
        for tensor in (latent or {}).values():
            tensor.fill_(spoil)
    for t in (2, 3):
        after = bench.decide(t)
    assert after.reason.eq(Reason.PASSED).all() and after.value.isfinite().all()


@faulty.fault(
    "R43b",
    "what was decided is changed in place before it is used",
    "It is judged again, and what the robot was told is what was decided",
)
def test_what_was_decided_is_not_what_its_user_makes_of_it(bench):
    seen = bench.begin(1).see(1)
    decision = bench.shield(seen, bench.wanted.clone())
    assert bench.shield._decided(seen, decision.action)
    told = bench.shield.guard.told.copy()
    decision.action.add_(1.0)
    np.testing.assert_array_equal(bench.shield.guard.told, told)
    assert not bench.shield._decided(seen, decision.action)


# -- time ---


def ticking(*times):
    """A clock that shows these times, and then the last one."""
    left = list(times)
    return lambda: left.pop(0) if len(left) > 1 else left[0]


@faulty.fault("S40", "a decision takes ten seconds, with no deadline set", "The robot stays: `DEADLINE_MISSED`")
@pytest.mark.parametrize("took", [0.2, 10.0, math.inf, -1.0])
def test_a_late_decision_does_not_pass_though_no_deadline_is_set(bench, took):
    bench.begin(clock=ticking(0.0, took))
    assert bench.policy.config.law.deadline_ms is None
    decision = bench.decide(0)
    assert decision.reason.eq(Reason.DEADLINE_MISSED).all()


@faulty.fault(
    "B13",
    "the world model itself hangs",
    "The robot stays within a period: `DEADLINE_MISSED`; once it is back, the filter goes on with what it sees",
)
@pytest.mark.parametrize("part", ["perceive", "step", "correct", "features"])
def test_a_world_model_that_hangs_holds_nothing_up(bench, part):
    bench.begin(2)
    shield, over = bench.shield, threading.Event()
    work = getattr(shield.model.world_model, part)
    with replaced(shield.model.world_model, part, lambda *given: over.wait(60.0) and work(*given)):
        shield.patience = lambda n=1: 0.02
        for t in (2, 3, 4):
            decision = bench.decide(t)
            assert decision.reason.eq(LATE).all()
            bench.assert_stays(decision)
        over.set()
        shield._in_time._last.result(60.0)
    del shield.patience
    after = bench.decide(5)
    assert after.reason.eq(Reason.PASSED).all() and after.value.isfinite().all() and shield.beliefs[-1].n_frames == 1


def test_in_time_or_in_a_simulation_a_filter_decides_alike(bench):
    bench.begin()
    waiting = [bench.decide(t).value for t in range(3)]
    bench.begin().shield.patience = lambda n=1: 60.0
    for t, value in enumerate(waiting):
        torch.testing.assert_close(bench.decide(t).value, value, rtol=0, atol=0)


@faulty.fault(
    "S39", "a deadline that is NaN", "Refused when it is set; where it is set all the same, no decision is in time"
)
def test_a_deadline_that_is_no_number_is_refused_and_never_met(bench):
    with pytest.raises(ValueError, match=r"law.deadline_ms is nan; expected milliseconds"):
        LawConfig(deadline_ms=math.nan)
    bench.begin()
    bench.policy.config.law.deadline_ms = math.nan
    try:
        assert not bench.decide(0).reason.eq(Reason.PASSED).any()
    finally:
        bench.policy.config.law.deadline_ms = None


@faulty.fault("S58", "a new episode begins after a pause, and nobody called reset()", "The history starts anew")
@pytest.mark.parametrize("gap", [10.0, 1.5, -5.0])
def test_after_a_pause_nothing_of_before_is_remembered(bench, gap):
    fresh = bench.begin().decide(3)
    bench.begin(clock=ticking(0.0, 0.0, 0.0 + gap))
    bench.decide(0)
    torch.testing.assert_close(bench.decide(3).value, fresh.value)


# -- settings ---

SHOUTED = "Warned of at every start: `THIS FILTER DOES NOT ACT BY WHAT IT SEES`"
NEVER, ALWAYS = "V is never that low: no value makes it act", "it always acts"
DISARMED = [
    row("S60", "epsilon is NaN", "epsilon", math.nan, None, outcome="Refused (`ValueError`), with what was expected"),
    row("S60", "epsilon is -2 or -infinity", "epsilon", -2.0, NEVER, outcome=SHOUTED),
    row("S60", "epsilon is -2 or -infinity", "epsilon", -math.inf, NEVER, outcome=SHOUTED),
    row("C16", "config.json says that epsilon is -1e9", "epsilon", -1e9, NEVER, outcome=SHOUTED),
    row("S60", "epsilon is 2 or infinity", "epsilon", 2.0, ALWAYS, outcome=SHOUTED),
    row("S60", "epsilon is 2 or infinity", "epsilon", math.inf, ALWAYS, outcome=SHOUTED),
    row("S60", "slack_ms is a second or more", "slack_ms", 1e3, "counts as fresh", outcome=SHOUTED),
    row("S60", "slack_ms is a second or more", "slack_ms", 1e300, "counts as fresh", outcome=SHOUTED),
]


@pytest.mark.parametrize(("name", "value", "warning"), DISARMED)
def test_a_setting_that_disarms_is_refused_or_shouted(benches, monkeypatch, name, value, warning, caplog):
    if warning is None:
        with pytest.raises(ValueError, match=r"law.epsilon is nan; expected a number"):
            LawConfig(**{name: value})
        return
    policy = benches["car"].begin().policy
    monkeypatch.setattr(policy.config.law, "epsilon", 0.0)
    monkeypatch.setattr(policy.config.law, name, value)
    policy.decide(benches["car"].see(0))
    assert "THIS FILTER DOES NOT ACT BY WHAT IT SEES" in caplog.text and warning in caplog.text


@pytest.mark.parametrize(("name", "wrong"), [
    ("deadline_ms", 0.0), ("deadline_ms", -5.0), ("slack_ms", math.nan), ("slack_ms", -1.0), ("slack_ms", math.inf),
    ("mode", "off"), ("name", "none"), ("lookahead", -1), ("proposal_steps", 0), ("samples", -1), ("resume_above", 1.0),
])  # fmt: skip
@faulty.fault("S60", "another setting of the law that is none", "Refused (`ValueError`), with what was expected")
def test_settings_that_are_none_are_refused(name, wrong):
    with pytest.raises(ValueError, match=rf"law.{name} is .*; expected "):
        LawConfig(**{name: wrong})


# -- numbers in other types ---

TYPES = [
    ({IMAGE: torch.float16, STATE: torch.float64}, 2e-3), ({IMAGE: torch.bfloat16}, 2e-2),
    ({IMAGE: torch.float64, STATE: torch.float16}, 2e-3), ({STATE: torch.bfloat16}, 2e-2),
]  # fmt: skip


@faulty.fault("S67", "numbers of half or double precision, or with gradients", "Decided like those of single precision")
@pytest.mark.parametrize(("types", "tolerance"), TYPES)
def test_numbers_of_other_precision_decide_alike(benches, types, tolerance):
    bench = benches["car of continuous actions"]
    expected = bench.begin().decide(0)
    given = bench.begin().given(0)
    for key, kind in types.items():
        given["observation"][key] = given["observation"][key].to(kind).requires_grad_()
    with torch.enable_grad():
        decision = bench.shield(**given)
    assert not decision.value.requires_grad and decision.value.dtype == torch.float32
    torch.testing.assert_close(decision.value, expected.value, atol=tolerance, rtol=tolerance)


@faulty.fault("S67", "a state of whole numbers", "Decided on the numbers that it holds")
def test_a_state_of_whole_numbers_is_read_as_it_stands(benches):
    bench = benches["car"]
    whole = shown(lambda x: torch.ones_like(x), STATE)
    expected = bench.begin().decide(0, whole).value
    for kind in (torch.int64, torch.int32, torch.uint8):
        as_kind = shown(lambda x, kind=kind: torch.ones_like(x, dtype=kind), STATE)
        torch.testing.assert_close(bench.begin().decide(0, as_kind).value, expected)
