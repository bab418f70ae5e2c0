"""Filter laws: given a value, decide whether a proposed action passes. Pure and batched."""

from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor


class Reason(IntEnum):
    """Why a decision fell as it did; anything but PASSED means the proposed action was not found safe."""

    PASSED = 0
    UNSAFE_VALUE = 1
    VALUE_NOT_FINITE = 2
    OBSERVATION_NOT_FINITE = 3
    OBSERVATION_MISSING = 4
    OBSERVATION_STALE = 5
    ACTION_NOT_FINITE = 6
    ACTION_OUT_OF_RANGE = 7
    DEADLINE_MISSED = 8
    BASE_POLICY_FAILED = 9
    NO_BASE_POLICY = 10
    WRONG_RATE = 11


@dataclass
class FilterDecision:
    """One decision for each row of a batch; actions in robot units.

    Attributes:
        action: (B, A), what to execute.
        proposed: (B, A), what the base policy wanted.
        value: (B,), V of the latent predicted under the proposed action.
        margin: (B,), l of the current latent; negative means it looks like a failure already.
        unsafe: bool (B,), the law's verdict on the proposed action.
        intervened: bool (B,), whether `action` is the fallback's; never in monitor mode.
        reason: int64 (B,), a `Reason`.
    """

    action: Tensor
    proposed: Tensor
    value: Tensor
    margin: Tensor
    unsafe: Tensor
    intervened: Tensor
    reason: Tensor


def least_restrictive(
    proposed: Tensor,
    fallback: Tensor,
    value: Tensor,
    margin: Tensor,
    epsilon: float | Tensor,
    fault: Tensor | None = None,
    monitor: bool = False,
) -> FilterDecision:
    """The paper's law: pass the proposed action if V > epsilon at its predicted next latent, else fall back.

    Args:
        proposed, fallback: (B, A) in robot units.
        value: (B,) V of the next latent; a value that is not finite is never safe.
        margin: (B,) l of the current latent.
        epsilon: threshold, or one for each row (B,).
        fault: (B,) a `Reason` for rows that must not pass whatever their value; 0 elsewhere.
        monitor: judge, but let every action through.
    """
    reason = torch.where(value > epsilon, Reason.PASSED, Reason.UNSAFE_VALUE)
    reason = torch.where(torch.isfinite(value), reason, Reason.VALUE_NOT_FINITE)
    if fault is not None:
        reason = torch.where(fault != Reason.PASSED, fault, reason)
    unsafe = reason != Reason.PASSED
    intervened = torch.zeros_like(unsafe) if monitor else unsafe
    action = torch.where(intervened[:, None], fallback, proposed)
    return FilterDecision(action, proposed, value, margin, unsafe, intervened, reason)
