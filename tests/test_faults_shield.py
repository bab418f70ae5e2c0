"""What robots show and are told: what is broken, foreign, old or absurd never counts as safe, at whichever tick."""

import pytest
import torch
from faulty import BENCHES, FRONT, IMAGE, STATE, WRIST, row, stays

from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.evaluation.faults import EMPTY, FAULTS, PICTURES, first, shown
from lerobot_latentsafe.guard import UnknownPoseError


def state(change):
    return shown(change, STATE)


OUT, MALFORMED, NOT_FINITE = (
    Reason.OBSERVATION_OUT_OF_RANGE,
    Reason.OBSERVATION_MALFORMED,
    Reason.OBSERVATION_NOT_FINITE,
)
MISSING, NO_ACTION, STALE = Reason.OBSERVATION_MISSING, Reason.BASE_POLICY_FAILED, Reason.OBSERVATION_STALE

OF_STATES = [
    stays("S18b", "a joint reads 1,000 rad", state(first(lambda x: torch.full_like(x, 1000.0))), OUT),
    stays("S18b", "a joint reads a million more than is", FAULTS["a joint beyond all that was seen"], OUT),
    stays("S18b", "the state is a hundred standard deviations off", FAULTS["a hundred standard deviations"], OUT),
    stays("S18d", "a joint reads 1e30", FAULTS["a joint of 1e30"], OUT),
    stays("S18d", "a joint reads infinity", FAULTS["a joint that is infinite"], NOT_FINITE),
    stays("S18d", "a joint reads NaN", FAULTS["a joint that is no number"], NOT_FINITE),
    stays("S18i", "a heading of (1e4, 1e4)", state(lambda x: x * 0 + 1e4), OUT),
    stays("S18b", "a joint leaps by 90 at once", FAULTS["a joint that leaps by 90 degrees"], OUT),
    stays("S19", "a state of shape (1, 1)", FAULTS["a state that is one number"], MALFORMED),
    stays("S20", "a state that lacks a number", FAULTS["a state that lacks a number"], MALFORMED),
    stays("S20", "a state of one number more", FAULTS["a state of one number more"], MALFORMED),
    stays("S20", "a state without a batch", FAULTS["a state without a batch"], MALFORMED),
    stays("S20", "a state of truth values, of complex numbers", FAULTS["a state of truth values"], MALFORMED),
    stays("S20", "a state of truth values, of complex numbers", FAULTS["a state of complex numbers"], MALFORMED),
    stays("S20", "a state that is sparse, or has no data", FAULTS["a state that is sparse"], MALFORMED),
    stays("S20", "a state that is sparse, or has no data", FAULTS["a state without data"], MALFORMED),
    stays("S20", "a state that is a list or a word", FAULTS["a state that is a list"], MALFORMED),
    stays("S20", "a state that is a list or a word", FAULTS["a state in words"], MALFORMED),
    stays("S11", "no state in an observation", FAULTS["no state"], MISSING),
]  # fmt: skip
CAPS = ("a lens cap", "a lens cap and a noisy sensor")
OF_PICTURES = [
    stays("S11", "no camera in an observation", FAULTS["no picture"], MISSING),
    stays("S05", "a camera shows one grey, black or white", FAULTS["a dead camera"], MISSING),
    stays("S05", "a camera shows one grey, black or white", FAULTS["a black picture"], MISSING),
    stays("S05", "a camera shows one grey, black or white", FAULTS["a white picture"], MISSING),
    *(stays("S04", "a lens cap, with 2 or 10 grey levels of noise", shown(EMPTY[name]), MISSING) for name in CAPS),
    *(stays("S05", "a camera shows one colour", shown(EMPTY[name]), MISSING) for name in EMPTY if name not in CAPS),
    stays("S67", "a pixel is NaN or infinite", FAULTS["a pixel that is no number"], NOT_FINITE),
    stays("S67", "a pixel is NaN or infinite", FAULTS["a picture of infinity"], NOT_FINITE),
    stays("S67", "pixels beyond [0, 1]: 0 to 255, 1e30, below zero", FAULTS["a picture of 1e30"], MALFORMED),
    stays("S67", "pixels beyond [0, 1]: 0 to 255, 1e30, below zero", FAULTS["a picture in 0 to 255"], MALFORMED),
    stays("S67", "pixels beyond [0, 1]: 0 to 255, 1e30, below zero", FAULTS["a picture below zero"], MALFORMED),
    stays("S67", "a picture in bytes", FAULTS["a picture in bytes"], MALFORMED),
    stays("S67", "one channel, four, or channels last", FAULTS["a grey picture"], MALFORMED),
    stays("S67", "one channel, four, or channels last", FAULTS["a picture with an alpha channel"], MALFORMED),
    stays("S67", "one channel, four, or channels last", FAULTS["a picture of channels last"], MALFORMED),
    stays("S67", "a picture without a batch, without pixels", FAULTS["a picture without a batch"], MALFORMED),
    stays("S67", "a picture without a batch, without pixels", FAULTS["a picture without pixels"], MALFORMED),
    stays("S67", "a picture of other proportions", FAULTS["a picture of other proportions"], MALFORMED),
    stays("S67", "a picture that is sparse, or has no data", FAULTS["a picture that is sparse"], MALFORMED),
    stays("S67", "a picture that is sparse, or has no data", FAULTS["a picture without data"], MALFORMED),
    stays("S67", "an array or a path in place of a picture", FAULTS["a picture that is an array"], MALFORMED),
    stays("S67", "an array or a path in place of a picture", FAULTS["a picture that is a path"], MALFORMED),
]  # fmt: skip
OF_ACTIONS = [
    stays("S28", "an action that lacks a number, or has one more", FAULTS["a proposal that lacks a number"], NO_ACTION),
    stays("S28", "an action that lacks a number, or has one more", FAULTS["a proposal of one number more"], NO_ACTION),
    stays("S29", "an action without a batch", FAULTS["a proposal without a batch"], NO_ACTION),
    stays("B04", "a chunk in place of an action", FAULTS["a chunk"], NO_ACTION),
    stays("B05", "actions of one robot more", FAULTS["a proposal of one robot more"], NO_ACTION),
    stays("B06", "an array or a list in place of an action", FAULTS["a proposal that is an array"], NO_ACTION),
    stays("B06", "an array or a list in place of an action", FAULTS["a proposal that is a list"], NO_ACTION),
    stays("B06", "an action of complex numbers", FAULTS["a proposal of complex numbers"], NO_ACTION),
    stays("B06", "an action that is sparse or quantized", FAULTS["a proposal that is sparse"], NO_ACTION),
    stays("B06", "an action that is sparse or quantized", FAULTS["a proposal that is quantized"], NO_ACTION),
    stays("B06", "no action at all", FAULTS["a base policy that failed"], NO_ACTION),
    stays("S28", "an action of 1e9", FAULTS["a proposal of 1e9"], Reason.ACTION_OUT_OF_RANGE),
    stays("S28", "an action that jumps", FAULTS["a proposal that jumps"], Reason.ACTION_OUT_OF_RANGE),
    stays("S28", "an action that is NaN or infinite", FAULTS["a proposal that is no number"], Reason.ACTION_NOT_FINITE),
    stays("S28", "an action that is NaN or infinite", FAULTS["a proposal that is infinite"], Reason.ACTION_NOT_FINITE),
]  # fmt: skip
OF_TIME = [
    stays("S40", "an observation a second old", FAULTS["an old observation"], Reason.OBSERVATION_STALE),
    stays("S38", "an observation of no known age", FAULTS["an observation of no known age"], Reason.OBSERVATION_STALE),
    stays("S38", "an observation of no known age", FAULTS["an observation of infinite age"], Reason.OBSERVATION_STALE),
    stays("S38", "an observation of the future", FAULTS["an observation of the future"], Reason.OBSERVATION_STALE),
    stays("S58", "a loop of another rate", FAULTS["a loop of another rate"], Reason.WRONG_RATE),
]  # fmt: skip
INCOMING = [*OF_STATES, *OF_PICTURES, *OF_ACTIONS, *OF_TIME]
UNUSABLE = {entry.values[0] for entry in OF_STATES}
"""Faults after which nobody knows where a robot is."""
UNLIKE_BEFORE = {FAULTS["a joint that leaps by 90 degrees"]}
"""Faults that are none in a first observation."""


