"""A new constraint without training, on the car: beside a value that was trained for it, and beside looking ahead.

Constraints are discs elsewhere, two discs, and a line. A person marks them in recordings that no training saw. The
truth is the exact solution on a grid.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from lerobot_latentsafe.collection.dubins import random_episodes
from lerobot_latentsafe.constraint_training import numbers_named
from lerobot_latentsafe.constraints import LikenessConfig, Prototype
from lerobot_latentsafe.critic import SafetyCritic
from lerobot_latentsafe.datasets.folder import load_metadata
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.dubins.ground_truth import solve_grid
from lerobot_latentsafe.evaluation.rollouts import Choice, steps
from lerobot_latentsafe.evaluation.statistics import confusion, provenance, run_resumable, wilson, write_json
from lerobot_latentsafe.experiments.dubins.monitor import LatentMonitor
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.reachability import look_ahead
from lerobot_latentsafe.reports.figures import save
from lerobot_latentsafe.runtime.hub import save_policy
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.shield import Shield
from lerobot_latentsafe.training import fit_new_margin, learn_critic, load_with_cache

GRID, HEADINGS = 67, 48
"""Nodes of the exact solution, over the camera's view."""
HORIZON = 25
"""Steps for which looking ahead follows a policy of the filter's own."""
METHODS = ("conditioned", "three pictures", "looking ahead", "dedicated")
LOOKAHEAD, PROPOSAL_STEPS, EPSILON = 5, 3, 0.3
"""Of the law of all of them, chosen before any of them was run."""
N_STATES, N_RUNS, RUN = 2000, 60, 50
"""States that are judged; runs, and steps of each: the car crosses the view in 44."""
ALIKE = {"x.pos": 0.25, "y.pos": 0.25}
RECORDINGS = 500
"""Seed of the recordings in which constraints are marked."""

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
    config.change(likeness=replace(config.likeness, known=known), constraints=[*known])


# -- those that it is compared with ---


def constrained(path: str, meta, seed: int, steps: int, folder: Path) -> None:
    """Train a critic that takes constraints on the world model of a filter, and save the filter."""
    policy, reader = load_with_cache(path, meta, seed)
    smaller(policy)
    learn_critic(policy, reader, seed, steps, likeness=LikenessConfig(ALIKE), numbers=numbers_named(meta, [*ALIKE]))
    save_policy(policy, folder)


def dedicated(path: str, meta, case: Case, seed: int, steps: int, folder: Path) -> None:
    """The same with a margin and a critic for one case, of which all frames are labelled."""
    policy, reader = load_with_cache(path, meta, seed)
    smaller(policy)
    positions = numbers_named(meta, [*ALIKE])
    reader.labels = replace(reader.labels, failure=(case.margin(positions) < 0).astype(np.int8))
    fit_new_margin(policy.model, reader, torch.Generator().manual_seed(seed))
    learn_critic(policy, reader, seed, steps)
    save_policy(policy, folder)


def smaller(policy: LatentSafePolicy) -> None:
    """Train on less, as both kinds of critics do here."""
    config = policy.config
    config.change(
        margin=replace(config.margin, clips=2000),
        reachability=replace(config.reachability, pool=65536),
        frame_cache=None,
    )


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


class Cars:
    """Cars in many states side by side, all of which drive on until the time is up; `info` holds the states (N, 3)."""

    def __init__(self, starts: np.ndarray, n_steps: int):
        self.info, self.left, self._gone = starts.copy(), n_steps, np.zeros(len(starts), bool)

    @property
    def over(self) -> np.ndarray:
        """Which have left the camera's view, or all after the last step: bool (N,)."""
        return self._gone | (self.left == 0)

    def observe(self) -> np.ndarray:
        """The states (N, 3), also of those that are out of view."""
        return self.info

    def step(self, turn_rates: np.ndarray) -> None:
        """Drive on by turn rates (N,)."""
        self.info, self.left = car.step(self.info, turn_rates), self.left - 1
        self._gone = self._gone | ~car.in_view(self.info)


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
    for step in steps(Cars(starts, RUN), act):
        states = step.info
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


