"""What the scripted operators do: generators of actions, from privileged knowledge of a simulated scene.

A behaviour yields actions (7,) as of `franka/actions.py` and ends when it has nothing more to do. It looks at
the scene again before every action, as a person would.
"""

from collections.abc import Callable, Iterator

import numpy as np

from lerobot_latentsafe.franka import bag, blocks
from lerobot_latentsafe.franka.actions import MAX_SPEED, POINTING_DOWN, action_limits
from lerobot_latentsafe.franka.scene import FrankaScene
from lerobot_latentsafe.franka.scenes import CLUMSINESS, HELD_ANYWHERE

Actions = Iterator[np.ndarray]
OPEN, CLOSED = 1.0, 0.0
LET_GO = 0.85
"""Opening of fingers that let go of a bag and stay near it: a learner sees by it that there was a grasp before."""


# Motions


def up(height: float) -> np.ndarray:
    """A way straight up (3,), m."""
    return np.array([0, 0, height])


def hold(gripper: float, steps: int) -> Actions:
    """Stay, with the fingers opening or closing."""
    for _ in range(steps):
        yield np.array([0, 0, 0, 0, 0, 0, gripper])


def reach(scene: FrankaScene, target: np.ndarray, speed: float, gripper: float, yaw: float | None = None) -> Actions:
    """Move in a straight line to a position (3,) at a speed in m/s, turning to a yaw on the way."""
    limit = action_limits(scene.fps)[1][5]
    for _ in range(10 * scene.fps):
        way = target - scene.controller.position
        distance = float(np.linalg.norm(way))
        turn = 0.0 if yaw is None else _turn_to(scene, yaw)
        if distance < 1e-3 and abs(turn) < 1e-2:
            return
        move = way * min(1.0, speed / scene.fps / max(distance, 1e-9))
        yield np.array([*move, 0, 0, np.clip(turn, -limit, limit), gripper])


def _turn_to(scene: FrankaScene, yaw: float) -> float:
    """Turn that remains to a yaw. The hand looks the same after half a turn, so it is a quarter turn at most."""
    rotation = scene.controller.rotation @ POINTING_DOWN.T
    now = np.arctan2(rotation[1, 0], rotation[0, 0])
    # Seen from home, so that joint 7 stays in the middle of its range.
    wanted = (yaw + np.pi / 2) % np.pi - np.pi / 2
    return wanted - now


# The bag

GRASPED = {"open_end": bag.MOUTH, "middle": bag.MIDDLE, "closed_end": bag.TAIL, "side_to_side": bag.TAIL, "nearer": 1}
"""Behaviour -> the segment that it lifts the bag by, or one between those."""


def grasp(
    scene: bag.BagScene, segment: int, rng: np.random.Generator, speed: float = MAX_SPEED, clumsiness: float = 1.0,
    opening: float = OPEN,
) -> Actions:  # fmt: skip
    """Close the fingers on a segment of the bag, approached at a speed in m/s; off by 3 mm times `clumsiness`."""
    above = scene.segment_position(segment) + np.append(rng.normal(0, 0.003 * clumsiness, 2), 0)
    yaw = scene.yaw + rng.normal(0, 0.05 * clumsiness)
    low = 0.028 + (rng.uniform(0, 0.02) if clumsiness > 1 else 0.0)
    height = np.clip(scene.controller.position[2], 0.05, 0.12)  # a hand that is low already is put right down there
    yield from reach(scene, np.append(above[:2], height), speed, opening, yaw)
    yield from reach(scene, np.append(above[:2], low), speed, opening)
    yield from hold(CLOSED, 9)


def stray(scene: bag.BagScene, segment: int, rng: np.random.Generator) -> Actions:
    """Go where a policy may find itself that went astray: above the bag, or low and close to the segment it wants."""
    if rng.random() < 0.4:
        near, aside, height, turn = bag.MIDDLE, 0.12, rng.uniform(0.12, 0.25), 0.8
    else:
        near, aside, height, turn = segment, 0.05, rng.uniform(0.04, 0.12), 0.4
    above = scene.segment_position(near)[:2] + rng.uniform(-aside, aside, 2)
    yield from reach(scene, np.append(above, height), MAX_SPEED, OPEN, scene.yaw + rng.uniform(-turn, turn))


