"""Any LeRobot robot behind a latent safety filter, for whatever drives it: a person, a replay, a policy far away."""

import logging
import math
import time
from collections import deque
from statistics import median
from typing import Any

import numpy as np
import torch
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.robots.robot import Robot
from lerobot.robots.utils import make_robot_from_config
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE, OBS_STR
from lerobot.utils.feature_utils import build_dataset_frame

from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.datasets.decisions import Journal
from lerobot_latentsafe.decision import FilterDecision, Reason
from lerobot_latentsafe.encoders.pictures import check_proportions
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.robots.lerobot_events import LeRobotEvents
from lerobot_latentsafe.robots.shielded.config_shielded import LatentSafeShieldedConfig
from lerobot_latentsafe.units import TrainedOn

logger = logging.getLogger(__name__)

PAUSE_S = 1.0
"""After a pause between two decisions longer than this, what was seen before says nothing: the history starts anew."""
RATE_DECISIONS = 10
"""So many decisions tell at what rate the loop runs."""
MOVED = 0.05
"""A robot has moved if a number of its state differs by this many standard deviations of the data."""


class LatentSafeShielded(Robot):
    """To LeRobot it is the inner robot: same name, features, cameras. What is sent to it goes through the filter.

    Observations also hold `shield.value`, `shield.margin` (not a number before the first decision) and
    `shield.intervened` of the last decision: recordings leave them out, `--display_data=true` shows them.

    Attributes:
        inner: the robot that moves.
        filter: the filter, with the robot's own law.
        journal: the decisions of a recording, if there is one.
    """

    config_class = LatentSafeShieldedConfig
    name = "latentsafe_shielded"

    _phase: int | str | None
    _decided_at: float | None
    _untaken: tuple[dict[str, float], FilterDecision | None] | None

    def __init__(self, config: LatentSafeShieldedConfig):
        super().__init__(config)
        self.config = config
        self.inner = make_robot_from_config(config.inner)
        self.name = self.robot_type = self.inner.name
        self.filter = load_filter(config.filter, law=config.law, device=config.device)
        self.filter.model.require_trained_for_law()
        self._trained_on = self.filter.config.trained_on
        self._check_fit()
        self.journal = Journal(config.journal) if config.journal else None
        self._events = LeRobotEvents()
        self._sent: dict[str, float] = {}
        self._forget()

    def _check_fit(self) -> None:
        """Refuse a filter of another robot, or of another rate, before anything moves."""
        filter, fps = self.config.filter, self._trained_on.fps
        _check_cameras(self.inner, filter, self.filter.config)
        _check_names(self.inner, filter, self._trained_on)
        if self.config.fps not in (None, fps):
            raise ValueError(
                f"the loop is to run at {self.config.fps} Hz, but the filter {filter} decides {fps} times a second: "
                f"give --fps={fps} (--dataset.fps={fps} to record)"
            )

    # -- the inner robot ---

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "inner" not in self.__dict__:
            raise AttributeError(name)
        return getattr(self.inner, name)

    @property
    def observation_features(self) -> dict:
        """Those of the inner robot."""
        return self.inner.observation_features

    @property
    def action_features(self) -> dict:
        """Those of the inner robot."""
        return self.inner.action_features

    @property
    def is_connected(self) -> bool:
        """Whether the inner robot is."""
        return "inner" in self.__dict__ and self.inner.is_connected

    @property
    def is_calibrated(self) -> bool:
        """Whether the inner robot is."""
        return self.inner.is_calibrated

    def calibrate(self) -> None:
        """Calibrate the inner robot."""
        self.inner.calibrate()

    def configure(self) -> None:
        """Configure the inner robot."""
        self.inner.configure()

    def connect(self, calibrate: bool = True) -> None:
        """Connect the inner robot, and listen to LeRobot's events."""
        self.inner.connect(calibrate)
        self._events.listen()
        self._forget()
        _connected.append(self)

    def disconnect(self) -> None:
        """Write the journal, and disconnect the inner robot."""
        if self in _connected:
            _connected.remove(self)
        self._events.stop()
        try:
            if self.journal:
                self.journal.write()
        finally:
            self.inner.disconnect()

    # -- the loop ---

    def get_observation(self) -> dict:
        """The inner robot's observation, and what was decided last."""
        announced = self._events.take()
        if announced is not None:
            self._forget()
            self._phase = announced
            filtered = "does not filter now" if self._between and self.config.unfiltered_moves else "starts anew"
            logger.info("%s: the filter %s", announced if self._between else f"episode {announced}", filtered)
            if self.journal:
                self.journal.write()
                self.journal.begin(announced if isinstance(announced, int) else None)
        self._observation = self.inner.get_observation()
        self._seen_at = time.perf_counter()
        self._fresh = True
        self._watch_cameras()
        return {**self._observation, **self._shown()}

    def _shown(self) -> dict[str, float]:
        """The last decision as numbers; there from the first tick on, for a display lays out what it sees first."""
        decision = self.filter.shield.decision
        if decision is None:
            return {"shield.value": math.nan, "shield.margin": math.nan, "shield.intervened": 0.0}
        return {f"shield.{name}": float(getattr(decision, name).item()) for name in ("value", "margin", "intervened")}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        """Filter an action and have the inner robot execute the result; returns what was executed."""
        shield, names = self.filter.shield, self._trained_on.action_names
        before = shield.decision
        sent = self.inner.send_action(self._decide(action))
        self._sent.update(sent)
        decision = shield.decision if shield.decision is not before else None
        self._untaken = dict(sent), decision
        if self.journal and decision is not None:
            self.journal.add(decision, [float(sent[name]) for name in names])
        if set(sent) == set(names) and shield.executed is not None:  # the robot may have clipped it
            shield.was_executed(torch.tensor([[float(sent[name]) for name in names]], device=self.filter.model.device))
        return sent

    def take_sent(self) -> tuple[dict[str, float], FilterDecision | None] | None:
        """What was executed since this was asked last, with the decision on it, if any: for whoever stores it."""
        sent, self._untaken = self._untaken, None
        return sent

    def _decide(self, action: dict[str, float]) -> dict[str, float]:
        """What is to be executed instead of an action, or that action itself."""
        names, shield = self._trained_on.action_names, self.filter.shield
        known = set(action) == set(names)
        passes = self.config.unfiltered_moves and (self._between or not known)
        if (passes or (self._between and self._goes_to_places(action))) and all(map(math.isfinite, action.values())):
            self._say_once("moves between episodes, or of other names, are not filtered; no joint may jump")
            return self._bounded(action)
        if not known:
            return self._hold(action)
        if not self._fresh:
            self.get_observation()
        self._fresh = False
        now = time.perf_counter()
        rate = self._check_rate(now)
        proposed, age = torch.tensor([[float(action[name]) for name in names]]), self._age(now)
        batch = prepare_observation_for_inference(self._frame(), self.filter.model.device)
        decision = shield.adopt(batch, proposed, age) if rate == Reason.PASSED else None
        if decision is None:
            decision = shield(batch, proposed, age, fault=rate)
        else:
            self._say_once("these actions come from a policy under this very filter; they are not filtered again")
        return self._carry_out(decision, action)

    @property
    def _between(self) -> bool:
        """Whether LeRobot said that what comes belongs to no episode."""
        return isinstance(self._phase, str)

    def _goes_to_places(self, action: dict[str, float]) -> bool:
        """Whether an action holds targets only, such as LeRobot's return of an arm to its start."""
        targets = {command.name for command in self._trained_on.commands if command.meaning == "target"}
        return bool(action) and set(action) <= targets

    def _bounded(self, action: dict[str, float]) -> dict[str, float]:
        """A move that is not filtered: each of its targets goes no further at once than those of the data."""
        self._decided_at = -math.inf
        if self._observation is None:
            self.get_observation()
        bounded = dict(action)
        for command in self._trained_on.commands:
            name = command.name
            if command.of_state is not None and name in action:
                low, high = self._trained_on.motion_ranges[name]
                start = self._moved.get(name, float(self._observation[command.of_state]))
                bounded[name] = self._moved[name] = min(max(action[name], start + low), start + high)
        return bounded

    def _carry_out(self, decision: FilterDecision, action: dict[str, float]) -> dict[str, float]:
        """The action of a decision on an action."""
        if not decision.intervened.item() and torch.equal(decision.action, decision.proposed):
            return action
        if isinstance(self._phase, int) and self._untaken is not None:  # nobody asked what was sent
            self._say_once(
                "LeRobot stores what was proposed, not what is executed now; `latentsafe record` stores that"
            )
        return dict(zip(self._trained_on.action_names, decision.action[0].tolist()))

    def _hold(self, action: dict[str, float]) -> dict[str, float]:
        """Instead of a command of which the filter knows nothing: stay."""
        self._say_once(
            f"the filter knows nothing of a command of {', '.join(action)}: "
            "the robot holds still. --robot.unfiltered_moves=true lets such moves pass unfiltered"
        )
        self._decided_at = -math.inf
        if self._observation is None:
            self.get_observation()
        names, units = self._trained_on.action_names, self.filter.model.units
        told = torch.tensor([[float(self._sent.get(name, math.nan)) for name in names]])
        state = torch.from_numpy(self._frame()[OBS_STATE])[None]
        return dict(zip(names, units.hold(state.to(units.device), told.to(units.device))[0].tolist()))

    # -- what the filter is told ---

    def _check_rate(self, now: float) -> Reason:
        """Start anew after a pause; a loop that runs at another rate than the filter is no ground to decide on."""
        fps, gap = self._trained_on.fps, now - self._decided_at if self._decided_at is not None else 0.0
        self._decided_at = now
        if gap > PAUSE_S:
            logger.info("the filter starts anew after a pause")
            self.filter.shield.reset()
            self._gaps.clear()
        elif gap > 0:
            self._gaps.append(gap)
        if len(self._gaps) < RATE_DECISIONS:
            return Reason.PASSED
        rate = 1.0 / median(self._gaps)
        if not fps / 2 < rate < 2 * fps:
            slow_or_fast = "fewer than half" if rate <= fps / 2 else "more than twice"
            self._say_once(
                f"actions come {slow_or_fast} as often as the filter decides, {fps} times a second: run the loop at "
                f"--fps={fps}"
            )
        return Reason.WRONG_RATE if rate >= 2 * fps else Reason.PASSED

    def _frame(self) -> dict[str, np.ndarray]:
        """The last observation as LeRobot's datasets name and type it."""
        names = self._trained_on.state_names
        state = {"dtype": "float32", "shape": (len(names),), "names": names}
        pictures = {key: {"dtype": "image"} for key in self.filter.model.world_model.image_keys}
        return build_dataset_frame({OBS_STATE: state, **pictures}, self._observation, prefix=OBS_STR)

    def _watch_cameras(self) -> None:
        """Note since when each picture has been the same although the robot moved: such a camera is frozen."""
        frame, now = self._frame(), self._seen_at
        units = self.filter.model.units
        state = units.normalise_state(torch.from_numpy(frame.pop(OBS_STATE)).to(units.device))
        for key, picture in frame.items():
            last = self._cameras.get(key)
            if last is None or not np.array_equal(last["picture"], picture):
                self._cameras[key] = {"picture": picture, "at": now, "state": state, "repeats": 0}
            elif ((state - last["state"]).abs() > MOVED).any():
                last["repeats"] += 1

    def _age(self, now: float) -> float:
        """Seconds since the observation, or since a camera that repeats itself while the robot moves last changed."""
        frozen = [camera["at"] for camera in self._cameras.values() if camera["repeats"] > 1]
        return now - min([self._seen_at, *frozen])

    def _say_once(self, message: str) -> None:
        if message not in self._said:
            logger.warning(message)
            self._said.add(message)

    def _forget(self) -> None:
        """Start an episode: nothing seen, nothing decided."""
        self.filter.shield.reset()
        self._observation, self._fresh, self._seen_at = None, False, 0.0
        self._phase = None
        self._untaken = None
        self._moved: dict[str, float] = {}
        self._decided_at = None
        self._gaps: deque[float] = deque(maxlen=RATE_DECISIONS)
        self._cameras: dict[str, dict] = {}
        self._said: set[str] = set()


