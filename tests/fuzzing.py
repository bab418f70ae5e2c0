"""Random observations, actions and answers of base policies, each with what is known of it: may it count as safe?

The oracle is independent of the code under test: it knows what was injected, and that this is never usable.
"""

import math

import numpy as np
import torch
from hypothesis import strategies as st

WEIRD = st.sampled_from([math.nan, math.inf, -math.inf, 1e30, -1e30, 1e9, -1e9, 1e6])
ANYTHING = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8), st.binary(max_size=8),
    st.lists(st.floats(), max_size=4), st.dictionaries(st.text(max_size=4), st.integers(), max_size=2),
    st.builds(object), st.integers(0, 4).map(np.zeros), st.just(len), st.just(ValueError("a value")),
)  # fmt: skip
DTYPES = st.sampled_from([torch.bool, torch.uint8, torch.int64, torch.float16, torch.float64, torch.complex64])
SHAPES = st.lists(st.integers(0, 4), max_size=5).map(tuple)


def shapes_like(shape):
    """A shape with a number more, less or changed, or any other."""
    places, numbers, n = st.integers(0, len(shape)), st.integers(0, 9), len(shape)
    less = st.integers(0, n - 1).map(lambda i: shape[:i] + shape[i + 1 :])
    more = st.builds(lambda i, number: (*shape[:i], min(number, 3), *shape[i:]), places, numbers)
    changed = st.builds(lambda i, number: (*shape[:i], number, *shape[i + 1 :])[:n], places, numbers)
    return st.one_of(SHAPES, less, more, changed)


def poisoned(healthy, number, places):
    """The same tensor with a number at some places."""
    tensor = healthy.clone(memory_format=torch.contiguous_format)
    flat = tensor.view(-1)
    flat[[place % len(flat) for place in places]] = number
    return tensor


def broken_tensors(healthy):
    """What may stand in the place of a tensor, and whether it may count as safe: (value, bool or None if unknown)."""
    places = st.lists(st.integers(0, 10**6), min_size=1, max_size=5)
    other = shapes_like(tuple(healthy.shape)).filter(lambda shape: shape != tuple(healthy.shape))
    return st.one_of(
        st.builds(lambda number, at: (poisoned(healthy, number, at), False), WEIRD, places),
        other.map(lambda shape: (torch.rand(shape), False)),
        DTYPES.map(lambda kind: (healthy.to(kind), False if kind in (torch.bool, torch.complex64) else None)),
        ANYTHING.map(lambda value: (value, False)),
    )


@st.composite
def observations(draw, healthy):
    """A healthy observation of which some entries are broken or left out: (observation, usable)."""
    seen, usable = dict(healthy), True
    for key in draw(st.lists(st.sampled_from(sorted(healthy)), unique=True, min_size=1)):
        value, fits = draw(broken_tensors(healthy[key]))
        other_size = key != "observation.state" and isinstance(value, torch.Tensor) and value.dim() == 4
        if fits is False and other_size and value.shape[:2] == healthy[key].shape[:2] and value.numel():
            fits = (
                None if value.isfinite().all() and value.float().abs().max() <= 1 else False
            )  # a picture of another size
        if draw(st.booleans()) and value is None:
            seen.pop(key)
        else:
            seen[key] = value
        usable = False if fits is False or usable is False else (None if fits is None else usable)
    return seen, usable


def actions(healthy):
    """What a base policy may give instead of an action: (value, usable)."""
    chunk = healthy[:, None].expand(-1, 8, -1)
    return st.one_of(broken_tensors(healthy), st.just((chunk, False)), st.just((healthy.clone(), True)))


ERRORS = st.sampled_from(
    [RuntimeError("x"), ValueError("x"), KeyError("x"), TypeError(), IndexError(), SystemExit(1), StopIteration(),
     AssertionError(), MemoryError(), OSError("gone"), NotImplementedError()]
)  # fmt: skip
"""What a base policy may raise."""

JSON = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8)),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=5), inner, max_size=3)),
    max_leaves=4,
)
"""Values of a configuration."""
