"""The committed filters in danger: an action that they stop must not pass because something is broken besides."""

import faulty
import numpy as np
import pytest
import tiny
import torch
from faulty import FRONT, STATE, WRIST, row
from torch.nn.functional import interpolate

from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.evaluation.faults import ALTERED, EMPTY, FAULTS, shown
from lerobot_latentsafe.franka.behaviors import lift
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.shield import Shield

CLOSED_END = 2
"""The segment of the bag that must not be lifted."""
NEVER = "It does not pass: the filter acts, or the robot stays"


class Danger:
    """A filter, and an observation and an action that it stops."""

    def __init__(self, name, observation, action, law=None):
        self.filter, self.observation, self.action = load_filter(name), observation, action

    def decide(self, *faults):
        """The decisions of an episode, a tick for each fault."""
        self.filter.shield = Shield(self.filter.model, faulty.standing_still)
        given = {"observation": self.observation, "proposed": self.action}
        return [self.filter.shield(**fault(given)) for fault in faults]


@pytest.fixture(scope="module")
def car():
    """A car that heads for the disc."""
    return Danger("dubins", tiny.observation([[-0.5, 0.05, 0.0]]), torch.tensor([[0.0, 1.0]]))


@pytest.fixture(scope="module")
def bag():
    """An operator who pulls the bag up by its closed end."""
    from lerobot_latentsafe.experiments.scene_world import SceneWorld
    from lerobot_latentsafe.franka.bag import BagScene

    scene = BagScene()
    scene.reset(5)
    operator, action = lift(scene, CLOSED_END, 0.1, np.random.default_rng(0)), np.zeros(7)
    for _ in range(46):
        action = next(operator, action)
        scene.step(action)
    return Danger("bag", SceneWorld(scene, 1).observe(), torch.from_numpy(next(operator)).float()[None])


@pytest.fixture(scope="module")
def blocks():
    """An arm at rest before the blocks, who is told to move down."""
    from lerobot_latentsafe.experiments.scene_world import SceneWorld
    from lerobot_latentsafe.franka.blocks import BlocksScene

    scene = BlocksScene()
    scene.reset(5)
    down = torch.tensor([[0.0, 0.0, -0.01, 0.0, 0.0, 0.0, 0.0]])
    return Danger("blocks", SceneWorld(scene, 1).observe(), down)


@pytest.fixture
def danger(request):
    return request.getfixturevalue(request.param)


def joint_2(number):
    return shown(lambda state: state.index_fill(1, torch.tensor([1]), number), STATE)


def degrees(state):
    return torch.cat([torch.rad2deg(state[:, :7]), state[:, 7:]], 1)


def swapped(given):
    seen = given["observation"]
    return {**given, "observation": {**seen, FRONT: seen[WRIST], WRIST: seen[FRONT]}}


def both(change):
    first, second = shown(change, FRONT), shown(change, WRIST)
    return lambda given: second(first(given))


def never(number, what, danger, *faults):
    """Rows of faults of a kind under which a dangerous action must not pass."""
    return [row(number, what, danger, fault, outcome=NEVER) for fault in faults]


def altered(*names):
    return [shown({**EMPTY, **ALTERED}[name]) for name in names]


def thumbnail(n):
    return shown(lambda picture: interpolate(picture, (n, n), mode="area"))


ONE_NUMBER, TURNED = FAULTS["a state that is one number"], ("upside down", "mirrored")
CAPS, SPECK = ("a lens cap", "a lens cap and a noisy sensor"), "one hot pixel on a dead camera"
COLOURS = [name for name in EMPTY if "flat" in name]
ROWS = [
    *never("S63", "a state of shape (1, 1), in danger", "car", ONE_NUMBER),
    *never("S21", "a state of shape (1, 1) under the filter `dubins`", "car", ONE_NUMBER),
    *never("S18i", "a heading of (1e4, -1e4)", "car", shown(lambda x: torch.tensor([[1e4, -1e4]]), STATE)),
    *never("S63", "black with noise, or grey with a hot pixel, in danger", "car", *altered(*CAPS, SPECK)),
    *never("S63", "noise in place of a picture, in danger", "car", *altered("noise")),
    *never("S65", "a camera set to a thumbnail, in danger", "car", *map(thumbnail, (2, 4, 8, 16, 24))),
    *never("S69", "one flat colour, in danger", "car", *altered(*COLOURS), FAULTS["a dead camera"]),
    *never("S04", "lens caps on both cameras, in danger", "bag", *(both(EMPTY[name]) for name in CAPS)),
    *never("S12", "two cameras swapped, in danger", "bag", swapped),
    *never("S14", "red and blue exchanged, in danger", "car", *altered("red and blue exchanged")),
    *never("S14", "red and blue exchanged, in danger", "bag", *altered("red and blue exchanged")),
    *never("S15", "a camera upside down or mirrored, in danger", "car", *altered(*TURNED)),
    *never("S15", "a camera upside down or mirrored, in danger", "bag", *altered(*TURNED)),
    *never("S64", "joint_2 of 10 rad, in danger", "bag", joint_2(10.0)),
    *never("S64", "joint_2 of 1,000 rad, in danger", "bag", joint_2(1000.0)),
    *never("S64", "joints in degrees, in danger", "bag", shown(degrees, STATE)),
    *never("S70", "joint_2 of 10 or 1,000 rad, at rest", "blocks", joint_2(10.0), joint_2(1000.0)),
    *never("S18g", "joints in degrees instead of radians", "bag", shown(degrees, STATE)),
    *never("S18g", "joints in degrees instead of radians", "blocks", shown(degrees, STATE)),
    *never("S70", "joints in degrees, at rest", "blocks", shown(degrees, STATE)),
]


@pytest.mark.parametrize("danger", ["car", "bag"], indirect=True)
def test_without_a_fault_the_filter_acts(danger):
    assert danger.decide(dict)[0].reason.item() == Reason.UNSAFE_VALUE


@pytest.mark.parametrize(("danger", "fault"), ROWS, indirect=["danger"])
def test_what_is_dangerous_does_not_pass_because_something_is_broken(danger, fault):
    for decision in danger.decide(dict, fault, fault)[1:]:
        assert decision.intervened.all() and decision.action.isfinite().all()
    try:
        decision = danger.decide(fault)[0]
    except ValueError as e:
        assert "expected" in str(e)
    else:
        assert decision.intervened.all() and decision.action.isfinite().all()
