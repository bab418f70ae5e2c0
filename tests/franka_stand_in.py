"""A stand-in for the real Franka's driver, and a robot with it whose clock stands."""

import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np

from lerobot_latentsafe.franka.actions import ACTION_NAMES, GRIPPER_WIDTH, HOME
from lerobot_latentsafe.robots.franka import checked, franka, stream
from lerobot_latentsafe.robots.franka.config_franka import LatentSafeFrankaConfig
from lerobot_latentsafe.robots.franka.driver import ArmState, FrankaError, GripperError
from lerobot_latentsafe.robots.franka.franka import DOWN, LatentSafeFranka
from lerobot_latentsafe.robots.franka.stream import STREAM_HZ

STILL = dict.fromkeys(ACTION_NAMES, 0.0) | {"gripper.pos": 1.0}
START = np.array([0.45, 0.0, 0.30])


class FakeDriver:
    """An arm that covers a share of the way to its target with every call of `track`.

    `reflex`: the arm has stopped until `recover`. `blocked`: it cannot move. `gripper_lost`: the hand is silent.
    """

    def __init__(self, follow: float = 0.3):
        self.follow, self.joints = follow, HOME.copy()
        self.position, self.rotation, self.width = START.copy(), DOWN, GRIPPER_WIDTH
        self.tracked: list[np.ndarray] = []
        self.streamed: list[tuple] = []  # (time, pose), with a clock that stands
        self.calls: list[str] = []
        self.started = self.reflex = self.blocked = self.gripper_lost = False
        self.lock = threading.Lock()

    def connect(self):
        self.calls.append("connect")

    def start(self):
        self.calls.append("start")
        self.started = True

    def state(self):
        if self.reflex:
            raise FrankaError("cartesian reflex")
        if self.gripper_lost:
            raise GripperError("the gripper does not answer")
        with self.lock:
            return ArmState(self.joints.copy(), self.position.copy(), self.rotation, self.width)

    def track(self, position, rotation):
        if self.reflex:
            raise FrankaError("cartesian reflex")
        with self.lock:
            self.tracked.append(position)
            if not self.blocked:
                self.position = self.position + self.follow * (position - self.position)
                self.rotation = rotation

    def move_joints(self, joints):
        self.calls.append("move_joints")
        self.joints = joints.copy()

    def move_gripper(self, width):
        self.calls.append(f"gripper {width:.3f}")
        self.width = width

    def recover(self):
        self.calls.append("recover")
        self.reflex = False

    def stop(self):
        self.calls.append("stop")
        self.started = False

    def disconnect(self):
        self.calls.append("disconnect")


def make(driver=None, **options):
    return LatentSafeFranka(LatentSafeFrankaConfig(ip="172.16.0.2", **options), driver or FakeDriver())


def standing_clock(monkeypatch):
    """The robot's clock. It stands, so that no test is too slow for it; once it `runs`, each streamed pose moves it."""
    clock, track = SimpleNamespace(now=0.0, runs=False, monotonic=lambda: clock.now), FakeDriver.track

    def timed(self, position, rotation):
        self.streamed.append((clock.now, (position, rotation)))
        clock.now += clock.runs / STREAM_HZ
        track(self, position, rotation)

    monkeypatch.setattr(FakeDriver, "track", timed)
    for module in (franka, stream):
        monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(checked, "LIMIT_S", dict.fromkeys(checked.LIMIT_S, 60.0))  # a busy machine is no fault
    return clock


def unhurried(robot):
    """However busy the machine is, a state is in time."""
    robot._arm.patience = 60.0
    return robot


@contextmanager
def connected():
    """A robot that is connected, and healed in the end."""
    robot = unhurried(make())
    robot.connect()
    yield robot
    if robot.is_connected:
        robot.driver.reflex = robot.driver.gripper_lost = False
        robot.disconnect()


def stepping(robot, clock):
    """Sends an action some control steps after the last, to an arm that is led meanwhile."""

    def send(periods=1.0, **changed):
        clock.now += periods / robot.config.fps
        wait_for(lambda: robot._stream._sent >= clock.now)
        return robot.send_action(STILL | {f"{name}.pos": value for name, value in changed.items()})

    return send


def wait_for(condition, seconds=60.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "did not happen in time"
        time.sleep(0.005)
