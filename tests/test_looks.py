"""What a live observation looks like, learned from a dataset: every kind of fault is told, and no frame of the data."""

import json

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from lerobot_latentsafe.looks import (
    ALTERATIONS,
    REPEATS,
    SIDE,
    Cameras,
    Look,
    Response,
    detail,
    halved,
    learn_looks,
    shrink,
)

FRONT, WRIST = "observation.images.front", "observation.images.wrist"
EPISODES, LENGTH, PIXELS = 4, 30, 64


def scene(background, place):
    """A picture of a table with a block at a place (x, y) in [0, 1]: (3, PIXELS, PIXELS)."""
    picture = background.clone()
    x, y = (8 + place * (PIXELS - 24)).long().tolist()
    picture[:, y : y + 12, x : x + 12] = torch.tensor([0.9, 0.2, 0.1]).view(3, 1, 1)
    return picture


def background(seed):
    """Light above, dark below, warm to the right, and with some texture."""
    ramp = torch.linspace(0.9, 0.2, PIXELS)
    warm = 0.25 * ramp[None].flip(1)
    colours = torch.stack([0.9 * ramp[:, None] + warm, *(w * ramp[:, None].expand(PIXELS, PIXELS) for w in (0.6, 0.3))])
    noise = torch.rand(3, PIXELS // 2, PIXELS // 2, generator=torch.Generator().manual_seed(seed))
    return (colours + 0.15 * noise.repeat_interleave(2, 1).repeat_interleave(2, 2)).clamp(0, 1)


def record():
    """Pictures of two cameras (N, 3, H, W), state (N, 3) and episode (N,): the front camera sees two of its numbers."""
    generator = torch.Generator().manual_seed(7)
    steps = 0.04 * torch.randn(EPISODES, LENGTH, 3, generator=generator)
    state = (0.5 + steps.cumsum(1)).clamp(0, 1).flatten(0, 1)
    front = torch.stack([scene(background(1), place) for place in state[:, :2]])
    wrist = torch.stack([scene(background(2).flip(1), place) for place in state[:, 1:]])
    return {FRONT: front, WRIST: wrist}, ((state - 0.5) / 0.2).numpy(), np.arange(EPISODES).repeat(LENGTH)


@pytest.fixture(scope="module")
def recorded():
    return record()


@pytest.fixture(scope="module")
def looks(recorded):
    pictures, state, episode = recorded
    return learned({key: shrink(picture) for key, picture in pictures.items()}, state, episode)


def learned(small, state, episode):
    shown = {key: halved(picture) for key, picture in small.items()}
    return learn_looks(shown, {key: detail(picture) for key, picture in small.items()}, state, episode)


def cameras(looks):
    return Cameras([FRONT, WRIST], looks)


def even(*colour):
    return lambda x: torch.tensor(colour).view(3, 1, 1).expand_as(x)


def noise(levels):
    return lambda x: torch.randint(levels + 1, x.shape) / 255


def hot_pixel(x):
    picture = torch.full_like(x, 0.5)
    picture[..., 5, 9] = 1.0
    return picture


def torn(x):
    return torch.where(torch.arange(PIXELS)[:, None] < PIXELS // 2, x, 0.5)


def of_side(n, blown_up=True):
    def change(x):
        small = F.interpolate(x, size=(n, n), mode="area")
        return F.interpolate(small, size=x.shape[-2:]) if blown_up else small

    return change


DEAD = {
    "lens cap": noise(2), "noisy lens cap": noise(10), "black": even(0.0, 0.0, 0.0), "green": even(0.0, 0.53, 0.0),
    "red": even(1.0, 0.0, 0.0), "nearly grey": even(0.5, 0.5, 0.502), "hot pixel": hot_pixel, "half a frame": torn,
}  # fmt: skip
STRANGE = {
    "uniform noise": torch.rand_like, "2 pixels": of_side(2), "4 pixels": of_side(4), "8 pixels": of_side(8),
    "16 pixels": of_side(16), "a thumbnail": of_side(16, blown_up=False), "negative": lambda x: 1 - x,
    **{name: lambda x, alter=alter: torch.from_numpy(alter(x.numpy()).copy()) for name, alter in ALTERATIONS.items()},
}  # fmt: skip


def test_no_frame_of_the_data_alarms(recorded, looks):
    pictures, state, _ = recorded
    watch = cameras(looks)
    for e in range(EPISODES):
        watch.reset()
        for t in range(e * LENGTH, (e + 1) * LENGTH):
            dead, strange, seen = watch.check({key: picture[t : t + 1] for key, picture in pictures.items()})
            assert not dead and not strange and watch.wrong == []
            assert not watch.repeats(seen, state[t : t + 1])


@pytest.mark.parametrize("key", [FRONT, WRIST])
@pytest.mark.parametrize("name", DEAD)
def test_a_camera_that_shows_nothing_is_dead(recorded, looks, name, key):
    pictures, _, _ = recorded
    watch = cameras(looks)
    dead, _, _ = watch.check({**pictures, key: DEAD[name](pictures[key])})
    assert dead.all() and watch.wrong == [f"{key} shows nothing"]


@pytest.mark.parametrize("name", [name for name in DEAD if name != "half a frame"])
def test_also_by_a_filter_that_knows_no_looks(recorded, name):
    pictures, _, _ = recorded
    dead, strange, _ = cameras(None).check({**pictures, WRIST: DEAD[name](pictures[WRIST])})
    assert dead.all() and not strange.any()
    assert not cameras(None).check(pictures)[0].any()


@pytest.mark.parametrize("key", [FRONT, WRIST])
@pytest.mark.parametrize("name", STRANGE)
@pytest.mark.fault("S14", "red and blue exchanged, where the data tell it", "The robot stays: `OBSERVATION_UNFAMILIAR`")
@pytest.mark.fault(
    "S15", "a camera upside down or mirrored, where the data tell it", "The robot stays: `OBSERVATION_UNFAMILIAR`"
)
def test_a_picture_that_the_data_never_show_is_told(recorded, looks, name, key):
    pictures, _, _ = recorded
    watch = cameras(looks)
    dead, strange, _ = watch.check({**pictures, key: STRANGE[name](pictures[key])})
    assert (dead | strange).all()
    if name in ALTERATIONS:
        assert name in watch.wrong[0] and watch.wrong[0].startswith(key)


@pytest.mark.fault("S12", "two cameras swapped, where the data tell it", "The robot stays: `OBSERVATION_UNFAMILIAR`")
def test_exchanged_cameras_are_told_and_named(recorded, looks):
    pictures, _, _ = recorded
    watch = cameras(looks)
    _, strange, _ = watch.check({FRONT: pictures[WRIST], WRIST: pictures[FRONT]})
    assert strange.all() and WRIST in watch.wrong[0]


def test_what_the_data_do_not_tell_apart_is_not_tested():
    symmetric = torch.rand(40, 1, 1, 1) * 0.1 + torch.linspace(0.2, 0.8, PIXELS)[:, None].expand(40, 3, PIXELS, PIXELS)
    thumbnails = halved(shrink(symmetric))
    look = learn_looks({FRONT: thumbnails}, {}, np.zeros((40, 0), np.float32), np.zeros(40, int))[FRONT]
    assert {*look.told} == {"upside down", "flipped", "turned left", "turned right"}
    _, strange, _ = Cameras([FRONT], {FRONT: look}).check({FRONT: symmetric.flip(-1)})
    assert not strange.any()


def grey_level(x):
    return (x + torch.randint(-1, 2, x.shape) / 255).clamp(0, 1)


@pytest.mark.parametrize("again", [lambda x: x, grey_level, lambda x: x + 1 / 255], ids=["exact", "noise", "brighter"])
@pytest.mark.parametrize("buffers", [1, 2, 5])
@pytest.mark.fault(
    "R02",
    "a camera alternates between a few old pictures while the robot moves",
    "The robot stays: `OBSERVATION_STALE`",
)
def test_old_pictures_are_told_while_the_robot_moves(recorded, looks, again, buffers):
    pictures, state, _ = recorded
    watch, told = cameras(looks), []
    for t in range(LENGTH):
        old = min(t, 3 + (t - 3) % buffers)
        shown = {key: picture[t : t + 1] for key, picture in pictures.items()}
        shown[WRIST] = again(pictures[WRIST][old : old + 1])
        _, _, seen = watch.check(shown)
        told.append(bool(watch.repeats(seen, state[t : t + 1])))
    assert not any(told[: 3 + buffers]) and told[-1]


def test_a_robot_that_stands_still_may_see_the_same(recorded, looks):
    pictures, state, _ = recorded
    watch = cameras(looks)
    for _ in range(10):
        _, _, seen = watch.check({key: grey_level(picture[:1]) for key, picture in pictures.items()})
        assert not watch.repeats(seen, state[:1])


def test_a_filter_that_knows_no_looks_tells_pictures_that_are_exactly_old(recorded):
    pictures, _, _ = recorded
    watch = cameras(None)
    for t in range(4):
        _, _, seen = watch.check({key: picture[:1] for key, picture in pictures.items()})
        assert watch.repeats(seen, np.full((1, 3), 0.06 * t, np.float32)).all() == (t >= REPEATS)


def test_what_a_camera_does_not_see_may_move(recorded, looks):
    pictures, state, _ = recorded
    assert looks[WRIST].unseen[0] > 0.1 > looks[WRIST].unseen[1]  # the first number moves what the front camera sees
    watch, moves = cameras(looks), np.float32([[1.0, 0.0, 0.0]])
    pictures = {FRONT: pictures[FRONT], WRIST: pictures[WRIST][:1].expand_as(pictures[FRONT])}
    for t in range(4):
        _, _, seen = watch.check({key: picture[t : t + 1] for key, picture in pictures.items()})
        assert not watch.repeats(seen, state[:1] + t * moves * looks[WRIST].unseen[0] / 4)


def test_robots_of_a_batch_are_told_apart(recorded, looks):
    pictures, _, _ = recorded
    shown = {key: picture[:3].clone() for key, picture in pictures.items()}
    shown[FRONT][1], shown[WRIST][2] = 0.0, shown[WRIST][2].flip(-2)
    dead, strange, _ = cameras(looks).check(shown)
    assert dead.tolist() == [False, True, False] and strange.tolist()[::2] == [False, True]


def test_black_frames_of_a_recording_teach_nothing(recorded, looks):
    pictures, state, episode = recorded
    small = {key: shrink(picture) for key, picture in pictures.items()}
    small[FRONT][:2] = 0.0
    look = learned(small, state, episode)[FRONT]
    assert look.frames == looks[FRONT].frames - 2
    assert look.contrast[0] > 0.5 * looks[FRONT].contrast[0] and look.furthest < 2 * looks[FRONT].furthest


def test_grey_cameras_and_other_sizes_are_read(recorded, looks):
    grey = torch.rand(2, 1, 48, 80)
    assert shrink(grey).shape == (2, 3, SIDE, SIDE)
    pictures, _, _ = recorded
    larger = {key: F.interpolate(picture[:5], scale_factor=3) for key, picture in pictures.items()}
    dead, strange, _ = cameras(looks).check(larger)
    assert not dead.any() and not strange.any()


def test_looks_survive_json(looks):
    text = json.dumps({key: vars(look) for key, look in looks.items()})
    assert {key: Look(**entry) for key, entry in json.loads(text).items()} == looks


# -- the response of the state ---

TARGETS, DELTAS = np.array([False, False]), np.array([True, True])


def unanswered(adds_up, states, commands):
    response = Response(np.float32([0.01, 0.01]), adds_up)
    return np.concatenate([response.unanswered(s[None], c[None]) for s, c in zip(states, commands)])


@pytest.mark.parametrize("adds_up", [TARGETS, DELTAS], ids=["targets", "deltas"])
@pytest.mark.fault(
    "R05", "the whole observation is frozen while moves are sent", "The robot goes no further: `OBSERVATION_STALE`"
)
def test_a_state_that_does_not_answer_is_told(adds_up):
    steps = np.float32([[0.1, 0.0]] * 20)
    place, nothing, start = steps.cumsum(0), np.float32([[np.nan, np.nan]]), np.zeros((1, 2), np.float32)
    commands = np.concatenate([nothing, steps if adds_up.all() else place])[:20]
    healthy = unanswered(adds_up, np.concatenate([start, place])[:20], commands)
    assert healthy.max() < 0.11
    frozen = unanswered(adds_up, np.zeros((20, 2), np.float32), commands)
    assert frozen[-1, 0] > 1.5 and frozen[:, 1].max() == 0


def test_commands_that_go_nowhere_need_no_answer():
    back_and_forth, stands = np.float32([[0.1, 0.0], [-0.1, 0.0]] * 10), np.zeros((20, 2), np.float32)
    assert unanswered(DELTAS, stands, back_and_forth).max() < 0.11
    assert unanswered(TARGETS, stands, np.ones((20, 2), np.float32)).max() == 0