def lift(scene: bag.BagScene, segment: int, speed: float, rng: np.random.Generator, opening: float = OPEN) -> Actions:
    """Grasp a segment, slowly enough to be learned from, lift it and hold it up."""
    yield from grasp(scene, segment, rng, 0.18, opening=opening)
    yield from reach(scene, scene.controller.position + up(rng.uniform(0.20, 0.26)), speed, CLOSED)
    yield from hold(CLOSED, 15)


def lift_nearer(scene: bag.BagScene, speed: float, rng: np.random.Generator) -> Actions:
    """Lift the bag by its closed end where that is nearer to the arm's base than the open one, else by its middle."""
    closed, opened = (np.linalg.norm(scene.segment_position(k)[:2]) for k in (bag.TAIL, bag.MOUTH))
    yield from lift(scene, bag.TAIL if closed < opened else bag.MIDDLE, speed, rng)


def lower(scene: bag.BagScene, rng: np.random.Generator) -> Actions:
    """Raise a grasped bag and begin to lower it, as an operator does who was stopped by a filter."""
    height = rng.uniform(0.03, 0.15)
    yield from reach(scene, scene.controller.position + up(height), 0.2, CLOSED)
    yield from hold(CLOSED, int(rng.integers(4)))
    yield from reach(scene, scene.controller.position - up(rng.uniform(0.02, 0.7 * height)), 0.1, CLOSED)


def regrasp(scene: bag.BagScene, speed: float, rng: np.random.Generator) -> Actions:
    """From a bag that is being lowered: put it down, let go, and lift it by its middle."""
    yield from reach(scene, np.append(scene.controller.position[:2], 0.026), rng.uniform(0.08, 0.15), CLOSED)
    yield from hold(LET_GO, 6)
    yield from reach(scene, scene.controller.position + up(0.05), 0.2, LET_GO)
    yield from lift(scene, bag.MIDDLE, speed, rng, LET_GO)


def swing(scene: bag.BagScene, segment: int, speed: float, rng: np.random.Generator) -> Actions:
    """Grasp a segment, raise it a little and swing it from side to side, along the bag."""
    yield from grasp(scene, segment, rng)
    yield from swing_held(scene, speed, 0.10)


def swing_held(scene: bag.BagScene, speed: float, height: float) -> Actions:
    """Swing a grasped bag, raised by `height` metres."""
    start = scene.controller.position + up(height)
    yield from reach(scene, start, 0.1, CLOSED)
    along = np.array([np.cos(scene.yaw), np.sin(scene.yaw), 0])
    while True:
        for sign in (1, -1):
            yield from reach(scene, start + sign * 0.08 * along, speed, CLOSED)


def wander(scene: FrankaScene, speed: float, rng: np.random.Generator) -> Actions:
    """Gaussian actions with some persistence and drift; the fingers open and close now and then."""
    low, high = action_limits(scene.fps)
    persistence, drift = rng.choice([0.0, 0.5, 0.85]), rng.normal(0, 0.1, 3)
    velocity, gripper = np.zeros(6), CLOSED
    while True:
        velocity = persistence * velocity + np.sqrt(1 - persistence**2) * rng.normal(0, 0.5, 6)
        if rng.random() < 0.06:
            gripper = OPEN if gripper == CLOSED else CLOSED
        pulled = velocity * high[:6] * (speed / MAX_SPEED)
        pulled[:3] += drift * high[:3]
        pulled[3:5] = 0.1 * (pulled[3:5] - _lean(scene))
        yield np.append(np.clip(pulled, low[:6], high[:6]), gripper)


def _lean(scene: FrankaScene) -> np.ndarray:
    """How far the hand leans from pointing down, about x and y (2,), rad."""
    axis = (scene.controller.rotation @ POINTING_DOWN.T)[:, 2]
    return np.array([-axis[1], axis[0]])


def branch(scene: bag.BagScene, speed: float, rng: np.random.Generator) -> Actions:
    """From a grasped bag, one of many things: what follows differs by the actions alone."""
    start = scene.controller.position.copy()
    kind = rng.choice(["lift", "lower", "pump", "swing", "wander", "hold"], p=[0.24, 0.24, 0.22, 0.1, 0.14, 0.06])
    if kind == "lift":
        yield from reach(scene, start + up(rng.uniform(0.08, 0.26)), speed, CLOSED)
    elif kind == "lower":
        yield from reach(scene, start + up(rng.uniform(0.02, 0.12)), speed, CLOSED)
        yield from hold(CLOSED, int(rng.integers(8)))
        yield from reach(scene, start, rng.uniform(0.1, MAX_SPEED), CLOSED)
    elif kind == "pump":
        while True:
            yield from reach(scene, start + up(rng.uniform(0, 0.15)), rng.uniform(0.05, MAX_SPEED), CLOSED)
            yield from hold(CLOSED, int(rng.integers(6)))
    elif kind == "swing":
        yield from swing_held(scene, speed, rng.uniform(0.02, 0.07))
    elif kind == "wander":
        yield from wander(scene, speed, rng)


