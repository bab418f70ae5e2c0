import math

import numpy as np
import pytest
import torch

from lerobot_latentsafe.decision import Reason, least_restrictive

PROPOSED, FALLBACK = np.float32([[0.5, 1.0]]), np.float32([[-1.0, 1.0]])


def decide(value, epsilon=0.1, fault=None, monitor=False):
    fault = None if fault is None else np.array([fault])
    return least_restrictive(
        PROPOSED, FALLBACK, np.float32([value]), np.float32([0.3]), epsilon, fault=fault, monitor=monitor
    )


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (0.2, Reason.PASSED),
        (0.1 + 1e-6, Reason.PASSED),
        (0.1, Reason.UNSAFE_VALUE),
        (0.0, Reason.UNSAFE_VALUE),
        (-5.0, Reason.UNSAFE_VALUE),
        (math.nan, Reason.VALUE_NOT_FINITE),
        (math.inf, Reason.VALUE_NOT_FINITE),
        (-math.inf, Reason.VALUE_NOT_FINITE),
    ],
)
@pytest.mark.parametrize("monitor", [False, True])
def test_truth_table(value, reason, monitor):
    decision = decide(value, monitor=monitor)
    assert decision.reason.item() == reason
    assert decision.unsafe.item() == (reason != Reason.PASSED)
    assert decision.intervened.item() == (reason != Reason.PASSED and not monitor)
    np.testing.assert_array_equal(decision.action, FALLBACK if decision.intervened else PROPOSED)
    np.testing.assert_array_equal(decision.proposed, PROPOSED)


@pytest.mark.parametrize("fault", [r for r in Reason if r != Reason.PASSED])
@pytest.mark.parametrize("value", [1.0, -1.0, math.nan])
def test_a_fault_falls_back_whatever_the_value(fault, value):
    decision = decide(value, fault=fault)
    assert decision.intervened and decision.reason.item() == fault
    np.testing.assert_array_equal(decision.action, FALLBACK)


def test_no_fault_leaves_the_verdict_to_the_value():
    assert decide(0.2, fault=Reason.PASSED).reason.item() == Reason.PASSED
    assert decide(0.0, fault=Reason.PASSED).reason.item() == Reason.UNSAFE_VALUE


def test_monitor_reports_faults_but_never_acts():
    decision = decide(0.2, fault=Reason.OBSERVATION_STALE, monitor=True)
    assert decision.unsafe and not decision.intervened
    assert decision.reason.item() == Reason.OBSERVATION_STALE
    np.testing.assert_array_equal(decision.action, PROPOSED)


@pytest.mark.parametrize(("epsilon", "passes"), [(-math.inf, True), (math.inf, False), (math.nan, False)])
def test_extreme_epsilons(epsilon, passes):
    assert decide(-3.0, epsilon).intervened.item() is not passes


def test_rows_are_decided_alone():
    value = np.float32([0.5, -0.5, math.nan, 0.5])
    fault = np.array([0, 0, 0, Reason.ACTION_OUT_OF_RANGE])
    proposed = np.arange(4.0, dtype=np.float32)[:, None]
    decision = least_restrictive(proposed, -proposed - 10, value, np.zeros(4, np.float32), 0.0, fault)
    assert decision.action.flatten().tolist() == [0.0, -11.0, -12.0, -13.0]
    assert decision.reason.tolist() == [0, 1, 2, 7]
    assert decision.intervened.dtype == torch.bool and decision.reason.dtype == torch.int64
