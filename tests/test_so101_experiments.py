import numpy as np
import pytest

from lerobot_latentsafe.experiments import so101
from lerobot_latentsafe.so101.actions import NAMES
from lerobot_latentsafe.so101.scene import PushScene


def test_what_leaves_the_range_is_counted_in_shares_of_it():
    shown = np.array([np.zeros(6), np.full(6, 10.0)])
    values = np.array([np.full(6, 5.0), [5, 5, 5, 5, 5, 10.3], [-2.5, 5, 5, 5, 5, 10.3]])
    left = so101._left(values, shown)
    assert left["leave_it"] == pytest.approx(2 / 3) and left["by_more_than_0.1"] == pytest.approx(1 / 3)
    assert left["beyond"]["p100"] == pytest.approx(0.25)
    assert left["each"] == pytest.approx(dict(zip(NAMES, [1 / 3, 0, 0, 0, 0, 2 / 3])))


def test_a_reckless_operator_pushes_the_cube_over_the_edge_and_a_careful_one_does_not():
    scene = PushScene()
    rows = {
        behavior: so101.operate(scene, None, behavior, so101.FIRST_SEED + 1) for behavior in ("reckless", "careful")
    }
    assert rows["reckless"] == {"violation": True, "success": False, "overridden": 0.0}
    assert rows["careful"] == {"violation": False, "success": True, "overridden": 0.0}
