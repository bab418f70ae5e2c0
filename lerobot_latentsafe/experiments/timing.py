"""What the benchmarks share: functions timed in turn, and spreads of their times."""

import statistics
import time
from collections.abc import Callable


def cpu_seconds(function: Callable[[], object]) -> float:
    """User and system CPU seconds of a call."""
    began = time.process_time()
    function()
    return time.process_time() - began


def spread(values: list[float]) -> dict[str, float]:
    """Median and range."""
    return {"median": statistics.median(values), "low": min(values), "high": max(values)}


def ratio(slow: list[float], fast: list[float]) -> dict[str, float]:
    """How many times the one is the other, run by run next to each other: median and range."""
    return spread([a / b for a, b in zip(slow, fast)])
