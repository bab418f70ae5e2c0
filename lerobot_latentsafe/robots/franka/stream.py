"""The thread that leads the arm: it sends interpolated poses, and holds when no action comes."""

import logging
import threading
import time

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from lerobot_latentsafe.robots.franka.checked import CheckedDriver
from lerobot_latentsafe.robots.franka.driver import ArmFaultError, FrankaError, GripperError
from lerobot_latentsafe.robots.franka.limits import Pose, shortest_time

logger = logging.getLogger(__name__)

STREAM_HZ = 200


class Stream(threading.Thread):
    """Sends interpolated poses to the driver. Whatever goes wrong in it stops the arm, and `check` tells.

    Its lock is never held while the driver is asked: nobody waits for an arm that does not answer.

    Args:
        pose: where the arm is.
        period: one control step, s.
        watchdog: without a new target for this long the arm holds where it is, s.

    Attributes:
        error: what stopped it.
    """

    def __init__(self, driver: CheckedDriver, pose: Pose, period: float, watchdog: float):
        super().__init__(daemon=True, name="franka-stream")
        self.driver, self.period, self.watchdog = driver, period, watchdog
        self.error: Exception | None = None
        self._lock, self._stopping = threading.Lock(), threading.Event()
        self._from = self._to = pose
        self._lasts = period
        self._since = self._sent = time.monotonic()
        self._holds = True

    def check(self) -> None:
        """Nothing, as long as the arm is led.

        Raises:
            FrankaError, GripperError: what stopped it; or the thread hangs or is gone.
        """
        if self.error is not None:
            raise self.error
        sent = self._sent
        silent = time.monotonic() - sent
        if not self.is_alive() or not 0 <= silent <= self.watchdog:
            raise ArmFaultError(f"no pose was sent to the arm for {silent:.2f} s; its stream hangs or has ended")

    def target(self) -> Pose:
        """The pose commanded last."""
        with self._lock:
            return self._to

    def set_target(self, pose: Pose) -> None:
        """Reach a pose within one control step from now, or later where that were faster than the speed limit."""
        with self._lock:
            self._from, self._to = self._now(), pose
            self._lasts = max(self.period, shortest_time(self._from, pose))
            self._since, self._holds = time.monotonic(), False

    def _now(self) -> Pose:
        share = np.clip((time.monotonic() - self._since) / self._lasts, 0, 1)
        (p0, r0), (p1, r1) = self._from, self._to
        return Pose(p0 + share * (p1 - p0), Slerp([0, 1], Rotation.concatenate([r0, r1]))(share))

    def run(self) -> None:
        """Until it is stopped, or something goes wrong."""
        try:
            while not self._stopping.wait(1 / STREAM_HZ):
                self._watch()
                with self._lock:
                    pose = self._now()
                self.driver.track(*pose)
                self._sent = time.monotonic()
        except BaseException as e:  # raised again by whoever acts next
            self._fail(e)

    def _fail(self, error: BaseException) -> None:
        if not isinstance(error, FrankaError | GripperError):
            error = ArmFaultError(f"the arm's stream failed ({type(error).__name__}: {error})")
        self.error = error
        logger.error("the arm stops: %s", error)
        try:
            self.driver.stop()
        except FrankaError as e:
            logger.error("the arm does not confirm that it stops (%s); press the user stop if it moves", e)

    def _watch(self) -> None:
        """Hold where the arm is once no action has come for too long."""
        if self._holds or self._in_time():
            return
        logger.warning("no action for %.2f s: holding", self.watchdog)
        state = self.driver.state()
        with self._lock:
            if not self._in_time():  # no action came while the arm was asked
                self._from = self._to = Pose(state.position, state.rotation)
                self._holds = True

    def _in_time(self) -> bool:
        since = self._since
        return 0 <= time.monotonic() - since <= self.watchdog

    def stop(self) -> None:
        """End the thread, unless it hangs in a call."""
        self._stopping.set()
        self.join(timeout=self.watchdog)
