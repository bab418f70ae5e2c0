"""A new constraint without training, on the car: beside a value that was trained for it, and beside looking ahead.

Constraints are discs elsewhere, two discs, and a line. A person marks them in recordings that no training saw. The
truth is the exact solution on a grid.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.collection.dubins import random_episodes
from lerobot_latentsafe.constraints import Prototype
from lerobot_latentsafe.critic import SafetyCritic
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.dubins.ground_truth import solve_grid
from lerobot_latentsafe.evaluation.rollouts import Choice, steps
from lerobot_latentsafe.experiments.dubins.monitor import CarWorld, LatentMonitor
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reachability import look_ahead
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.shield import Shield
from lerobot_latentsafe.training import fit_margin, learn_critic, load_with_cache, seen_and_imagined

GRID, HEADINGS = 89, 60
"""Nodes of the exact solution."""
HORIZON = 25
"""Steps for which a policy of the filter's own is followed."""
METHODS = ("conditioned", "dedicated", "gpi")
EPSILONS = (0.0, 0.1, 0.3, 0.6, 0.9)
RUN = 60
"""Steps of a run, 3 s: the car crosses the view in 2."""

Inside = Callable[[np.ndarray], np.ndarray]
"""Signed distance of states (N, 3) to what is forbidden, in m, negative inside: (N,)."""


def disc(x: float, y: float, radius: float) -> Inside:
    """A disc."""
    return lambda states: np.hypot(states[..., 0] - x, states[..., 1] - y) - radius


@dataclass(frozen=True)
class Case:
    """What is forbidden.

    Attributes:
        zones: name of a constraint -> where it is.
        aims: (K, 2), where a reckless driver heads, to the nearest.
        of: the numbers that count for it; None: all.
    """

    zones: dict[str, Inside]
    aims: np.ndarray
    of: list[str] | None = None

    def margin(self, states: np.ndarray) -> np.ndarray:
        """Signed distance to all that is forbidden, m: (N,)."""
        return np.min([zone(states) for zone in self.zones.values()], 0)


def _discs(**zones: tuple[float, float, float]) -> Case:
    return Case({name: disc(*zone) for name, zone in zones.items()}, np.array([zone[:2] for zone in zones.values()]))


CASES = {
    "a disc elsewhere": _discs(zone=(0.45, 0.35, 0.35)),
    "a small disc": _discs(zone=(-0.4, -0.45, 0.25)),
    "two discs": _discs(north=(-0.1, 0.5, 0.3), south=(0.2, -0.4, 0.3)),
    "a line": Case({"left_of_line": lambda states: states[..., 0] + 0.6}, np.array([[-1.0, 0.0]]), ["x.pos"]),
}