class Filters:
    """Filters of one world model, each trained once and kept in a folder.

    Args:
        base: the filter whose world model is used, and whose fallback was learned for the old failure.
        dataset_root: cached recordings of `latentsafe collect --source=random_located`.
        folder: where filters are kept.
        steps: gradient steps of each critic.
    """

    def __init__(self, base: str, dataset_root: Path, folder: Path, steps: int):
        self.base, self.folder, self.steps = base, folder, steps
        self.meta = load_metadata("latentsafe/car_located", dataset_root)

    def constrained(self, seed: int) -> LatentSafePolicy:
        """The filter that takes constraints."""
        folder = self.folder / f"constrained_{seed}"
        if not folder.exists():
            constrained(self.base, self.meta, seed, self.steps, folder)
        return load_filter(folder)

    def dedicated(self, name: str, case: Case, seed: int) -> LatentSafePolicy:
        """The filter that was trained for a case, which is kept under this name."""
        folder = self.folder / f"{name.replace(' ', '_')}_{seed}"
        if not folder.exists():
            dedicated(self.base, self.meta, case, seed, self.steps, folder)
        return load_filter(folder)


class Study(Filters):
    """Constraints by several methods."""

    def __init__(self, base: str, dataset_root: Path, folder: Path, steps: int):
        super().__init__(base, dataset_root, folder, steps)
        self.episodes = recordings(400, RECORDINGS)
        self.truth = cache(lambda name: Truth(CASES[name]))

    def policy(self, name: str, method: str, seed: int) -> LatentSafePolicy:
        """A filter for a case, by a method, under the study's law."""
        policy = self.dedicated(name, CASES[name], seed) if method == "dedicated" else self.constrained(seed)
        law = replace(policy.config.law, lookahead=LOOKAHEAD, proposal_steps=PROPOSAL_STEPS, epsilon=EPSILON)
        policy.config.change(law=law)
        if method != "dedicated":
            known = mark(LatentMonitor(policy.model), CASES[name], self.episodes, method == "three pictures")
            with_constraints(policy, known)
        if method == "looking ahead":
            improve_by_looking_ahead(policy, load_filter(self.base).model.critic)
        return policy

    def run(self, job: dict) -> dict:
        """A case by a method: verdicts on states against the truth, or runs of a reckless driver."""
        torch.set_num_threads(1)
        name, truth, case = job["case"], self.truth(job["case"]), CASES[job["case"]]
        starts = starts_of(truth, N_RUNS, 1)
        if job["method"] == "bare":
            return runs_of(drive(None, case, starts))
        policy = self.policy(name, job["method"], job["seed"])
        if job["what"] == "runs":
            return runs_of(drive(policy, case, starts))
        monitor = LatentMonitor(policy.model)
        states, value = truth.sample(N_STATES, 0)
        found = {"verdicts": confusion(monitor.value(states) > 0, value > 0)}
        if job["method"] != "looking ahead":
            policy.config.change(law=replace(policy.config.law, lookahead=0))
            found["critic_alone"] = confusion(monitor.value(states) > 0, value > 0)
        found["margin"] = confusion(monitor.margin(states) > 0, case.margin(states) > 0)
        if policy.config.constraints:
            found["prototypes"] = policy.config.likeness.known
        return found


def runs_of(found: dict[str, np.ndarray]) -> dict:
    """Violations with their interval, and the share of steps that were changed."""
    failed = found["failed"]
    return {"violation": wilson(int(failed.sum()), len(failed)), "changed_share": float(found["changed"].mean())}


def jobs_of(cases: list[str], seeds: list[int], steps: int) -> list[dict]:
    """All that is measured: verdicts first, then runs."""
    made_by = {"steps": steps}
    verdicts = [(case, method, seed, "verdicts") for seed in seeds for method in METHODS for case in cases]
    bare = [(case, "bare", 0, "runs") for case in cases]
    runs = [(case, method, seed, "runs") for seed in seeds for method in METHODS for case in cases]
    names = ("case", "method", "seed", "what")
    return [{**dict(zip(names, each)), **made_by} for each in [*verdicts, *bare, *runs]]


