"""What a robot and its operator say, as numbers and pictures; what is none is left for the guard to judge."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor


def as_number(value: Any) -> float:
    """A command or a reading, of whatever type of number; NaN for what is none."""
    if isinstance(value, str | bytes):
        return math.nan
    try:
        return float(value)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return math.nan


def as_numbers(values: Any) -> dict[str, float]:
    """Name -> number of an action, or of what a robot says that it executed; empty if it is neither."""
    return {str(name): as_number(value) for name, value in values.items()} if isinstance(values, Mapping) else {}


def all_finite(numbers: dict[str, float]) -> bool:
    """Whether there are numbers, and all are finite."""
    return bool(numbers) and all(map(math.isfinite, numbers.values()))


def is_picture(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether a value is a picture as LeRobot's cameras give them, uint8 of the shape (H, W, C) that was declared."""
    return isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.shape == tuple(shape)


def is_usable(value: Any, kind: Any) -> bool:
    """Whether LeRobot can use what it read, of a kind as in a robot's `observation_features`."""
    return is_picture(value, kind) if isinstance(kind, tuple) else math.isfinite(as_number(value))


def as_input(value: Any, shape: tuple[int, ...]) -> Any:
    """A picture as policies get it, (1, C, H, W) floats in [0, 1]; anything else with nothing but a batch dimension."""
    if is_picture(value, shape):
        return (torch.from_numpy(value).type(torch.float32) / 255).permute(2, 0, 1).contiguous()[None]
    if isinstance(value, Tensor):
        return value[None]
    try:
        return torch.as_tensor(np.asarray(value))[None]
    except (TypeError, ValueError, RuntimeError):  # no array of numbers
        return value