# -- what comes in ---


@pytest.mark.parametrize("bench", BENCHES[1:], indirect=True)
@pytest.mark.parametrize(("inject", "reason"), INCOMING)
def test_robots_stay_while_it_lasts_and_go_on_afterwards(bench, inject, reason):
    bench.begin(1)
    for t in (1, 2):
        decision = bench.decide(t, inject)
        assert decision.reason.eq(reason).all()
        bench.assert_stays(decision)
    for t in (3, 4, 5):  # the next reading may be more than a step of the data from the last one
        after = bench.decide(t)
    assert after.reason.eq(Reason.PASSED).all() and after.value.isfinite().all()


@pytest.mark.parametrize("bench", BENCHES[1:], indirect=True)
@pytest.mark.parametrize(("inject", "reason"), [entry for entry in INCOMING if entry.values[0] not in UNLIKE_BEFORE])
def test_at_the_very_first_observation_it_is_refused_or_not_safe(bench, inject, reason):
    bench.begin()
    try:
        decision = bench.decide(0, inject)
    except (KeyError, ValueError) as e:
        assert reason == (MISSING if isinstance(e, KeyError) else MALFORMED) and len(str(e)) > 40
    except UnknownPoseError:
        assert bench.targets and inject in UNUSABLE
    else:
        assert decision.reason.eq(reason).all() and decision.intervened.all() and decision.action.isfinite().all()


