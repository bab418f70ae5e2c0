"""Work in threads of its own, with a time limit: whoever waits goes on in time, whatever becomes of the work."""

import queue
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Any

import torch


class Worker:
    """A thread that does one thing after the other, and that never keeps a program from ending as a pool's would.

    It ends when nobody has the worker any more.
    """

    def __init__(self, name: str):
        self._asked: queue.SimpleQueue = queue.SimpleQueue()
        self._thread = threading.Thread(target=_serve, args=(self._asked,), daemon=True, name=name)
        self._thread.start()
        weakref.finalize(self, self._asked.put, None)

    @property
    def alive(self) -> bool:
        """Whether the thread is there: in a forked process it is not."""
        return self._thread.is_alive()

    def submit(self, work: Callable[..., Any], *given: Any) -> Future:
        """The future result of some work."""
        future: Future = Future()
        self._asked.put((future, work, given))
        return future


def _serve(asked: queue.SimpleQueue) -> None:
    while _settled(asked.get()):  # nothing is kept alive while there is nothing to do
        pass


def _settled(asked: tuple[Future, Callable[..., Any], tuple] | None) -> bool:
    if asked is not None:
        _settle(*asked)
    return asked is not None


def _settle(future: Future, work: Callable[..., Any], given: tuple = ()) -> None:
    try:
        future.set_result(work(*given))
    except BaseException as e:  # SystemExit, too: whoever asked decides
        future.set_exception(e)


def contained[Answer](work: Callable[[], Answer], what: str = "it") -> Answer:
    """What some work returns. What would end the program is an error like any other; only Ctrl-C goes through.

    Args:
        what: the work's name in errors.

    Raises:
        RuntimeError: it raised what is no `Exception`, such as SystemExit or GeneratorExit.
        Exception, KeyboardInterrupt: it raised that.
    """
    try:
        return work()
    except (Exception, KeyboardInterrupt):
        raise
    except BaseException as e:
        raise RuntimeError(f"{what} raised {type(e).__name__}") from e


def in_time[Answer](call: Callable[[], Answer], seconds: float, what: str) -> Answer:
    """What a call returns, if it returns within so many seconds; calls do not wait for each other.

    It runs in a thread of its own, as no call can be ended from outside: one that is late goes on alone, and nobody
    hears what it returns.

    Args:
        what: the call's name in errors.

    Raises:
        TimeoutError: it took longer.
        RuntimeError: it wanted to end the program.
        Exception: whatever else it raised.
    """
    answer: Future[Answer] = Future()
    given = (answer, contained, (call, what))
    threading.Thread(target=_settle, args=given, daemon=True, name=f"in-time-{what}").start()
    if not wait([answer], seconds).done:
        raise TimeoutError(f"{what} did not end within {seconds:.3g} s")
    return answer.result()


class TimeLimit:
    """Does one thing at a time in another thread, and waits for it no longer than it is told.

    What takes longer goes on, and its result is dropped; until it has ended, everything else is refused as late. What
    torch keeps by thread (gradients, inference mode, autocast, number of threads) is as where the work is asked for.
    """

    def __init__(self, device_type: str = "cpu"):
        self.device_type = device_type
        self._worker: Worker | None = None
        self._last: Future | None = None

    def __getstate__(self) -> dict[str, Any]:
        """A copy has a thread of its own."""
        return {"device_type": self.device_type, "_worker": None, "_last": None}

    @property
    def busy(self) -> bool:
        """Whether earlier work has not ended yet."""
        return self._last is not None and not self._last.done() and self._worker is not None and self._worker.alive

    def __call__[Answer](self, work: Callable[[], Answer], seconds: float | None) -> Answer:
        """The result of the work, `contained`.

        Args:
            seconds: to wait at most; None: it is done here, however long it takes.

        Raises:
            TimeoutError: it took longer, or earlier work has not ended yet.
            RuntimeError: it wanted to end the program.
            Exception, KeyboardInterrupt: it raised that.
        """
        if self.busy:
            raise TimeoutError("what was asked before has not ended yet")
        if seconds is None:
            return contained(work)
        if self._worker is None or not self._worker.alive:
            self._worker = Worker("time-limit")
        self._last = answer = self._worker.submit(contained, _as_here(work, self.device_type))
        limit = min(seconds, threading.TIMEOUT_MAX) if seconds > 0 else 0.0  # of a time that is no number none is left
        if not wait([answer], limit).done:
            raise TimeoutError(f"it did not end within {limit:.3g} s")
        return answer.result()


def _as_here(work: Callable[[], Any], device_type: str) -> Callable[[], Any]:
    """Work that finds torch's modes as they are in this thread."""
    inference, gradients = torch.is_inference_mode_enabled(), torch.is_grad_enabled()
    threads = torch.get_num_threads()  # OpenMP has a number for each thread
    mixed, dtype = torch.is_autocast_enabled(device_type), torch.get_autocast_dtype(device_type)

    def work_there() -> Any:
        if torch.get_num_threads() != threads:
            torch.set_num_threads(threads)
        mode = torch.inference_mode() if inference else torch.set_grad_enabled(gradients)
        with mode, torch.autocast(device_type, dtype, enabled=mixed):
            return work()

    return work_there
