"""Numbers of the control loop on the host, as NumPy's.

A check reads a dozen numbers. A step of it takes NumPy a microsecond; torch takes ten, or on a GPU launches a kernel.
"""

import numpy as np
import torch
from torch import Tensor

QUIET = np.errstate(over="ignore", invalid="ignore")
"""Around differences of numbers that may be anything: what comes of infinity is no surprise."""


def on_host(numbers: Tensor, dtype: torch.dtype = torch.float32) -> np.ndarray:
    """A tensor's numbers; those of a tensor that lies on the host in this precision are its own, not a copy."""
    return numbers.to("cpu", dtype).numpy(force=True)


def any_of(found: np.ndarray, axis: int = -1) -> np.ndarray:
    """Whether any number along an axis, by default the last, is true."""
    return np.logical_or.reduce(found, axis)


def all_of(found: np.ndarray, axis: int = -1) -> np.ndarray:
    """Whether all numbers along an axis, by default the last, are true."""
    return np.logical_and.reduce(found, axis)