def _check_cameras(robot: Robot, filter: str, config: LatentSafeConfig) -> None:
    """Refuse a robot without a camera that the filter looks through, or with pictures of other proportions."""
    cameras = [name for name, kind in robot.observation_features.items() if isinstance(kind, tuple)]
    wanted = [key.removeprefix(f"{OBS_IMAGES}.") for key in config.trained_on.cameras]
    missing = [name for name in wanted if name not in cameras]
    if missing:
        raise ValueError(
            f"{robot.name} has no camera {', '.join(missing)}; the filter {filter} sees {', '.join(wanted)}, the robot "
            f"has {', '.join(cameras) or 'none'}. Name its cameras alike, or train a filter for this robot"
        )
    for name in wanted:
        key, (height, width, channels) = f"{OBS_IMAGES}.{name}", robot.observation_features[name]
        check_proportions(key, (channels, height, width), config.input_features[key].shape)


def _check_names(robot: Robot, filter: str, trained_on: TrainedOn) -> None:
    """Refuse a robot that takes other commands than the filter gives, or does not observe what the filter reads."""
    if set(trained_on.action_names) != set(robot.action_features):
        raise ValueError(
            f"the filter {filter} acts in {', '.join(trained_on.action_names)}; {robot.name} in "
            f"{', '.join(robot.action_features)}. Train a filter on data of this robot"
        )
    scalars = [name for name, kind in robot.observation_features.items() if not isinstance(kind, tuple)]
    unread = [name for name in trained_on.state_names if name not in scalars]
    if unread:
        raise ValueError(
            f"{robot.name} does not observe {', '.join(unread)}, which the filter {filter} reads; it observes "
            f"{', '.join(scalars) or 'nothing'}. Train a filter on data of this robot"
        )


_connected: list[LatentSafeShielded] = []


def connected_shield() -> LatentSafeShielded:
    """The shielded robot that this process connected last."""
    return _connected[-1]
