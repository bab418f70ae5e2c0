"""How somebody with a leader arm pushes the cube, written as generators of joint targets (6,).

They see the scene's truth; a policy that learns from them sees pictures. Hands are unsteady, and so are their targets.
"""

from collections.abc import Callable, Iterator

import numpy as np

from lerobot_latentsafe.so101.actions import FPS, PITCH, OutOfReachError, joints_for
from lerobot_latentsafe.so101.scene import EDGE, HALF_CUBE, PushScene

Targets = Iterator[np.ndarray]

DOWN, BEHIND = 0.014, 0.165
"""Height of the tip while it pushes, and its distance from the arm before, m."""
FARTHEST, NEAREST = 0.352, 0.145
"""Between these distances from the arm the tip stays, m."""
OVERSHOOT = 0.055
"""How far past the mark the reckless push, m."""
LAG = 0.09
"""Time by which the arm comes after its targets, and the hand after the eye, s."""
CLOSED = 2.0
"""Of the gripper."""


class Hand:
    """Where the operator wants the tip: azimuth in degrees, distance from the arm and height in m; and the pitch."""

    def __init__(self, pitch: float):
        self.tip = np.array([0.0, 0.14, 0.06])
        self.pitch = pitch

    def targets(self) -> np.ndarray:
        """(6,) joints in degrees, gripper closed."""
        return np.array([*joints_for(self.tip, self.pitch), 0.0, CLOSED])

    def reach(self, azimuth: float, distance: float, height: float, speed: float) -> Targets:
        """Straight to a place at a speed in m/s."""
        goal = np.array([azimuth, distance, height])
        metres = np.array([np.radians(1) * BEHIND, 1, 1])
        n = max(1, round(float(np.linalg.norm((goal - self.tip) * metres)) / speed * FPS))
        for move in np.linspace(self.tip, goal, n + 1)[1:]:
            self.tip = move
            yield self.targets()

    def wait(self, steps: int) -> Targets:
        """Stay."""
        for _ in range(steps):
            yield self.targets()

    def slide(self, speed: float) -> np.ndarray:
        """One step outwards, or back, along the table."""
        self.tip[1] = np.clip(self.tip[1] + speed / FPS, NEAREST, FARTHEST)
        return self.targets()


def approach(scene: PushScene, hand: Hand, speed: float) -> Targets:
    """Put the tip down behind the cube, in line with it."""
    x, y, _ = scene.cube_position()
    azimuth = float(np.degrees(np.arctan2(y, x)))
    yield from hand.reach(azimuth, BEHIND, 0.05, speed)
    yield from hand.reach(azimuth, BEHIND, DOWN, speed)


def push_to(scene: PushScene, hand: Hand, place: float, speed: float) -> Targets:
    """Slide outwards until the cube is so far ahead of the arm, or would be if it still stood on the table, m."""
    while hand.tip[1] < FARTHEST:
        touching = float(scene.tip_position()[0]) + HALF_CUBE
        if max(float(scene.cube_position()[0]) if touching < EDGE else 0.0, touching) + LAG * speed >= place:
            return
        yield hand.slide(speed)


def push(scene: PushScene, past: float, speed: float, rng: np.random.Generator) -> Targets:
    """Push the cube so far past the mark, and take the hand back a little."""
    hand = Hand(PITCH + rng.normal(0, 1.5))
    yield from hand.wait(int(rng.integers(12)))
    yield from approach(scene, hand, rng.uniform(0.12, 0.2))
    yield from push_to(scene, hand, scene.mark + past - 0.015, speed)
    yield from push_to(scene, hand, scene.mark + past, min(speed, 0.04))
    yield from hand.wait(int(rng.integers(4, 10)))
    azimuth, distance, _ = hand.tip
    yield from hand.reach(azimuth, distance - 0.02, DOWN + 0.01, 0.08)


def dally(scene: PushScene, speed: float, rng: np.random.Generator) -> Targets:
    """Push by fits and starts to anywhere, also over the edge: stop, wait, go back, go on. Shows what each comes to."""
    hand = Hand(PITCH + rng.normal(0, 1.5))
    yield from approach(scene, hand, rng.uniform(0.12, 0.25))
    while True:
        here = float(scene.tip_position()[0]) + HALF_CUBE
        place = rng.uniform(EDGE - 0.03, EDGE + 0.01) if rng.random() < 0.6 else rng.uniform(0.22, EDGE + 0.04)
        if place > here:
            yield from push_to(scene, hand, place, speed)
        yield from hand.wait(int(rng.exponential(8)))
        if rng.random() < 0.5:
            azimuth, distance, height = hand.tip
            back = max(distance - rng.uniform(0.005, 0.06), NEAREST + 0.01)
            yield from hand.reach(azimuth, back, height, rng.uniform(0.03, 0.2))
        speed = rng.uniform(*SPEEDS["dally"])


def halting(targets: Targets, rng: np.random.Generator) -> Targets:
    """The same, but now and then the arm is held where it is told to be, or goes back, as under a filter."""
    last: list[np.ndarray] = []
    for wanted in targets:
        if last and rng.random() < 0.03:
            held, since = last[-1], last[-int(rng.integers(1, 16)) :]
            steps = int(rng.integers(3, 25))
            yield from [*since[::-1], *[since[0]] * steps] if rng.random() < 0.4 else [held] * steps
        last = [*last[-30:], wanted]
        yield wanted


def wander(scene: PushScene, speed: float, rng: np.random.Generator) -> Targets:
    """Behind the cube and around it, out, back, aside, up and down at random."""
    hand = Hand(PITCH + rng.normal(0, 3))
    yield from approach(scene, hand, 0.2)
    velocity = np.zeros(3)
    while True:
        velocity = 0.9 * velocity + rng.normal(0, 0.45, 3) * np.array([60.0, 1.0, 0.25]) * speed
        outwards = np.array([0, 0.25 * speed, 0])
        tip, before = hand.tip + (velocity + outwards) / FPS, hand.tip
        hand.tip = np.clip(tip, [-25, NEAREST + 0.005, DOWN - 0.002], [25, FARTHEST, 0.06])
        try:
            yield hand.targets()
        except OutOfReachError:
            hand.tip, velocity = before, -velocity


def unsteady(targets: Targets, rng: np.random.Generator) -> Targets:
    """As a hand moves a leader arm: smoothed, and off by some tenths of a degree that come and go."""
    off, smooth, scale = np.zeros(6), None, np.array([0.2, 0.35, 0.35, 0.35, 0.5, 0.4])
    for wanted in targets:
        smooth = wanted if smooth is None else 0.5 * smooth + 0.5 * wanted
        off = 0.9 * off + rng.normal(0, np.sqrt(1 - 0.9**2), 6) * scale
        yield smooth + off


SPEEDS = {"careful": (0.05, 0.08), "reckless": (0.07, 0.11), "dally": (0.03, 0.14), "wander": (0.1, 0.3)}
"""Of the motion that matters, m/s."""
BEHAVIORS: dict[str, Callable[[PushScene, float, np.random.Generator], Targets]] = {
    "careful": lambda scene, speed, rng: push(scene, 0.0, speed, rng),
    "reckless": lambda scene, speed, rng: push(scene, OVERSHOOT, speed, rng),
    "dally": dally,
    "wander": wander,
}


def begin(name: str, scene: PushScene, rng: np.random.Generator, interrupted: bool = False) -> Targets:
    """Start a behaviour; `interrupted`: as if somebody held the arm now and then."""
    targets = BEHAVIORS[name](scene, rng.uniform(*SPEEDS[name]), rng)
    return unsteady(halting(targets, rng) if interrupted else targets, rng)