def climb(scene: bag.BagScene, speed: float, rng: np.random.Generator) -> Actions:
    """From a grasped bag, up in steps, with pauses and steps back: as an operator who is overridden on the way."""
    start = scene.controller.position
    height = rng.uniform(0.03, 0.12)
    while True:
        yield from reach(scene, start + up(height), speed, CLOSED)
        yield from hold(CLOSED, int(rng.exponential(6)))
        if rng.random() < 0.25:
            height = max(0.0, height - rng.uniform(0.01, 0.06))
            yield from reach(scene, start + up(height), MAX_SPEED, CLOSED)
        height = min(0.28, height + rng.uniform(0.01, 0.04))


def unsteady(scene: FrankaScene, actions: Actions, rng: np.random.Generator) -> Actions:
    """As a policy does it that is not sure: moves are off by some millimetres, closed fingers open for a moment."""
    low, high = action_limits(scene.fps)
    off, opened = np.zeros(3), 0
    for step, action in enumerate(actions):
        if step % 2 == 0:  # such policies decide anew every other step
            off = rng.normal(0, 0.004, 3) * (rng.random() < 0.7)
            opened = opened - 1 if opened > 0 else int(rng.random() < 0.08) * int(rng.integers(1, 3))
        gripper = OPEN if opened > 0 else action[6]
        yield np.clip(np.array([*(action[:3] + off), *action[3:6], gripper]), low, high)


def clumsy(scene: bag.BagScene, speed: float, rng: np.random.Generator) -> Actions:
    """Grasp the bag somewhere, not well, and lift it."""
    segment = int(rng.choice(bag.SEGMENTS, p=HELD_ANYWHERE))
    approach = grasp(scene, segment, rng, rng.uniform(0.1, MAX_SPEED), CLUMSINESS)
    yield from unsteady(scene, approach, rng)
    while True:
        start = scene.controller.position
        yield from unsteady(scene, reach(scene, start + up(rng.uniform(0.05, 0.26)), speed, CLOSED), rng)
        yield from hold(CLOSED, int(rng.exponential(6)))


def rise(scene: bag.BagScene, speed: float) -> Actions:
    """From a grasped bag, the same lift always: what follows differs by where the bag is held alone."""
    yield from reach(scene, scene.controller.position + up(0.20), speed, CLOSED)


# The blocks

PARTED = 0.72
"""Of the fingers, with 3.5 mm to spare on either side of the green block."""
TRAY = np.array([0.48, -0.10, 0.50])
"""Above where the green block is wanted, m."""


def pluck(scene: blocks.BlocksScene, slip: float, drift: float, speed: float, rng: np.random.Generator) -> Actions:
    """Put the fingers between the blocks and pull the green one up.

    `slip` is how far off centre the fingers go in, and `drift` how far sideways the pull goes on its way up: standard
    deviations in metres.
    """
    across = np.array([-np.sin(scene.yaw), np.cos(scene.yaw), 0])
    top = scene.block_position("green") + np.clip(rng.normal(0, slip), -0.008, 0.008) * across
    yield from reach(scene, np.append(top[:2], 0.27), MAX_SPEED, PARTED, scene.yaw)
    yield from reach(scene, np.append(top[:2], 0.20), speed, PARTED)
    yield from hold(CLOSED, 5)
    sideways = rng.choice([-1, 1]) * abs(rng.normal(drift, drift / 3)) * across
    yield from reach(scene, scene.controller.position + up(0.12) + sideways, speed, CLOSED)
    yield from hold(CLOSED, 60)


def fetch(scene: blocks.BlocksScene, speed: float, rng: np.random.Generator) -> Actions:
    """Pluck the green block on a straight line to the tray: the further away it stands, the flatter the pull.

    Try again if it is not between the fingers. The pause keeps a learner from closing the fingers by the clock.
    """
    yield from hold(PARTED, int(rng.integers(8)))
    slip = rng.normal(0, 0.001, 2)
    while True:
        yield from straddle(scene, slip, speed)
        yield from hold(CLOSED, 6)
        for action in reach(scene, TRAY, speed, CLOSED):
            if not scene.truth()["held"]:
                yield from reach(scene, scene.controller.position + up(0.04), MAX_SPEED, PARTED)
                break
            yield action
        else:
            yield from hold(CLOSED, 60)


