"""Any LeRobot robot behind a latent safety filter, for whatever drives it: a person, a replay, a policy far away."""

import logging
import time
from typing import Any

import numpy as np
import torch
from lerobot.policies.utils import prepare_observation_for_inference
from lerobot.robots.robot import Robot
from lerobot.robots.utils import make_robot_from_config
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE

from lerobot_latentsafe.robots.announcements import Announcements
from lerobot_latentsafe.robots.shielded.config_shielded import LatentSafeShieldedConfig
from lerobot_latentsafe.robots.shielded.journal import Journal
from lerobot_latentsafe.shield import decided_elsewhere

logger = logging.getLogger(__name__)

PAUSE_S = 1.0
"""After a pause between two decisions longer than this, what was seen before says nothing: the history starts anew."""
MOVED = 0.05
"""A robot has moved if a number of its state differs by this many standard deviations of the data."""


class LatentSafeShielded(Robot):
    """To LeRobot it is the inner robot: same name, features, cameras. What is sent to it goes through the filter.

    Observations also hold `shield.value`, `shield.margin` and `shield.intervened` of the last decision: recordings
    leave them out, `--display_data=true` shows them.
    """

    config_class = LatentSafeShieldedConfig
    name = "latentsafe_shielded"

    def __init__(self, config: LatentSafeShieldedConfig):
        from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

        super().__init__(config)
        self.config = config
        self.inner = make_robot_from_config(config.inner)
        self.name = self.robot_type = self.inner.name
        self.filter = LatentSafePolicy.from_pretrained(config.filter).eval()
        for option in ("mode", "epsilon", "guard"):
            if getattr(config, option) is not None:
                setattr(self.filter.config, option, getattr(config, option))
        self.filter.config.__post_init__()  # checks what was changed
        if config.device:
            self.filter.to(config.device)
        self.filter.require_stage(self.filter.needed_stage)
        self._check_fit()
        self.journal = Journal(config.journal) if config.journal else None
        self._announcements = Announcements()
        self._forget()

    def _check_fit(self) -> None:
        """Refuse a filter of another robot before anything moves."""
        robot, config = self.inner, self.filter.config
        scalars = [name for name, kind in robot.observation_features.items() if not isinstance(kind, tuple)]
        cameras = [name for name, kind in robot.observation_features.items() if isinstance(kind, tuple)]
        wanted = [key.removeprefix(f"{OBS_IMAGES}.") for key in self.filter.world_model.image_keys]
        missing = [name for name in wanted if name not in cameras]
        if missing:
            raise ValueError(
                f"{robot.name} has no camera {', '.join(missing)}; the filter {self.config.filter} sees "
                f"{', '.join(wanted)}, the robot has {', '.join(cameras) or 'none'}. Name its cameras alike, or "
                "train a filter for this robot"
            )
        for what, own, theirs in (
            ("acts in", list(config.action_names or []), list(robot.action_features)),
            ("reads the state", list(config.state_names or []), scalars),
        ):
            if own != theirs:
                raise ValueError(
                    f"the filter {self.config.filter} {what} {', '.join(own)}; {robot.name} offers "
                    f"{', '.join(theirs)}. Train a filter on data of this robot"
                )

    # -- the inner robot ---

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "inner" not in self.__dict__:
            raise AttributeError(name)
        return getattr(self.inner, name)

    @property
    def observation_features(self) -> dict:
        return self.inner.observation_features

    @property
    def action_features(self) -> dict:
        return self.inner.action_features

    @property
    def is_connected(self) -> bool:
        return "inner" in self.__dict__ and self.inner.is_connected

    @property
    def is_calibrated(self) -> bool:
        return self.inner.is_calibrated

    def calibrate(self) -> None:
        self.inner.calibrate()

    def configure(self) -> None:
        self.inner.configure()

    def connect(self, calibrate: bool = True) -> None:
        self.inner.connect(calibrate)
        self._announcements.listen()
        self._forget()
        _connected.append(self)

    def disconnect(self) -> None:
        if self in _connected:
            _connected.remove(self)
        self._announcements.stop()
        if self.journal:
            self.journal.write()
        self.inner.disconnect()

    # -- the loop ---

    def get_observation(self) -> dict:
        """The inner robot's observation, and what was decided last."""
        announced = self._announcements.take()
        if announced is not None:
            self._forget()
            logger.info("the filter starts anew; it goes on filtering between episodes")
            if self.journal:
                self.journal.hear(announced)
        self._observation = self.inner.get_observation()
        self._seen_at = time.perf_counter()
        self._fresh = True
        self._watch_cameras()
        decision = self.filter.shield.decision
        shown = {} if decision is None else {"value": decision.value, "margin": decision.margin}
        shown = {f"shield.{name}": value.item() for name, value in shown.items()}
        if decision is not None:
            shown["shield.intervened"] = float(decision.intervened.item())
        return {**self._observation, **shown}

    def decide(self, action: dict[str, float]) -> dict[str, float]:
        """What will be executed instead of an action, or that action itself; `send_action` then sends it as it is."""
        names = self.filter.config.action_names
        if set(action) != set(names):
            return self._outside(action)
        if not self._fresh:
            self.get_observation()
        self._fresh = False
        now = time.perf_counter()
        if self._decided_at is not None and now - self._decided_at > PAUSE_S:
            logger.info("no decision for %.1f s: the filter starts anew", now - self._decided_at)
            self.filter.shield.reset()
        proposed = torch.tensor([[float(action[name]) for name in names]])
        if decided_elsewhere(self.filter.shield, proposed, 1.0 / self.filter.config.fps):
            self._say_once("these actions come from a shielded policy of this process; they are not filtered again")
            self.filter.shield.reset()  # it does not see what happens meanwhile
            self._decided = dict(action)
            return self._decided
        age = self._age(now)
        batch = prepare_observation_for_inference(self._frame(), self.filter.device)
        decision = self.filter.shield(batch, proposed, age)
        self._decided_at = time.perf_counter()
        if self.journal:
            self.journal.add(decision)
        self._decided = dict(zip(names, decision.action[0].tolist()))
        return self._decided

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        """Filter an action and have the inner robot execute the result.

        Returns:
            What was executed.
        """
        decided = action if action == self._decided else self.decide(action)
        self._decided = None
        sent = self.inner.send_action(decided)
        names = self.filter.config.action_names
        if set(sent) == set(names) and self.filter.shield.executed is not None:  # the robot may have clipped it
            executed = torch.tensor([[float(sent[name]) for name in names]], device=self.filter.device)
            self.filter.shield.executed = self.filter.normalise_action(executed).nan_to_num(0.0).clamp(-1, 1)
        return sent

    # -- what the filter is told ---

    def _frame(self) -> dict[str, np.ndarray]:
        """The last observation as LeRobot's datasets name and type it."""
        seen = self._observation
        state = np.array([seen[name] for name in self.filter.config.state_names], np.float32)
        keys = self.filter.world_model.image_keys
        return {OBS_STATE: state, **{key: seen[key.removeprefix(f"{OBS_IMAGES}.")] for key in keys}}

    def _watch_cameras(self) -> None:
        """Note since when each picture has been the same although the robot moved: such a camera is frozen."""
        frame, now = self._frame(), self._seen_at
        state = self.filter.normalise_state(torch.from_numpy(frame.pop(OBS_STATE)).to(self.filter.device))
        for key, picture in frame.items():
            last = self._cameras.get(key)
            if last is None or not np.array_equal(last["picture"], picture):
                self._cameras[key] = {"picture": picture, "at": now, "state": state, "repeats": 0}
            elif (state - last["state"]).abs().max() > MOVED:
                last["repeats"] += 1

    def _age(self, now: float) -> float:
        """Seconds since the observation, or since a camera that repeats itself while the robot moves last changed."""
        frozen = [camera["at"] for camera in self._cameras.values() if camera["repeats"] > 1]
        return now - min([self._seen_at, *frozen])

    def _outside(self, action: dict[str, float]) -> dict[str, float]:
        """A command of which the filter knows nothing."""
        still = self.filter.shield.hold(1)[0].tolist()
        self.filter.shield.reset()
        if self.config.unfiltered_moves:
            self._say_once(f"moves of {', '.join(action)} are not filtered (--robot.unfiltered_moves)")
            self._decided = action
        else:
            self._say_once(
                f"the filter knows nothing of a command of {', '.join(action)}: "
                "the robot holds still. --robot.unfiltered_moves=true lets such moves pass unfiltered"
            )
            self._decided = dict(zip(self.filter.config.action_names, still))
        return self._decided

    def _say_once(self, message: str) -> None:
        if message not in self._said:
            logger.warning(message)
            self._said.add(message)

    def _forget(self) -> None:
        """Start an episode: nothing seen, nothing decided."""
        self.filter.shield.reset()
        self._observation, self._fresh, self._seen_at = None, False, 0.0
        self._decided: dict[str, float] | None = None
        self._decided_at: float | None = None
        self._cameras: dict[str, dict] = {}
        self._said: set[str] = set()


_connected: list[LatentSafeShielded] = []


def connected_shield() -> LatentSafeShielded:
    """The shielded robot that this process connected last."""
    return _connected[-1]