class Truth:
    """The exact value of a case, on a grid that fills the camera's view; beyond it a run is over."""

    def __init__(self, case: Case):
        value, _ = solve_grid(GRID, HEADINGS, car.VIEW, margin=case.margin)
        axis = np.linspace(-car.VIEW, car.VIEW, GRID)
        headings = np.linspace(0, 2 * np.pi, HEADINGS, endpoint=False)
        self.states = np.stack(np.meshgrid(axis, axis, headings, indexing="ij"), -1).reshape(-1, 3)
        self.value = value.reshape(-1)

    def sample(self, n: int, seed: int, kept: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Some nodes (n, 3) and their value (n,), of those that are kept (bool), by default all."""
        rows = np.flatnonzero(np.ones_like(self.value, bool) if kept is None else kept)
        rows = np.random.default_rng(seed).choice(rows, n, replace=False)
        return self.states[rows], self.value[rows]


# -- what a person marks ---


def recordings(n: int, seed: int) -> list[np.ndarray]:
    """States (T, 3) of random recordings that no training saw."""
    return [episode.states for episode in random_episodes(n, np.random.default_rng(seed), car.TURN_RATES)]


def passing(zone: Inside, episodes: list[np.ndarray], n: int) -> list[np.ndarray]:
    """The first n recordings that pass through a zone, and begin outside of it."""
    found = [states for states in episodes if zone(states[:1])[0] > 0 and (zone(states) < 0).sum() >= 4]
    return found[:n]


def mark(monitor: LatentMonitor, case: Case, episodes: list[np.ndarray], pictures: bool) -> dict[str, list[Prototype]]:
    """The constraints of a case, of three recordings each.

    Args:
        pictures: one failing frame is marked in each, where the car is deepest inside; else all frames are labelled.
    """
    likeness, found = monitor.model.config.likeness, {}
    for name, zone in case.zones.items():
        marked = passing(zone, episodes, 3)
        if pictures:
            frames = np.stack([states[zone(states).argmin()] for states in marked])
        else:
            frames = np.concatenate(marked)
        latent, fails = monitor.latent(frames), zone(frames) < 0
        with torch.no_grad():
            where = monitor.model.likeness(monitor.model.world_model.features(latent)).numpy()
        found[name] = likeness.prototypes(where[fails], where[~fails], case.of)
    return found


def with_constraints(policy: LatentSafePolicy, known: dict[str, list[Prototype]]) -> None:
    """Let these constraints count, and no others."""
    config = policy.config
    config.change(constraints=[])
    config.change(likeness=replace(config.likeness, known=known), constraints=[*known])


# -- those that it is compared with ---


def dedicated(path: str, dataset, case: Case, positions: np.ndarray, seed: int, steps: int | None) -> LatentSafePolicy:
    """A filter of the same world model whose margin and critic were trained for a case, with all frames labelled."""
    policy, reader = load_with_cache(path, dataset.meta, seed)
    reader.labels = replace(reader.labels, failure=(case.margin(positions) < 0).astype(np.int8))
    config, generator = policy.config, torch.Generator().manual_seed(seed)
    features, failure = seen_and_imagined(policy.model, reader, config.margin.clips, generator)
    policy.model.margin = policy.model.new_margin()
    fit_margin(policy.model.margin, features, failure, config.margin.delta, generator, noise=config.margin.noise)
    learn_critic(policy, reader, seed, steps)
    return policy.eval()


def follow(model: SafetyModel, latent: Latent, critic: SafetyCritic) -> tuple[Tensor, Tensor]:
    """The worst margin of the constraints under the fallback policy of another critic (N,), and its first action."""
    imagination = model.imagination
    features, worst = imagination.judged(latent)
    over = torch.zeros_like(worst, dtype=torch.bool)
    first = None
    for _ in range(HORIZON):
        action = critic.fallback(features[:, : model.world_model.feature_dim])
        first = action if first is None else first
        latent = imagination.step(latent, action)
        features, margin = imagination.judged(latent)
        worst = torch.where(over, worst, torch.minimum(worst, margin))
        over = over | imagination.ended(latent)
    return worst, first


def improve_by_looking_ahead(policy: LatentSafePolicy, critic: SafetyCritic) -> None:
    """Generalised policy improvement: V is the best of the filter's own policies, under the new margin.

    These are each action held, and the fallback policy that was learned for the old failure.
    """
    model = policy.model

    def plan(latent: Latent) -> tuple[Tensor, Tensor]:
        held, action = look_ahead(model.imagination, latent, model.critic.held_actions(), HORIZON)
        old, first = follow(model, latent, critic)
        return torch.maximum(held, old), torch.where((old > held)[:, None], first, action)

    model.plan = plan


# -- what is measured ---


def drive(policy: LatentSafePolicy | None, case: Case, starts: np.ndarray) -> dict[str, np.ndarray]:
    """Runs of a driver that heads for the nearest forbidden place, from each start, shielded if there is a filter.

    Returns:
        failed: bool (N,). changed: (N,), share of the steps in view that the filter changed.
    """
    shield = None if policy is None else Shield(policy.model, standing_still)
    renderer = car.Renderer()

    def act(states: np.ndarray) -> Choice:
        rates = reckless(states, case.aims)
        if shield is None:
            return Choice(rates)
        seen = car.observe(states, renderer)
        picture = torch.from_numpy(seen["image"]).permute(0, 3, 1, 2).float() / 255
        observation = {"observation.image": picture, "observation.state": torch.from_numpy(seen["heading"])}
        proposed = torch.from_numpy(np.stack([rates, np.full_like(rates, car.SPEED)], -1)).float()
        decision = shield(observation, proposed)
        return Choice(decision.action.numpy()[:, 0].astype(float), decision)

    failed, changed, lived = np.zeros(len(starts), bool), np.zeros(len(starts)), np.zeros(len(starts))
    for step in steps(CarWorld(starts, RUN), act):
        states, _ = step.info
        failed |= step.alive & car.in_view(states) & (case.margin(states) < 0)
        lived += step.alive
        if step.decision is not None:
            changed += step.alive & step.decision.intervened.numpy()
    return {"failed": failed, "changed": changed / lived}


def reckless(states: np.ndarray, aims: np.ndarray) -> np.ndarray:
    """Turn rates (N,) towards the nearest of some places (K, 2)."""
    to = aims - states[:, None, :2]
    to = to[np.arange(len(to)), np.hypot(*to.transpose(2, 0, 1)).argmin(1)]
    error = np.arctan2(to[:, 1], to[:, 0]) - states[:, 2]
    return np.clip(3 * ((error + np.pi) % (2 * np.pi) - np.pi), -car.MAX_TURN_RATE, car.MAX_TURN_RATE)


def starts_of(truth: Truth, n: int, seed: int) -> np.ndarray:
    """Starts from which the exact controller stays safe by 5 cm."""
    inner = np.abs(truth.states[:, :2]).max(1) < 0.9
    return truth.sample(n, seed, (truth.value > 0.05) & inner)[0]


def under_law(policy: LatentSafePolicy, **changes: object) -> LatentSafePolicy:
    """The policy, whose law was changed."""
    policy.config.change(law=replace(policy.config.law, **changes))
    return policy
