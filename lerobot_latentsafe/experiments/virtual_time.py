"""A clock for LeRobot's loops, by which nothing is late, however slow the machine is."""

import threading
import time


class VirtualTime:
    """Time that passes while the thread that made it sleeps, at once, and not while it computes."""

    def __init__(self) -> None:
        self.now, self.thread, self.wait = 1000.0, threading.get_ident(), time.sleep

    def perf_counter(self) -> float:
        """Seconds; a look takes a microsecond, so that a loop that waits for a time ends."""
        self.sleep(1e-6)
        return self.now

    def sleep(self, seconds: float) -> None:
        """Let time pass; other threads wait in earnest."""
        if threading.get_ident() == self.thread:
            self.now += seconds
        else:
            self.wait(seconds)
