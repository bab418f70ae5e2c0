"""Any LeRobot robot behind a latent safety filter, for whatever drives it: a person, a replay, a policy far away."""

import copy
import logging
import math
import threading
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from lerobot.robots.utils import make_robot_from_config
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE
from torch import Tensor

from lerobot_latentsafe.datasets.decisions import Journal
from lerobot_latentsafe.decision import FilterDecision, Reason
from lerobot_latentsafe.guard import UnknownPoseError
from lerobot_latentsafe.host import on_host
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.robots.lerobot_events import LeRobotEvents
from lerobot_latentsafe.robots.shielded.config_shielded import LatentSafeShieldedConfig
from lerobot_latentsafe.robots.shielded.fit import check_fit
from lerobot_latentsafe.robots.shielded.readings import all_finite, as_input, as_number, as_numbers, is_usable
from lerobot_latentsafe.robots.shielded.wrapped import WrappedRobot

logger = logging.getLogger(__name__)

FLAGS = ("intervened", "adjusted", "hand_over")
"""Of what is shown, what is no number but true or false."""
MAX_FAILURES = 5
"""So often in a row may the inner robot fail to be read, or to take an action."""


class LatentSafeShielded(WrappedRobot):
    """To LeRobot it is the inner robot: same name, features, cameras. What is sent to it goes through the filter.

    Observations also hold `shield.value`, `shield.margin` (not a number before the first decision) and
    `shield.intervened` of the last decision: recordings leave them out, `--display_data=true` shows them. The law
    `nearest` adds `shield.adjusted` (1 where the nearest action that passes is executed, not the fallback), a monitor
    of the unknown `shield.unknown` (share of its threshold, above 1 it alarms) and `shield.hand_over` (1 where a person
    is asked to take over).

    Attributes:
        inner: the robot that moves.
        filter: the filter, with the robot's own law.
        journal: the decisions of a recording, if there is one.
    """

    config_class = LatentSafeShieldedConfig
    name = "latentsafe_shielded"

    _observation: dict | None
    _decision: FilterDecision | None
    _untaken: tuple[dict[str, float], FilterDecision | None] | None
    _recorded: bool
    _unjudged: bool
    _unread: int

    def __init__(self, config: LatentSafeShieldedConfig):
        super().__init__(config)
        self.config = config
        self.inner = make_robot_from_config(config.inner)
        self.name = self.robot_type = self.inner.name
        self.filter = load_filter(config.filter, law=config.law, device=config.device)
        self.filter.model.require_trained_for_law()
        self._trained_on = self.filter.config.trained_on
        check_fit(self.inner, config.filter, self.filter.config, config.fps)
        pace, declared = self.filter.shield.pace, getattr(self.inner, "slack_s", 0.0)
        pace.strict, pace.slack_s = True, declared if config.slack_s is None else config.slack_s
        self.filter.shield.warm_up()  # once more, as now it is known that what is late is lost
        self.filter.shield.guard.begun = True  # it fits; what is wrong from now on is a fault
        self.journal = Journal(config.journal) if config.journal else None
        self._events, self._lock = LeRobotEvents(), threading.RLock()
        self._sent: dict[str, float] = {}
        self._usable: dict[str, Any] = {}
        self._unsent = 0
        self._forget()

    def connect(self, calibrate: bool = True) -> None:
        """Connect the inner robot."""
        self.inner.connect(calibrate)
        self._sent.clear()
        self._forget()
        _connected.append(self)

    def disconnect(self) -> None:
        """Write the journal, and disconnect the inner robot."""
        if self in _connected:
            _connected.remove(self)
        try:
            if self.journal:
                self.journal.write()
        finally:
            self.inner.disconnect()

    # -- the loop ---

    def get_observation(self) -> dict:
        """The inner robot's observation, and what was decided last.

        In the place of what LeRobot cannot use stands what was read last; the filter judges what was read.

        Raises:
            Exception: what the inner robot raises, at once if it has shown nothing yet in this episode, else at the
                fifth time in a row; it was told to stay before.
        """
        with self._lock:
            self._follow_lerobot()
            self._look()
            return {**self._usable, **self._shown()}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        """Filter an action and have the inner robot execute the result.

        Returns:
            What was executed; what was told, if the robot does not say.

        Raises:
            UnknownPoseError: nobody knows where the robot is, and it takes positions; nothing was sent.
            Exception: what the inner robot raises, at the fifth time in a row.
        """
        with self._lock:
            self._follow_lerobot()
            told, decision = self._decide(action)
            sent = self._execute(told)
            self._remember(sent, decision)
            return sent

    def take_sent(self) -> tuple[dict[str, float], FilterDecision | None] | None:
        """What was executed since this was asked last, with the decision on it, if any: for whoever stores it."""
        sent, self._untaken = self._untaken, None
        return sent

    def _follow_lerobot(self) -> None:
        """Begin anew where LeRobot begins or ends an episode."""
        loop = self._events.take()
        if loop is None:
            return
        self._forget()
        self._recorded = loop.episode is not None
        if self._recorded:
            logger.info("episode %d: the filter starts anew", loop.episode)
        elif self.config.unfiltered_moves:
            logger.info("between episodes: the filter does not filter now")
        if self.journal:
            self.journal.write()
            self.journal.begin(loop.episode)

    def _look(self) -> None:
        """Read the inner robot; if that fails a few times, what was read last remains, as old as it is."""
        began = self.filter.shield.clock()
        try:
            seen = dict(self.inner.get_observation())
        except Exception as e:
            self._unread += 1
            if self._observation is None or self._unread >= MAX_FAILURES:
                self._stay()
                raise
            self.filter.shield.note_failure("the robot was not read", e)
        else:
            self._unread, self._observation, self._seen_at = 0, seen, began
            features = self.inner.observation_features
            lost = [name for name in features if not is_usable(seen.get(name), features[name])]
            self._usable = {**seen, **{name: self._usable[name] for name in lost if name in self._usable}}
        self._fresh = True

    def _shown(self) -> dict[str, float]:
        """The last decision as numbers; there from the first tick on, for a display lays out what it sees first."""
        decision, names = self._decision, ["value", "margin", "intervened"]
        if self.filter.config.law.name == "nearest":
            names.append("adjusted")
        if self.filter.shield.monitor is not None:
            names += ["unknown", "hand_over"]
        if decision is None:
            return {f"shield.{name}": 0.0 if name in FLAGS else math.nan for name in names}
        return {f"shield.{name}": float(getattr(decision, name).item()) for name in names}

    # -- what is to be executed ---

    def _decide(self, action: Any) -> tuple[dict[str, float], FilterDecision | None]:
        """What is to be executed instead of an action, or that action itself; and the decision on it, if it is one."""
        numbers, names = as_numbers(action), self._trained_on.action_names
        missing, between = {*names} - {*numbers}, self._events.between_episodes
        known = not missing or (bool(numbers) and {*numbers} <= {*names})
        if self.filter.config.law.mode == "monitor":  # it never acts
            return action, self._judge(numbers) if known else None
        moves = self.config.unfiltered_moves and (between or not known)
        if (moves or (between and self._goes_to_places(numbers))) and all_finite(numbers):
            return self._bounded(numbers), None
        decision = self._judge(numbers) if known else None
        if decision is None:
            return self._hold("what the filter could not judge" if known else _kind(numbers)), None
        if missing:
            self._say_once(f"the action lacks {', '.join(sorted(missing))}: it counts as not finite")
        return self._carry_out(decision, numbers) | self._others(numbers), decision

    def _others(self, numbers: dict[str, float]) -> dict[str, float]:
        """What an action holds beside the filter's commands, if it is allowed."""
        more = {name: x for name, x in numbers.items() if name not in self._trained_on.action_names}
        if more:
            done = "it is passed on unfiltered" if self.config.unfiltered_moves else "it is left out"
            self._say_once(f"the filter knows nothing of {', '.join(more)}: {done}")
        return {name: x for name, x in more.items() if self.config.unfiltered_moves and math.isfinite(x)}

    def _judge(self, numbers: dict[str, float]) -> FilterDecision | None:
        """The decision on commands, of which those that are missing are not finite; None if there can be none."""
        if not self._fresh:
            self._look()
        self._fresh, shield = False, self.filter.shield
        if self._unjudged:  # the history does not know how the robot came here
            shield.reset()
            self._unjudged = False
        proposed = torch.tensor([[numbers.get(name, math.nan) for name in self._trained_on.action_names]])
        batch, age_s = self._batch(), shield.clock() - self._seen_at
        try:
            decision = self._adopt(batch, proposed, age_s)
            if decision is None:
                fault = Reason.OBSERVATION_STALE if self._unread else Reason.PASSED
                decision = shield(batch, proposed, age_s, fault=fault)
        except Exception as e:  # it may be known here what is to stay
            shield.note_failure("the filter could not decide", e)
            return None
        if decision.reason.item() == Reason.WRONG_RATE:
            fps = self._trained_on.fps
            self._say_once(f"actions do not come {fps} times a second, as in the data: run the loop at --fps={fps}")
        self._decision = decision
        return decision

    def _adopt(self, batch: dict[str, Any], proposed: Tensor, age_s: float) -> FilterDecision | None:
        """The decision of a policy's shield on the very same, if it came at the rate of the data."""
        shield = self.filter.shield
        decision = None if self._unread else shield.adopt(batch, proposed, age_s)
        if decision is None or shield.pace.tick(shield.clock(), self.filter.config.law.slack_ms) != Reason.PASSED:
            return None
        self._say_once("these actions come from a policy under this very filter; they are not filtered again")
        return decision

    def _carry_out(self, decision: FilterDecision, numbers: dict[str, float]) -> dict[str, float]:
        """The action of a decision on commands."""
        names = self._trained_on.action_names
        if not decision.intervened.item() and torch.equal(decision.action, decision.proposed):
            return {name: numbers[name] for name in names}
        if self._recorded and self._untaken is not None:  # nobody asked what was sent
            self._say_once(
                "LeRobot stores what was proposed, not what is executed now; `latentsafe record` stores that"
            )
        return dict(zip(names, decision.action[0].tolist()))

    def _goes_to_places(self, numbers: dict[str, float]) -> bool:
        """Whether an action holds targets only, such as LeRobot's return of an arm to its start."""
        targets = {command.name for command in self._trained_on.commands if command.meaning == "target"}
        return bool(numbers) and set(numbers) <= targets

    def _bounded(self, numbers: dict[str, float]) -> dict[str, float]:
        """A move that is not filtered: each of its targets goes no further at once than those of the data."""
        self._say_once("moves between episodes, or of other names, are not filtered; no joint may jump")
        self._unjudged = True
        if self._observation is None:
            self._look()
        pose = dict(zip(self._trained_on.state_names, self._pose()[0].tolist()))
        bounded = dict(numbers)
        for command in self._trained_on.commands:
            name = command.name
            if command.of_state is not None and name in numbers:
                low, high = self._trained_on.motion_ranges[name]
                start = self._moved.get(name, pose[command.of_state])
                if not math.isfinite(start):
                    return self._hold(f"{_kind(numbers)} from a place that is not known")
                bounded[name] = self._moved[name] = min(max(numbers[name], start + low), start + high)
        return bounded

    def _hold(self, instead: str) -> dict[str, float]:
        """Stay, instead of a command on which there can be no decision."""
        self._say_once(
            f"the robot holds still, instead of {instead}. --robot.unfiltered_moves=true lets moves of other names "
            "than the filter's pass unfiltered"
        )
        self._unjudged = True
        if self._observation is None:
            self._look()
        return self._staying()

    def _staying(self) -> dict[str, float]:
        """Commands that stay.

        Raises:
            UnknownPoseError: nobody knows what they are.
        """
        names, limits = self._trained_on.action_names, self.filter.model.limits
        told = np.array([[self._sent.get(name, math.nan) for name in names]], np.float32)
        pose = self._pose()
        shown = np.isfinite(limits.seen(np.ones_like(pose)))
        unknown = limits.frozen & shown & np.isnan(np.where(np.isfinite(told), told, limits.seen(pose)))
        held = np.where(unknown, np.nan, limits.hold(pose, told))
        if not np.isfinite(held).all():
            lost = ", ".join(name for name, x in zip(names, held[0].tolist()) if not math.isfinite(x))
            raise UnknownPoseError(
                f"{self.name} shows no usable reading of {lost}, and was told nothing yet: nobody knows what would be "
                "to stay, so nothing was sent. See to the robot's sensors, and start again"
            )
        return dict(zip(names, held[0].tolist()))

    # -- the inner robot is told ---

    def _execute(self, told: Any) -> Any:
        """Tell the inner robot; returns what was executed, as far as it is known."""
        try:
            reported = self.inner.send_action(copy.copy(told))
        except Exception as e:
            self._unsent += 1
            if self._unsent >= MAX_FAILURES:
                raise
            self.filter.shield.note_failure("the robot did not take an action; whether it is executed is unknown", e)
            return told
        self._unsent = 0
        numbers, wanted = as_numbers(reported), as_numbers(told)
        if wanted and not (wanted.keys() <= numbers.keys() and all_finite({name: numbers[name] for name in wanted})):
            self._say_once(f"{self.name} does not say what it executed; what it was told counts as that")
            return told
        return reported

    def _remember(self, sent: Any, decision: FilterDecision | None) -> None:
        """Note what was executed: for the next decision, for whoever stores it, and in the journal."""
        numbers, names, shield = as_numbers(sent), self._trained_on.action_names, self.filter.shield
        self._sent.update({name: x for name, x in numbers.items() if math.isfinite(x)})
        self._untaken = numbers, decision
        if decision is None:
            return
        executed = [numbers.get(name, math.nan) for name in names]
        if self.journal:
            self.journal.add(decision, executed)
        if all(map(math.isfinite, executed)):  # the robot may have clipped it
            shield.was_executed(torch.tensor([executed], device=self.filter.model.device))

    def _stay(self) -> None:
        """Tell the robot to stay, if it is known what that is, and it still listens; a monitor tells nothing."""
        if self.filter.config.law.mode != "monitor":
            with suppress(Exception):
                self.inner.send_action(self._staying())

    # -- what the filter is told ---

    def _batch(self) -> dict[str, Any]:
        """The last observation as policies get it, on the CPU; what is missing is left out."""
        features, seen = self.inner.observation_features, self._observation
        names = {key: key.removeprefix(f"{OBS_IMAGES}.") for key in self.filter.model.world_model.image_keys}
        pictures = {
            key: as_input(seen[name], features[name]) for key, name in names.items() if seen.get(name) is not None
        }
        return {**pictures, OBS_STATE: self._state()}

    def _state(self) -> Tensor:
        """(1, S) as read last; NaN where nothing usable was."""
        seen = self._observation or {}
        return torch.tensor([[as_number(seen.get(name)) for name in self._trained_on.state_names]])

    def _pose(self) -> np.ndarray:
        """(1, S), the last reading of each number of the state that is believed; NaN where there is none."""
        guard, state = self.filter.shield.guard, on_host(self._state())
        before = np.full_like(state, np.nan) if guard.pose is None else guard.pose
        missed = np.zeros_like(state) if guard.missed is None else guard.missed
        return np.where(self.filter.model.limits.believable(state, before, missed), state, before)

    def _say_once(self, message: str) -> None:
        if message not in self._said:
            logger.warning(message)
            self._said.add(message)

    def _forget(self) -> None:
        """Start an episode: nothing seen, nothing decided."""
        self.filter.shield.reset()
        self._observation, self._fresh, self._seen_at, self._unread = None, False, 0.0, 0
        self._decision, self._untaken = None, None
        self._recorded, self._unjudged = False, False
        self._moved: dict[str, float] = {}
        self._said: set[str] = set()


def _kind(numbers: dict[str, float]) -> str:
    return f"a command of {', '.join(numbers) or 'nothing'}"


_connected: list[LatentSafeShielded] = []


def connected_shield() -> LatentSafeShielded:
    """The shielded robot that this process connected last."""
    return _connected[-1]
