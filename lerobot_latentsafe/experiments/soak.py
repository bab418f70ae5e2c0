"""A shielded robot for many ticks, with a fault every now and then: nothing passes, and memory stays as it is.

The arm is a stand-in that goes where it is told, its filter has random weights and finds everything safe that is not
faulty. Time is virtual: it passes a period a tick, and where a fault lets it pass.
"""

import gc
import logging
import math
import os
import random
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import psutil

from lerobot_latentsafe.decision import LawOptions, Reason
from lerobot_latentsafe.evaluation.faults import BROKEN
from lerobot_latentsafe.experiments.standin import FPS, NAMES, STEP, StandIn, StandInConfig, stand_in_filter
from lerobot_latentsafe.robots.shielded.config_shielded import LatentSafeShieldedConfig
from lerobot_latentsafe.robots.shielded.shielded import LatentSafeShielded
from lerobot_latentsafe.runtime.hub import save_policy

EVERY, EPISODE, SAMPLES = 100, 1000, 20
"""Ticks from fault to fault, ticks of an episode, and times that memory is looked at."""


# -- faults ---


class Clock:
    """Virtual time, seconds."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def after(self, seconds: float, value: Any) -> Any:
        """A value that took so long."""
        self.now += seconds
        return value


def _shows(name: str, change: Callable[[Any], Any]) -> Callable[[dict], dict]:
    """A robot that shows something else; ... leaves it out."""

    def alter(seen: dict) -> dict:
        changed = {**seen, name: change(seen[name])}
        return {name: value for name, value in changed.items() if value is not ...}

    return alter


JOINT, CAMERA = NAMES[0], "front"
READINGS: dict[str, Callable[[dict], dict]] = {
    "a joint that is no number": _shows(JOINT, lambda x: math.nan),
    "a joint of 1e30": _shows(JOINT, lambda x: 1e30),
    "a joint that leaps": _shows(JOINT, lambda x: x + 50),
    "a joint in words": _shows(JOINT, lambda x: "0.3"),
    "no joint": _shows(JOINT, lambda x: ...),
    "no camera": _shows(CAMERA, lambda x: ...),
    "no picture": _shows(CAMERA, lambda x: None),
    "a black picture": _shows(CAMERA, np.zeros_like),
    "a lens cap": _shows(CAMERA, lambda x: np.random.randint(0, 3, x.shape).astype(np.uint8)),
    "a grey picture": _shows(CAMERA, lambda x: x[:, :, 0]),
    "a picture of floats": _shows(CAMERA, lambda x: x / 255.0),
    "a picture of another size": _shows(CAMERA, lambda x: x[:8, :8]),
    "no observation": lambda seen: None,
}
ACTIONS: dict[str, Callable[[dict], Any]] = {
    "a command that is None": lambda action: {**action, JOINT: None},
    "a command in words": lambda action: {**action, JOINT: "1"},
    "a command that is no number": lambda action: {**action, JOINT: math.nan},
    "a command of 1e9": lambda action: {**action, JOINT: 1e9},
    "a command that jumps": lambda action: {**action, JOINT: action[JOINT] + 25},
    "no command of a joint": lambda action: {name: x for name, x in action.items() if name != JOINT},
    "commands of other names": lambda action: {"x.vel": 1.0},
    "no action": lambda action: None,
}


@contextmanager
def _reads(arm: StandIn, read: Callable[[], Any]) -> Iterator[None]:
    arm.get_observation = read  # type: ignore[method-assign]
    try:
        yield
    finally:
        del arm.get_observation


def _fails() -> dict:
    raise TimeoutError("the camera did not answer")


FAULTS = (
    *READINGS,
    *ACTIONS,
    *BROKEN,
    "a robot that is not read",
    "a reading that takes a second",
    "a tick that is late",
)


# -- the loop ---


def soak(n_ticks: int, seed: int = 0) -> dict[str, Any]:
    """Drive a shielded robot.

    Returns:
        ticks, faults; `passed_with_fault` and `out_of_range`, which must be 0; `passed_healthy`, the share of ticks
        without a fault that passed; what came of the faults; and along the way the resident memory in MB, the open
        files and the threads.
    """
    logging.disable(logging.CRITICAL)
    count: Counter[str] = Counter()
    draw, clock = random.Random(seed), Clock()
    usage: dict[str, list[float]] = {"memory_mb": [], "open_files": [], "threads": []}
    with TemporaryDirectory() as folder:
        save_policy(stand_in_filter(), Path(folder))
        law = LawOptions(epsilon=-2.0)
        options = LatentSafeShieldedConfig(inner=StandInConfig(), filter=folder, law=law)
        robot = LatentSafeShielded(options)
    robot.filter.shield.clock = clock
    for t in range(n_ticks):
        if t % EPISODE == 0:
            robot.disconnect()
            robot.connect()
        fault = draw.choice(FAULTS) if t % EVERY == EVERY - 1 else None
        _tick(robot, clock, t, fault, count)
        if (t + 1) % max(1, n_ticks // SAMPLES) == 0:
            _look_at_memory(usage)
    logging.disable(logging.NOTSET)
    faults = sum(n for name, n in count.items() if name in FAULTS)
    came = {name.removeprefix("came: "): n for name, n in count.items() if name.startswith("came: ")}
    return {
        "ticks": n_ticks, "faults": faults, "passed_with_fault": count["passed with a fault"],
        "out_of_range": count["out of range"],
        "passed_healthy": round(count["passed"] / (n_ticks - faults), 4), "came_of_faults": came, **usage,
    }  # fmt: skip


def _tick(robot: LatentSafeShielded, clock: Clock, t: int, fault: str | None, count: Counter) -> None:
    """One tick of the loop, with a fault, and what came of it."""
    arm, shield = robot.inner, robot.filter.shield
    clock.now += 0.5 if fault == "a tick that is late" else 1 / FPS
    before, arm.told = arm.joints, None
    read = arm.get_observation
    altered: Callable[[], Any] = read
    if fault in READINGS:
        altered = lambda: READINGS[fault](read())  # noqa: E731
    elif fault == "a robot that is not read":
        altered = _fails
    elif fault == "a reading that takes a second":
        altered = lambda: clock.after(0.9, read())  # noqa: E731
    wanted = _wanted(t, before)
    with _reads(arm, altered), BROKEN[fault](shield) if fault in BROKEN else nullcontext():
        robot.get_observation()
        robot.send_action(ACTIONS[fault](wanted) if fault in ACTIONS else wanted)
    decision = robot._decision if robot._untaken and robot._untaken[1] is not None else None
    reason = Reason(int(decision.reason.item())) if decision is not None else None
    told = np.array([arm.told.get(name, math.nan) for name in NAMES]) if arm.told else before
    if not (np.isfinite(told).all() and np.abs(told - before).max() <= STEP + 1e-3):
        count["out of range"] += 1
    if fault is None:
        count["passed"] += reason == Reason.PASSED
    else:
        count[fault] += 1
        count["passed with a fault"] += reason == Reason.PASSED
        count[f"came: {'the robot holds still' if reason is None else reason.name}"] += 1


def _wanted(t: int, joints: np.ndarray) -> dict[str, float]:
    """A slow motion around the middle."""
    places = 10 * np.sin(t / 20 + np.arange(len(NAMES)))
    return dict(zip(NAMES, (joints + np.clip(places - joints, -1.0, 1.0)).tolist()))


def _look_at_memory(usage: dict[str, list[float]]) -> None:
    gc.collect()
    process = psutil.Process(os.getpid())
    usage["memory_mb"].append(round(process.memory_info().rss / 2**20, 1))
    usage["open_files"].append(process.num_fds())
    usage["threads"].append(process.num_threads())
