"""Numbers of a state that are angles: they wrap around, and what describes the orientation with them leaps, too."""

import math

import numpy as np
import pytest

from lerobot_latentsafe.limits import Limits
from lerobot_latentsafe.units import TrainedOn, Units

NAMES = ["joint.pos", "ee_x.pos", "ee_rx.pos", "ee_rz.pos"]


def limits(full):
    half = 0.99 * full / 2
    trained_on = TrainedOn(
        action_names=["delta_x.pos"], action_low=[-1.0], action_high=[1.0], action_varies=[True], state_names=NAMES,
        state_low=[-1.0, 0.0, -0.05 * full, -half], state_high=[1.0, 1.0, 0.05 * full, half],
        state_step=[0.1, 0.1, 0.02 * full, 0.02 * full], state_mean=[0.0] * 4, state_std=[1.0] * 4,
    )  # fmt: skip
    return Limits(trained_on, Units(trained_on, []))


@pytest.mark.parametrize("full", [2 * math.pi, 360.0])
@pytest.mark.parametrize(
    ("after", "believed"),
    [
        ([0.0, 0.5, 0.04, 0.48], [True] * 4),
        ([0.0, 0.5, 0.04, -0.48], [True] * 4),  # it wrapped around
        ([0.0, 0.5, -0.08, -0.48], [True] * 4),  # and another leapt with it
        ([0.0, 0.5, 0.04, 0.0], [True, True, True, False]),  # half a turn
        ([0.0, 0.5, -0.08, 0.48], [True, True, False, True]),
        ([100.0, 0.5, 0.04, -0.48], [False, True, True, True]),
    ],
)
def test_angles_may_wrap_around(full, after, believed):
    scale = np.float32([1.0, 1.0, full, full])
    before = np.float32([[0.0, 0.5, 0.04, 0.49]]) * scale
    found = limits(full).believable(np.float32([after]) * scale, before, np.zeros((1, 4), np.float32))
    assert found.tolist() == [believed]
