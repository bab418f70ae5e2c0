"""Work in threads of its own, with a time limit: whoever waits goes on in time, whatever becomes of the work."""

import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import torch


class Worker:
    """A thread that does one thing after the other, and that never keeps a program from ending as a pool's would."""

    def __init__(self, name: str):
        self._asked: queue.SimpleQueue = queue.SimpleQueue()
        threading.Thread(target=_serve, args=(self._asked,), daemon=True, name=name).start()

    def submit(self, work: Callable[..., Any], *given: Any) -> Future:
        """The future result of some work."""
        future: Future = Future()
        self._asked.put((future, work, given))
        return future


def _serve(asked: queue.SimpleQueue) -> None:
    while True:
        future, work, given = asked.get()
        try:
            future.set_result(work(*given))
        except BaseException as e:  # SystemExit, too: whoever asked decides
            future.set_exception(e)
        del future, work, given  # nothing is kept alive while there is nothing to do


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
        return self._last is not None and not self._last.done()

    def __call__(self, work: Callable[[], Any], seconds: float) -> Any:
        """The result of the work.

        Raises:
            TimeoutError: it took longer, or earlier work has not ended yet.
            BaseException: what the work raised.
        """
        if self.busy:
            raise TimeoutError("what was asked before has not ended yet")
        self._worker = self._worker or Worker("time-limit")
        self._last = self._worker.submit(_as_here(work, self.device_type))
        return self._last.result(timeout=max(seconds, 0.0))


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
