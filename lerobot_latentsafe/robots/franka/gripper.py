"""The hand takes whole motions, not a stream: it is told when the wish has changed, and once more if nothing moves."""

import logging

from lerobot_latentsafe.franka.actions import GRIPPER_WIDTH
from lerobot_latentsafe.robots.franka.checked import CheckedDriver

logger = logging.getLogger(__name__)

CHANGED = 0.05
"""Share of the opening by which a wish must differ from the last."""
PATIENCE_S = 2.0
"""Within which the fingers have moved: more than twice the time of the longest way."""
MOVED, REACHED = 0.002, 0.01
"""m."""


class Gripper:
    """The fingers' last wish, and what became of it.

    Args:
        width: opening now, m.
    """

    def __init__(self, driver: CheckedDriver, width: float):
        self.driver, self.wish = driver, width / GRIPPER_WIDTH
        self._from, self._since, self._told = width, 0.0, 0  # in m, in s, times until it moves

    def follow(self, wish: float, width: float, now: float) -> None:
        """Have an opening from 0 to 1, given the measured width in m and the time in s."""
        if abs(wish - self.wish) > CHANGED:
            self._tell(wish, width, now, 1)
        elif self._told == 1 and now - self._since > PATIENCE_S:
            self._told = 0
            if abs(width - self._from) < MOVED and abs(width - self.wish * GRIPPER_WIDTH) > REACHED:
                logger.warning(
                    "the gripper was told %.3f m and stays at %.3f m: told again. Is something between the fingers, "
                    "or is it stuck?", self.wish * GRIPPER_WIDTH, width,
                )  # fmt: skip
                self._tell(self.wish, width, now, 2)

    def _tell(self, wish: float, width: float, now: float, times: int) -> None:
        self.driver.move_gripper(wish * GRIPPER_WIDTH)
        self.wish, self._from, self._since, self._told = wish, width, now, times