ROWS = [entry for entry in INCOMING if entry.values[1] not in (MALFORMED, MISSING, NO_ACTION, Reason.WRONG_RATE, STALE)]


@pytest.mark.parametrize(("inject", "reason"), ROWS)
def test_one_robot_of_a_batch_does_not_disturb_the_others(benches, inject, reason):
    bench = benches["car"].begin(1)
    healthy = bench.decide(1)
    bench.begin(1)
    given = bench.given(1)
    broken = inject(bench.given(1))
    for key, value in broken["observation"].items():
        given["observation"][key][1] = value[1]
    given["proposed"][1] = broken["proposed"][1]
    decision = bench.shield(**given)
    assert decision.reason.tolist() == [Reason.PASSED, reason, Reason.PASSED]
    assert decision.intervened.tolist() == [False, True, False]
    for name in ("action", "value", "margin"):
        torch.testing.assert_close(getattr(decision, name)[[0, 2]], getattr(healthy, name)[[0, 2]])


@pytest.mark.parametrize(("change", "reason"), [(PICTURES[name], reason) for name, reason in (
    ("a dead camera", MISSING), ("no picture", MISSING), ("a pixel that is no number", NOT_FINITE),
    ("a grey picture", MALFORMED), ("a picture in 0 to 255", MALFORMED),
)])  # fmt: skip
@pytest.mark.parametrize("key", [FRONT, WRIST])
def test_each_camera_counts(benches, key, change, reason):
    bench = benches["two cameras"].begin(1)
    decision = bench.decide(1, shown(change, key))
    assert decision.reason.item() == reason
    bench.assert_stays(decision)


# -- how many robots ---

COUNTS = [
    row("S57b", "pictures of three robots, a state of one", STATE, 1, outcome=f"The robots stay: `{MALFORMED.name}`"),
    row("S57c", "a picture of one robot, states of three", IMAGE, 1, outcome=f"The robots stay: `{MALFORMED.name}`"),
    row("S57c", "pictures of two robots, states of three", IMAGE, 2, outcome=f"The robots stay: `{MALFORMED.name}`"),
]  # fmt: skip


@pytest.mark.parametrize(("key", "n"), COUNTS)
def test_inputs_of_other_robots_are_never_spread_over_all(benches, key, n):
    bench = benches["car"].begin(1)
    decision = bench.decide(1, shown(lambda x: x[:n], key))
    assert decision.reason.eq(MALFORMED).all()
    bench.assert_stays(decision)
    with pytest.raises(ValueError, match=r"is of \d robots, expected"):
        bench.begin().decide(0, shown(lambda x: x[:n], key))
