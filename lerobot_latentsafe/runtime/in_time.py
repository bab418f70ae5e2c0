"""Calls that end in time, whatever is called."""

import queue
import threading
from collections.abc import Callable


def in_time[Answer](call: Callable[[], Answer], seconds: float, what: str) -> Answer:
    """What a call returns, if it returns within so many seconds.

    It runs in a thread of its own, as no call can be ended from outside: one that is late goes on alone, and nobody
    hears what it returns.

    Args:
        what: the call's name in errors.

    Raises:
        TimeoutError: it took longer.
        RuntimeError: it wanted to end the program.
        Exception: whatever else it raised.
    """
    answers: queue.SimpleQueue[tuple[Answer | None, BaseException | None]] = queue.SimpleQueue()

    def run() -> None:
        try:
            answers.put((call(), None))
        except BaseException as e:
            answers.put((None, e))

    threading.Thread(target=run, daemon=True, name=f"in-time-{what}").start()
    try:
        answer, error = answers.get(timeout=seconds)
    except queue.Empty:
        raise TimeoutError(f"{what} did not end within {seconds:.3g} s") from None
    if error is None:
        return answer  # type: ignore[return-value]  # what a call that raised nothing returned
    if isinstance(error, Exception):
        raise error
    raise RuntimeError(f"{what} raised {type(error).__name__}") from error
