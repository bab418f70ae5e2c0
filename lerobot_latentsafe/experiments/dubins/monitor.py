"""How close a safety monitor comes to the exact safe set, and how good its fallback policy is (Table 1)."""

from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.critic import SafetyCritic
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.dubins.ground_truth import exact_value
from lerobot_latentsafe.evaluation.rollouts import Choice, steps
from lerobot_latentsafe.evaluation.statistics import confusion
from lerobot_latentsafe.experiments.dubins.privileged import DubinsImagination
from lerobot_latentsafe.latent import Latent, select
from lerobot_latentsafe.reachability import look_ahead
from lerobot_latentsafe.safety_model import SafetyModel

Driver = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Called at each tick with the states (M, 3) of the cars that still drive, and with bool (L,), which of the L of the
tick before they are; gives turn rates (M,)."""


Margin = Callable[[np.ndarray], np.ndarray]
"""l of states (N, 3) -> (N,), negative where they fail."""


class Monitor(Protocol):
    """A safety value and a fallback policy for the car."""

    def value(self, states: np.ndarray) -> np.ndarray:
        """V of states (N, 3) -> (N,); safe where positive."""

    def start(self) -> Driver:
        """A fresh fallback policy."""


class LatentMonitor:
    """The safety model of a filter that sees the car through its camera.

    For V, a state is shown as a history of two frames: the one before it under a straight action, and itself.
    The fallback policy filters every frame of its rollout.
    """

    def __init__(self, model: SafetyModel, chunk: int = 2048):
        model.require_stage("critic")
        names, fps = model.config.trained_on.state_names, model.config.trained_on.fps
        if fps != car.FPS or names != car.STATE_NAMES:
            raise ValueError(
                f"this filter was trained at {fps} fps on {names}; the car runs at {car.FPS} fps with {car.STATE_NAMES}"
            )
        self.model, self.chunk = model, chunk
        self.renderer = car.Renderer()

    @torch.no_grad()
    def value(self, states: np.ndarray) -> np.ndarray:
        """V of states (N, 3) after the two-frame history."""
        parts = [self.model.value(latent) for latent in self.latents(states)]
        return torch.cat(parts).cpu().numpy()

    @torch.no_grad()
    def safe(self, latent: Latent) -> Tensor:
        """Whether V > 0 of latents: bool (B,), at a third of the cost of V.

        V is the best of several ways to go on. Where the critic's is safe, or l has failed, the others change nothing.
        """
        model, law = self.model, self.model.config.law
        if law.critic is None:
            return model.value(latent) > 0
        imagination, horizon = model.imagination, model.config.world_model.steps(law.lookahead)
        value = look_ahead(imagination, latent, model.units.still[:0], horizon, model.critic)[0]
        open_still = (value <= 0) & (imagination.margin(latent) > 0)
        if open_still.any():
            value[open_still] = model.value(select(latent, open_still))
        return value > 0

    @torch.no_grad()
    def margin(self, states: np.ndarray) -> np.ndarray:
        """Bounded margin l: what the failure classifier alone would say."""
        parts = [self.model.imagination.margin(latent) for latent in self.latents(states)]
        return torch.cat(parts).cpu().numpy()

    def latents(self, states: np.ndarray) -> Iterator[Latent]:
        """Those of `latent`, of so many states at a time as fit in memory."""
        for i in range(0, len(states), self.chunk):
            yield self.latent(states[i : i + self.chunk])

    @torch.no_grad()
    def latent(self, states: np.ndarray) -> Latent:
        """Posterior latents of states (N, 3) after the two-frame history."""
        heading = states[:, 2]
        travelled = car.DT * car.SPEED * np.stack([np.cos(heading), np.sin(heading)], -1)
        before = np.concatenate([states[:, :2] - travelled, heading[:, None]], -1)
        units, world_model = self.model.units, self.model.world_model
        straight = units.normalise_action(torch.tensor([[0.0, car.SPEED]], device=units.device))
        latent = world_model.observe(None, None, *self._see(before))
        return world_model.observe(latent, straight.expand(len(states), -1), *self._see(states))

    def start(self) -> Driver:
        """The fallback policy."""
        return self.drive(lambda latent: self.model.plan(latent)[1])

    def drive(self, choose: Callable[[Latent], Tensor]) -> Driver:
        """A driver that filters every frame it sees and takes the action (N, A) chosen for the latent."""
        model, latent, action = self.model, None, None

        @torch.no_grad()
        def act(states: np.ndarray, kept: np.ndarray) -> np.ndarray:
            nonlocal latent, action
            if latent is not None:
                rows = torch.from_numpy(kept).to(model.device)
                latent, action = select(latent, rows), action[rows]
            latent = model.world_model.observe(latent, action, *self._see(states))
            action = choose(latent)
            return model.units.denormalise_action(action).cpu().numpy()[:, 0]

        return act

    def _see(self, states: np.ndarray) -> tuple[dict[str, Tensor], Tensor]:
        seen = car.observe(states, self.renderer)
        image = torch.from_numpy(seen["image"]).permute(0, 3, 1, 2)
        images = dict.fromkeys(self.model.world_model.image_keys, image)
        return self.model.see({**images, "observation.state": torch.from_numpy(seen["heading"])})


class PrivilegedMonitor:
    """The same learner's critic on the true state."""

    def __init__(self, imagination: DubinsImagination, critic: SafetyCritic):
        self.imagination, self.critic = imagination, critic

    @torch.no_grad()
    def value(self, states: np.ndarray) -> np.ndarray:
        """V of states (N, 3)."""
        latent = {"state": torch.from_numpy(states).float()}
        return self.critic.value(self.imagination.features(latent), self.imagination.margin(latent)).numpy()

    def start(self) -> Driver:
        """The critic's policy."""

        @torch.no_grad()
        def act(states: np.ndarray, _: np.ndarray) -> np.ndarray:
            features = self.imagination.features({"state": torch.from_numpy(states).float()})
            return car.MAX_TURN_RATE * self.critic.fallback(features).numpy()[:, 0]

        return act


