"""What commands mean, told by names and data of robots as they are in the world."""

import numpy as np
import pytest

from lerobot_latentsafe.meanings import Command, MeaningError, contradictions, parse, settle, tell_meanings

JOINTS = [
    f"{name}.pos" for name in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
]
N = 600


def walk(n_numbers, step, seed=0, n=N):
    return np.cumsum(np.random.default_rng(seed).normal(0, step, (n, n_numbers)), 0)


def followed(target, lag=0.3, sag=0.0, noise=0.1):
    """The state of an arm that goes a share of the way to its target at each step."""
    state = target.copy()
    for t in range(1, len(target)):
        state[t] = state[t - 1] + lag * (target[t - 1] - state[t - 1])
    return state - sag + np.random.default_rng(1).normal(0, noise, state.shape)


def so101(n=N):
    """Joint targets far from zero, a joint that never moves, an arm that sags, a gripper stopped by what it holds."""
    target = walk(6, 0.8, n=n) + np.array([-10, -70, 65, 30, 20, 10])
    target[:, 4], target[:, 5] = 20, np.where((np.arange(n) // 100) % 2, 5, 40)
    state = followed(target, sag=np.array([0, 0.8, 0.8, 0, 0, 0]))
    state[:, 5] = np.maximum(state[:, 5], 20)
    return state, target


def moved_by(delta, scale=0.3, start=-50.0):
    """A state that changes by what was commanded."""
    state = np.cumsum(delta, 0) * scale + start
    return np.vstack([state[:1] - scale * delta[:1], state[:-1]])


def uniform(*shape):
    return np.random.default_rng(2).uniform(-2, 2, shape)


def lekiwi():
    base = np.stack([np.where((np.arange(N) // 50) % 3 == 0, 0.2, 0), np.zeros(N), walk(1, 3.0)[:, 0]], 1)
    (state, target), names = so101(), [f"arm_{name}" for name in JOINTS] + ["x.vel", "y.vel", "theta.vel"]
    return names, names, np.hstack([state, np.vstack([base[:1], base[:-1]])]), np.hstack([target, base])


def end_effector():
    """Unnamed deltas of a hand and a switch for its fingers, as in LIBERO; the state has more numbers."""
    action = np.hstack([uniform(N, 6), np.random.default_rng(0).choice([-1.0, 1.0], (N, 1))])
    state = np.hstack([moved_by(action[:, :6], 0.01, 0.0), 0.04 * np.abs(uniform(N, 2))])
    return [f"state_{i}" for i in range(8)], [f"action_{i}" for i in range(7)], state, action


def still_joint():
    delta = uniform(N, 6)
    delta[:, 4] = 0
    return JOINTS, JOINTS, moved_by(delta), delta


def switch():
    on = ((np.arange(N) // 60) % 2)[:, None].astype(float)
    return ["gripper.pos"], ["gripper.pos"], 0.08 * on, on


ROBOTS = {
    "SO-101": (lambda: (JOINTS, JOINTS, *so101()), ["target"] * 6),
    "forty frames of it": (lambda: (JOINTS, JOINTS, *so101(40)), ["target"] * 6),
    "without names": (lambda: (*[[f"motor_{i}" for i in range(6)]] * 2, *so101()), ["target"] * 6),
    "names of its own for commands": (
        lambda: ([f"s{i}" for i in range(6)], [f"a{i}" for i in range(6)], *so101()),
        [f"target s{i}" for i in range(6)],
    ),
    "LeKiwi": (lekiwi, ["target"] * 6 + ["velocity"] * 3),
    "pusht": (lambda: (*[["motor_0", "motor_1"]] * 2, followed(walk(2, 8) + 250), walk(2, 8) + 250), ["target"] * 2),
    "joint deltas": (lambda: (JOINTS, JOINTS, moved_by(uniform(N, 6)), uniform(N, 6)), ["delta"] * 6),
    "joint deltas, one never moved": (still_joint, ["delta"] * 6),
    "hand deltas by name": (
        lambda: (["ee_x.pos"], ["delta_x.pos"], followed(walk(1, 1)), uniform(N, 1)),
        ["delta"],
    ),
    "hand deltas without names": (end_effector, ["delta"] * 6 + ["other"]),
    "a switch in another unit": (switch, ["other"]),
    "noise": (lambda: (["x.pos"], ["x.pos"], uniform(N, 1), uniform(N, 1)[::-1]), ["None"]),
    "one frame": (lambda: (["x.pos"], ["x.pos"], uniform(1, 1), uniform(1, 1)), ["None"]),
}  # fmt: skip


@pytest.mark.parametrize("robot", ROBOTS)
def test_meanings_are_told_by_names_and_data(robot):
    make, expected = ROBOTS[robot]
    state_names, action_names, state, action = make()
    told = tell_meanings(state_names, action_names, state, action, np.zeros(len(state), int))
    assert [command.described for command in told] == expected


def test_a_step_between_episodes_is_no_motion():
    delta = uniform(N, 1)
    state = moved_by(delta)
    state[::2] += 1000  # every frame is an episode of its own
    assert tell_meanings(["x.pos"], ["x.pos"], state, delta, np.arange(N))[0].meaning is None


def test_what_the_user_says_wins_and_what_nobody_tells_is_asked():
    told = [Command("x.pos", None), Command("y.pos", "delta")]
    with pytest.raises(
        MeaningError, match=r"me/data tell what x.pos means.*--policy.trained_on.meanings='{x.pos: delta}'"
    ):
        settle(told, None, ["x.pos"], "me/data")
    settled = settle(told, {"x.pos": "target", "y.pos": "other"}, ["x.pos"], "me/data")
    assert settled == [Command("x.pos", "target", "x.pos"), Command("y.pos", "other")]
    with pytest.raises(MeaningError, match=r"names z\.pos; me/data has the commands x\.pos, y\.pos"):
        settle(told, {"z.pos": "delta"}, ["x.pos"], "me/data")


@pytest.mark.parametrize(
    ("described", "message"),
    [
        ("speed", "is 'speed'; expected one of target, delta, velocity, other"),
        ("delta x.pos", "is 'delta x.pos'; expected"),
        ("target", "a target of a.pos, which the state does not have: it has x.pos"),
        ("target z.pos", "a target of z.pos, which the state does not have"),
    ],
)
def test_meanings_that_make_no_sense_are_refused(described, message):
    with pytest.raises(MeaningError, match=message):
        parse("a.pos", described, ["x.pos"])
    assert parse("a.pos", "target x.pos", ["x.pos"]).described == "target x.pos"


def test_targets_and_motions_contradict_each_other():
    of = lambda *meanings: [Command(f"c{i}", meaning) for i, meaning in enumerate(meanings)]  # noqa: E731
    known = of("target", "delta", "velocity", "other", "target", "delta")
    assert contradictions(known, of("target", "velocity", "delta", "target", "other", None)) == []
    said = contradictions(known, of("delta", "target", "target", "delta", "velocity", "delta"))
    assert [line.split()[0] for line in said] == ["c0", "c1", "c2", "c4"]
