"""Somebody else intervenes in a recording: what comes of holding still and of lowering is to be seen, too."""

from dataclasses import dataclass

import numpy as np

CLOSING = 0.5
"""Command of the fingers below which they are to hold something; nobody intervenes before."""


@dataclass(frozen=True)
class InterventionStyle:
    """What an intervention is like, each drawn anew.

    Attributes:
        chance: that one begins at a step.
        steps: fewest, and one more than the most, steps that it is asked to last, of which the last is the operator's.
        down: share in which the robot is lowered; in the others it holds still.
        speed: slowest and fastest, as shares of the largest vertical motion.
    """

    chance: float
    steps: tuple[int, int]
    down: float
    speed: tuple[float, float]


BRIEF = InterventionStyle(chance=0.06, steps=(2, 13), down=0.6, speed=(0.2, 1.0))
RARE = InterventionStyle(chance=0.012, steps=(4, 31), down=0.3, speed=(0.15, 0.5))
"""About one an episode, most of which hold still."""
RETREATING = InterventionStyle(chance=0.05, steps=(4, 41), down=0.7, speed=(0.15, 0.5))
"""Slow enough not to shake out what is held, and long enough to come down with it."""


class Interventions:
    """Takes over for some steps, with the fingers left as they are.

    Args:
        style: what an intervention is like.
        limits: of an action, least and largest (7,).
        rng: source of all draws.
    """

    def __init__(self, style: InterventionStyle, limits: tuple[np.ndarray, np.ndarray], rng: np.random.Generator):
        self.style, self.limits, self.rng = style, limits, rng
        self.left, self.motion, self.gripper = 0, np.zeros(6), 1.0

    def __call__(self, action: np.ndarray, begin: bool | None = None) -> tuple[np.ndarray, bool]:
        """What is executed (7,), and whether that is the intervention's.

        Args:
            action: what the operator does, (7,).
            begin: whether one begins, if none goes on; None: by chance, and while the fingers close only.
        """
        if self.left == 0 and self._begins(begin):
            self.left = int(self.rng.integers(*self.style.steps))
            down = self.rng.random() < self.style.down
            self.motion = np.array([0, 0, down * self.rng.uniform(*self.style.speed) * self.limits[0][2], 0, 0, 0])
        self.left = max(0, self.left - 1)
        if self.left:
            action = np.append(self.motion, self.gripper)
        self.gripper = action[6]
        return action, self.left > 0

    def _begins(self, begin: bool | None) -> bool:
        if begin is not None:
            return begin
        return self.gripper < CLOSING and self.rng.random() < self.style.chance
