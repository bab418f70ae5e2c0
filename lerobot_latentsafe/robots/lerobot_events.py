"""Events of LeRobot's loops, seen in which of them is calling: no call tells a robot that an episode begins.

What they log is no ground to decide on: any library may log the same, and a user may silence it.
"""

from lerobot_latentsafe._compat import Loop, calling_loop


class LeRobotEvents:
    """Notices when LeRobot begins or ends an episode; ask it in every call that LeRobot's loops make."""

    def __init__(self) -> None:
        self._last: Loop | None = None

    def take(self) -> Loop | None:
        """The loop that is calling, if it is another than the one that called last; None also if none of them is."""
        loop = calling_loop()
        if loop is None or loop == self._last:
            return None
        self._last = loop
        return loop

    @property
    def between_episodes(self) -> bool:
        """Whether the very call comes from a loop that moves a robot between episodes."""
        loop = calling_loop()
        return loop is not None and loop.episode is None
