"""How close a safety monitor comes to the exact safe set, and how good its fallback policy is (Table 1)."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.critic import SafetyCritic
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.dubins.ground_truth import exact_value
from lerobot_latentsafe.evaluation.statistics import confusion
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reachability import look_ahead


class Monitor(Protocol):
    """A safety value and a fallback policy for the car."""

    def value(self, states: np.ndarray) -> np.ndarray:
        """V of states (N, 3) -> (N,); safe where positive."""

    def start(self) -> Callable[[np.ndarray], np.ndarray]:
        """A fresh fallback policy: called with the current states (N, 3) at each tick, gives turn rates (N,)."""


class LatentMonitor:
    """A latent safety filter that sees the car through its camera.

    For V, a state is shown as a history of two frames: the one before it under a straight action, and itself.
    The fallback policy filters every frame of its rollout.
    """

    def __init__(self, policy: LatentSafePolicy, chunk: int = 2048):
        policy.require_stage("reachability")
        names, fps = policy.config.state_names, policy.config.fps
        if fps != car.FPS or names != car.STATE_NAMES:
            raise ValueError(
                f"this filter was trained at {fps} fps on {names}; the car runs at {car.FPS} fps with {car.STATE_NAMES}"
            )
        self.policy, self.chunk = policy, chunk
        self.renderer = car.Renderer()

    @torch.no_grad()
    def value(self, states: np.ndarray) -> np.ndarray:
        parts = [self.policy.value(self.latent(states[i : i + self.chunk])) for i in range(0, len(states), self.chunk)]
        return torch.cat(parts).cpu().numpy()

    @torch.no_grad()
    def margin(self, states: np.ndarray) -> np.ndarray:
        """Bounded margin l: what the failure classifier alone would say."""
        parts = []
        for i in range(0, len(states), self.chunk):
            features = self.policy.world_model.features(self.latent(states[i : i + self.chunk]))
            parts.append(self.policy.margin.bounded(features))
        return torch.cat(parts).cpu().numpy()

    @torch.no_grad()
    def latent(self, states: np.ndarray) -> dict[str, Tensor]:
        """Posterior latents of states (N, 3) after the two-frame history."""
        heading = states[:, 2]
        travelled = car.DT * car.SPEED * np.stack([np.cos(heading), np.sin(heading)], -1)
        before = np.concatenate([states[:, :2] - travelled, heading[:, None]], -1)
        straight = self.policy.normalise_action(torch.tensor([[0.0, car.SPEED]], device=self.policy.device))
        latent = self.policy.world_model.observe(None, None, *self._see(before))
        return self.policy.world_model.observe(latent, straight.expand(len(states), -1), *self._see(states))

    def start(self) -> Callable[[np.ndarray], np.ndarray]:
        return self.drive(lambda latent: self.policy.plan(latent)[1])

    def drive(self, choose: Callable[[dict[str, Tensor]], Tensor]) -> Callable[[np.ndarray], np.ndarray]:
        """A driver that filters every frame it sees and takes the action (N, A) chosen for the latent."""
        policy = self.policy
        latent, action = None, None

        @torch.no_grad()
        def act(states: np.ndarray) -> np.ndarray:
            nonlocal latent, action
            latent = policy.world_model.observe(latent, action, *self._see(states))
            action = choose(latent)
            return policy.denormalise_action(action).cpu().numpy()[:, 0]

        return act

    def _see(self, states: np.ndarray) -> tuple[dict[str, Tensor], Tensor]:
        seen = car.observe(states, self.renderer)
        image = torch.from_numpy(seen["image"]).permute(0, 3, 1, 2).to(self.policy.device)
        images = {key: self.policy.model_images(image) for key in self.policy.world_model.image_keys}
        return self.policy.world_model.perceive(images), self.policy.normalise_state(
            torch.from_numpy(seen["heading"]).to(self.policy.device)
        )


class PrivilegedMonitor:
    """The same learner's critic on the true state."""

    def __init__(self, imagination, critic: SafetyCritic):
        self.imagination, self.critic = imagination, critic

    @torch.no_grad()
    def value(self, states: np.ndarray) -> np.ndarray:
        latent = {"state": torch.from_numpy(states).float()}
        return self.critic.value(self.imagination.features(latent), self.imagination.margin(latent)).numpy()

    def start(self) -> Callable[[np.ndarray], np.ndarray]:
        @torch.no_grad()
        def act(states: np.ndarray) -> np.ndarray:
            features = self.imagination.features({"state": torch.from_numpy(states).float()})
            return car.MAX_TURN_RATE * self.critic.fallback(features).numpy()[:, 0]

        return act


class PlanMonitor:
    """No reachability learning at all: imagine each held action for `horizon` steps, keep the best worst margin.

    What a simple planner makes of the same world model and margin; a row that keeps the learned value honest.
    """

    def __init__(self, latent: LatentMonitor, horizon: int = 25):
        self.latent_monitor, self.horizon = latent, horizon

    def value(self, states: np.ndarray) -> np.ndarray:
        monitor, size = self.latent_monitor, self.latent_monitor.chunk
        parts = [self._plan(monitor.latent(states[i : i + size]))[0] for i in range(0, len(states), size)]
        return torch.cat(parts).cpu().numpy()

    def start(self) -> Callable[[np.ndarray], np.ndarray]:
        return self.latent_monitor.drive(lambda latent: self._plan(latent)[1])

    def _plan(self, latent: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        policy = self.latent_monitor.policy
        return look_ahead(policy.imagination, latent, policy.critic.held_actions(), self.horizon)


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


def safe_policy_rollouts(monitor: Monitor, starts: np.ndarray, n_steps: int = 100) -> dict:
    """Let the fallback policy drive from each start: {safe, n} and the trajectories.

    A run is safe if the car never enters the failure set within `n_steps` while it is in the camera's view;
    a car that has left the view is no longer seen and its run is over.
    """
    act = monitor.start()
    states, failed = starts.copy(), np.zeros(len(starts), bool)
    visible = np.ones(len(starts), bool)
    trajectory = [states]
    for _ in range(n_steps):
        states = np.where(visible[:, None], car.step(states, act(states)), states)
        visible &= car.in_view(states)
        failed |= visible & (car.margin(states) < 0)
        trajectory.append(states)
        if not visible.any():
            break
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