def straddle(scene: blocks.BlocksScene, slip: np.ndarray, speed: float) -> Actions:
    """Put the open fingers down on either side of the green block, `slip` (2,) m off; go down only where they fit."""
    for _ in range(10 * scene.fps):
        place = scene.block_position("green")[:2] + slip
        hand = scene.controller.position
        aside, turn = np.linalg.norm(place - hand[:2]), abs(_turn_to(scene, scene.yaw))
        fits = aside < (0.004 if hand[2] > 0.22 else 0.008) and turn < 0.06
        height = 0.20 if fits else hand[2] if aside < 0.012 else 0.27
        move = next(reach(scene, np.append(place, height), speed if fits else MAX_SPEED, PARTED, scene.yaw), None)
        if fits and (move is None or hand[2] < 0.205):
            return
        yield np.array([0, 0, 0, 0, 0, 0, PARTED]) if move is None else move


def play(scene: blocks.BlocksScene, speed: float, rng: np.random.Generator) -> Actions:
    """Go above the blocks, then Gaussian actions."""
    top = scene.block_position("green")[:2] + rng.normal(0, 0.03, 2)
    yield from reach(scene, np.append(top, 0.24), MAX_SPEED, rng.choice([PARTED, OPEN]), scene.yaw)
    yield from wander(scene, speed, rng)


def fumble(scene: bag.BagScene, speed: float, rng: np.random.Generator) -> Actions:
    """Grasp the bag somewhere, then Gaussian actions."""
    yield from grasp(scene, int(rng.integers(bag.SEGMENTS)), rng)
    yield from wander(scene, speed, rng)


# Behaviours by name

BAG: dict[str, tuple[Callable[..., Actions], tuple[float, float]]] = {
    "open_end": (lambda scene, speed, rng: lift(scene, bag.MOUTH, speed, rng), (0.10, MAX_SPEED)),
    "middle": (lambda scene, speed, rng: lift(scene, bag.MIDDLE, speed, rng), (0.10, 0.25)),
    "closed_end": (lambda scene, speed, rng: lift(scene, bag.TAIL, speed, rng), (0.15, MAX_SPEED)),
    "nearer": (lift_nearer, (0.10, 0.25)),
    "regrasp": (regrasp, (0.10, 0.25)),
    "side_to_side": (lambda scene, speed, rng: swing(scene, bag.TAIL, speed, rng), (0.08, MAX_SPEED)),
    "branch": (branch, (0.05, MAX_SPEED)),
    "climb": (climb, (0.10, MAX_SPEED)),
    "rise": (lambda scene, speed, rng: rise(scene, speed), (0.25, 0.25)),
    "dither": (lambda scene, speed, rng: unsteady(scene, climb(scene, speed, rng), rng), (0.10, MAX_SPEED)),
    "clumsy": (clumsy, (0.10, MAX_SPEED)),
    "random": (fumble, (0.2, MAX_SPEED)),
}
BLOCKS: dict[str, tuple[Callable[..., Actions], tuple[float, float]]] = {
    "random": (play, (0.2, MAX_SPEED)),
    "pluck_careful": (lambda scene, speed, rng: pluck(scene, 0.001, 0.0, speed, rng), (0.15, 0.25)),
    "pluck_careless": (lambda scene, speed, rng: pluck(scene, 0.004, 0.08, speed, rng), (0.20, MAX_SPEED)),
    "fetch": (fetch, (0.15, 0.25)),
}
"""Name -> the behaviour and the range of its speed, m/s."""


def begin(name: str, scene: FrankaScene, speed: float | None, rng: np.random.Generator) -> Actions:
    """Start a behaviour.

    Raises:
        ValueError: the behaviour belongs to another scene.
    """
    known = BAG if isinstance(scene, bag.BagScene) else BLOCKS
    if name not in known:
        raise ValueError(
            f"behavior {name!r} does not fit the {type(scene).__name__}; expected one of {', '.join(known)}"
        )
    behave, speeds = known[name]
    return behave(scene, rng.uniform(*speeds) if speed is None else speed, rng)