def summary(jobs: list[dict], rows: list[dict], cases: list[str], seeds: list[int]) -> dict:
    """Case -> method -> figures of each seed, and how far the constraint is from the dedicated value."""
    found: dict[str, dict] = {case: {} for case in cases}
    for job, row in zip(jobs, rows):
        of = found[job["case"]].setdefault(job["method"], {"seeds": [{} for _ in seeds]})
        if job["method"] == "bare":
            found[job["case"]]["bare"] = row
            continue
        of["seeds"][seeds.index(job["seed"])] |= {"runs": row} if job["what"] == "runs" else row
    for methods in found.values():
        for method in METHODS:
            methods[method] |= pooled(methods[method]["seeds"])
    accuracy = lambda method: float(  # noqa: E731
        np.mean([methods[method]["balanced_accuracy"] for methods in found.values()])
    )
    points = {method: accuracy(method) for method in METHODS}
    violations = {method: sum(m[method]["violation"]["k"] for m in found.values()) for method in METHODS}
    n = sum(methods["dedicated"]["violation"]["n"] for methods in found.values())
    return {
        "cases": found,
        "balanced_accuracy": points,
        "points_from_dedicated": {m: points[m] - points["dedicated"] for m in METHODS},
        "violation": {method: wilson(k, n) for method, k in violations.items()},
    }


def pooled(seeds: list[dict]) -> dict:
    """Mean balanced accuracy over seeds, and violations of all runs."""
    runs = [row["runs"]["violation"] for row in seeds]
    return {
        "balanced_accuracy": float(np.mean([row["verdicts"]["balanced_accuracy"] for row in seeds])),
        "violation": wilson(sum(run["k"] for run in runs), sum(run["n"] for run in runs)),
        "changed_share": float(np.mean([row["runs"]["changed_share"] for row in seeds])),
    }


def study(base: str, dataset_root: Path, folder: Path, cases: list[str], seeds: list[int], steps: int, output: Path):
    """Measure all cases, and write the table and a picture; what was measured before is kept beside it."""
    made, jobs = Study(base, dataset_root, folder, steps), jobs_of(cases, seeds, steps)
    rows = run_resumable(output.with_suffix(".jsonl"), jobs, made.run)
    minutes = sum(row["cpu_s"] for row in rows) / 60
    law = {"lookahead": LOOKAHEAD, "proposal_steps": PROPOSAL_STEPS, "epsilon": EPSILON, "steps": steps}
    table = {"summary": summary(jobs, rows, cases, seeds), "law": law, **provenance(seeds, minutes)}
    write_json(output, table)
    name = "two discs" if "two discs" in cases else cases[0]
    policies = {method: made.policy(name, method, seeds[0]) for method in METHODS}
    save(values_of(policies, CASES[name], made.truth(name)), output.with_suffix(".png"))


def values_of(policies: dict[str, LatentSafePolicy], case: Case, truth: Truth, n: int = 41) -> Figure:
    """V over the plane at heading 0, its zero level, and the exact one."""
    figure, axes = plt.subplots(1, len(policies), figsize=(4.1 * len(policies), 4.2), squeeze=False)
    axis, fine = np.linspace(-car.VIEW, car.VIEW, n), np.linspace(-car.VIEW, car.VIEW, GRID)
    x, y = np.meshgrid(axis, axis)
    states = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], -1)
    exact = truth.value.reshape(GRID, GRID, HEADINGS)[:, :, 0].T
    forbidden = case.margin(np.stack([*np.meshgrid(fine, fine), np.zeros((GRID, GRID))], -1))
    for ax, (name, policy) in zip(axes[0], policies.items()):
        value = LatentMonitor(policy.model).value(states).reshape(n, n)
        ax.pcolormesh(x, y, value, cmap="RdBu", vmin=-1, vmax=1, shading="auto")
        ax.contour(x, y, value, [0.0], colors="k", linewidths=2)
        ax.contour(fine, fine, exact, [0.0], colors="k", linewidths=2, linestyles="--")
        ax.contour(fine, fine, forbidden, [0.0], colors="tab:red", linewidths=2)
        ax.set(title=name, aspect="equal", xlabel="x (m)", ylabel="y (m)")
    figure.suptitle("V of a car that heads to the right. Solid: V = 0, dashed: the exact one, red: what is forbidden")
    figure.tight_layout()
    return figure