class PlanMonitor:
    """No reachability learning at all: imagine each held action for `horizon` steps, keep the best worst margin.

    What a simple planner makes of the same world model and margin; a row that keeps the learned value honest.
    """

    def __init__(self, latent: LatentMonitor, horizon: int = 25):
        self.latent_monitor, self.horizon = latent, horizon

    @torch.no_grad()
    def value(self, states: np.ndarray) -> np.ndarray:
        """V of states (N, 3) after the two-frame history."""
        parts = [self._plan(latent)[0] for latent in self.latent_monitor.latents(states)]
        return torch.cat(parts).cpu().numpy()

    def start(self) -> Driver:
        """The first action of the best plan, anew at each tick."""
        return self.latent_monitor.drive(lambda latent: self._plan(latent)[1])

    def _plan(self, latent: Latent) -> tuple[Tensor, Tensor]:
        model = self.latent_monitor.model
        return look_ahead(model.imagination, latent, model.critic.held_actions(), self.horizon)


def feasible_starts(truth: Callable[[np.ndarray], np.ndarray] = exact_value) -> np.ndarray:
    """The paper's starts: the states of a 10 x 10 x 3 grid from which the exact controller stays safe."""
    axis = np.linspace(-car.ARENA, car.ARENA, 10)
    headings = np.array([0.0, 2 * np.pi / 3, 4 * np.pi / 3])
    states = np.stack(np.meshgrid(axis, axis, headings, indexing="ij"), -1).reshape(-1, 3)
    return states[truth(states) > 0]


def boundary_starts(n: int, seed: int, low: float = 0.0, high: float = 0.05) -> np.ndarray:
    """Starts that are safe by a hair: uniform states of the arena with low < V < high (m^2)."""
    rng = np.random.default_rng(seed)
    found: list[np.ndarray] = []
    while sum(map(len, found)) < n:
        states = rng.uniform([-1, -1, -np.pi], [1, 1, np.pi], (20_000, 3))
        value = exact_value(states)
        found.append(states[(value > low) & (value < high)])
    return np.concatenate(found)[:n]


class CarWorld:
    """The car in many states side by side; one that has failed or left the camera's view stays there: its run is over.

    Actors see the states (M, 3) of those that still drive, and bool (L,), which of the L of the tick before they are.
    They choose turn rates (M,).

    Attributes:
        info: all states (N, 3), and which of them are failures in view: bool (N,).
    """

    def __init__(self, starts: np.ndarray, n_steps: int, margin: Margin = car.margin):
        self.margin, self.left, self._drives = margin, n_steps, np.ones(len(starts), bool)
        self._kept = self._drives
        self.info = (starts.copy(), np.zeros(len(starts), bool))

    @property
    def over(self) -> np.ndarray:
        """Which have failed or are out of view, or all after the last step: bool (N,)."""
        return ~self._drives | (self.left == 0)

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        """What an actor sees."""
        return self.info[0][self._drives], self._kept

    def step(self, turn_rates: np.ndarray) -> None:
        """Drive on."""
        states, failing = self.info[0].copy(), self.info[1].copy()
        states[self._drives] = car.step(states[self._drives], turn_rates)
        visible = car.in_view(states)
        failing |= self._drives & visible & (self.margin(states) < 0)
        before, self._drives = self._drives, self._drives & visible & ~failing
        self._kept = self._drives[before]
        self.info, self.left = (states, failing), self.left - 1


def safe_policy_rollouts(monitor: Monitor, starts: np.ndarray, n_steps: int = 100, margin: Margin = car.margin) -> dict:
    """Let the fallback policy drive from each start: {safe, n} and the trajectories.

    A run is safe if the car never enters the failure set within `n_steps` while it is in the camera's view;
    a car that has left the view is no longer seen and its run is over.
    """
    act, trajectory, failed = monitor.start(), [starts], np.zeros(len(starts), bool)
    for step in steps(CarWorld(starts, n_steps, margin), lambda seen: Choice(act(*seen))):
        states, failed = step.info
        trajectory.append(states)
    return {
        "safe": int((~failed).sum()),
        "n": len(starts),
        "trajectories": np.stack(trajectory, 1),
        "failed": failed,
    }


def evaluate_monitor(monitor: Monitor, states: np.ndarray, true_value: np.ndarray) -> tuple[dict, np.ndarray]:
    """Confusion with the truth and safe-policy rollouts: the row of Table 1, and V of the states (N,)."""
    value = monitor.value(states)
    if not np.isfinite(value).all():
        raise FloatingPointError(f"V is not finite on {(~np.isfinite(value)).sum()} of {len(value)} states")
    runs = safe_policy_rollouts(monitor, feasible_starts())
    row = confusion(value > 0, true_value > 0)
    row["safe_policy"] = {"safe": runs["safe"], "n": runs["n"]}
    return row, value
