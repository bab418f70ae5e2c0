"""The best that a filter could do: it knows the simulator, branches it, and looks what would come."""

from collections.abc import Iterator

import numpy as np

from lerobot_latentsafe.franka.actions import GRIPPER_WIDTH, action_limits
from lerobot_latentsafe.franka.scene import FrankaScene, SceneState


class SimulatorLookahead:
    """Passes an action if some retreat after it keeps the scene from failing for a while, else retreats itself.

    A privileged bound: no learned filter of the same retreats can tell more from any observation.

    Args:
        scene: the simulation that is filtered; it is branched, and restored exactly.
        horizon: steps for which a retreat must avoid failure.
    """

    def __init__(self, scene: FrankaScene, horizon: int = 20):
        self.scene, self.horizon = scene, horizon

    def __call__(self, proposed: np.ndarray) -> tuple[np.ndarray, bool]:
        """The action to execute (7,) in robot units, and whether it is a retreat."""
        here = self.scene.get_state()
        self.scene.step(proposed)
        after = self.scene.get_state()
        harmless = self._margin() >= 0 and any(self._outcome(after, a) >= 0 for a in self.retreats())
        self.scene.set_state(here)
        if harmless:
            return proposed, False
        retreat = max(self.retreats(), key=lambda action: self._outcome(here, action))
        self.scene.set_state(here)
        return retreat, True

    def retreats(self) -> Iterator[np.ndarray]:
        """Actions (7,) worth holding: stay, up, down, back and forth along each axis, let go; the likeliest first."""
        grip = 2 * self.scene.controller.finger / GRIPPER_WIDTH
        reach = action_limits(self.scene.fps)[1][:3]
        for direction in ((0, 0, 0), (0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)):
            yield np.array([*(0.5 * reach * direction), 0, 0, 0, grip])
        yield np.array([0, 0, 0, 0, 0, 0, 1.0])

    def _outcome(self, state: SceneState, action: np.ndarray) -> float:
        """The least margin while an action is held from a state; negative as soon as it fails."""
        self.scene.set_state(state)
        least = np.inf
        for _ in range(self.horizon):
            self.scene.step(action)
            least = min(least, self._margin())
            if least < 0:
                break
        return least

    def _margin(self) -> float:
        return float(self.scene.truth()["margin"])
