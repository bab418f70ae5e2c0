"""Where misses come from, by branching the simulator: of the runs that spill under a filter, what was to blame.

A run is done again, and its states are kept. From each of them the simulator is branched: does the bag keep its candies
if the hand stays, or comes down, from there? The last moment from which one of these saves is the last way out. Then
the first of these that holds is the cause (the causes of `evaluation.misses`):

    doomed       there was no way out at any moment
    fallback     the filter acted in time, and its fallback did not take the way out
    margin       l > 0 of all frames of a third of a second in which candies lie outside: the margin is blind to it
    world_model  l > 0 all along what was then done, imagined from the last way out: it came otherwise
    value        imagination foresees the spill, and the filter did not act
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.evaluation.misses import CAUSES, least_margin
from lerobot_latentsafe.evaluation.rollouts import steps
from lerobot_latentsafe.evaluation.statistics import provenance, run_resumable, write_json
from lerobot_latentsafe.experiments.bag.out_of_distribution import MECHANICS, SEEN, recording
from lerobot_latentsafe.experiments.bag.runs import FIRST_SEED, STEPS, bag_scene
from lerobot_latentsafe.experiments.filter_settings import FilterSetting, as_job
from lerobot_latentsafe.experiments.scene_world import OperatorActor, SceneWorld
from lerobot_latentsafe.franka.bag import BagScene
from lerobot_latentsafe.franka.scene import SceneState
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reports.figures import causes_of_misses, save

DOWN = (0.0, -0.003, -0.006, -0.01)
"""Ways out that are tried: the hand stays, or comes down by so many metres a tick."""
HORIZON = 30
"""Ticks for which a way out must keep the candies in."""
SEEN_FOR = 5
"""Ticks in which a margin must see what lies outside."""


@dataclass(frozen=True)
class Run:
    """A run under a filter, tick by tick.

    Attributes:
        states: of the simulator, before each tick.
        latents: what each decision was made on.
        actions, heard: (T, A), what was executed, in robot units and as the world model hears it.
        acts: bool (T,), whether the filter acted.
        margin: (T,), l of what was seen.
        spilled: bool (T,), whether candies lay outside before each tick.
    """

    states: list[SceneState]
    latents: list[Latent]
    actions: np.ndarray
    heard: Tensor
    acts: np.ndarray
    margin: np.ndarray
    spilled: np.ndarray


def watched(scene: BagScene, policy: LatentSafePolicy, operator: Iterator[np.ndarray]) -> Run:
    """An episode of a scene that has just been reset."""
    states, latents, actions, acts, margin, spilled = [], [], [], [], [], []
    world, shield = SceneWorld(scene, STEPS), policy.shield
    state, outside = scene.get_state(), False
    for step in steps(world, OperatorActor(operator, policy)):
        states.append(state)
        spilled.append(outside)
        latents.append(shield.latent)
        actions.append(step.action[0])
        acts.append(step.decision.intervened.item())
        margin.append(step.decision.margin.item())
        state, outside = scene.get_state(), step.info["failure"]
    done = np.array(actions, np.float32)
    heard = policy.model.units.heard_action(torch.from_numpy(done))
    return Run(states, latents, done, heard, np.array(acts), np.array(margin), np.array(spilled))


def saves(scene: BagScene, state: SceneState, down: float, gripper: float) -> bool:
    """Whether no candy leaves the bag for so long if the hand comes down like this from a state."""
    scene.set_state(state)
    action = np.array([0, 0, down, 0, 0, 0, gripper])
    for _ in range(HORIZON):
        scene.step(action)
        if scene.truth()["failure"]:
            return False
    return True


def last_way_out(scene: BagScene, run: Run, failed: int) -> int | None:
    """The last tick before `failed` from which something saves; None: none does."""
    for t in reversed(range(failed)):
        if any(saves(scene, run.states[t], down, run.actions[t, 6]) for down in DOWN):
            return t
    return None


def cause_of(policy: LatentSafePolicy, run: Run, way_out: int | None) -> str | None:
    """What is to blame, see above; None: nothing spilled."""
    if not run.spilled.any():
        return None
    failed = int(np.flatnonzero(run.spilled)[0])
    if way_out is None:
        return "doomed"
    if run.acts[: way_out + 1].any():
        return "fallback"
    if not (run.margin[failed : failed + SEEN_FOR] <= 0).any():
        return "margin"
    return "value" if imagined_margin(policy, run, way_out, failed) <= 0 else "world_model"


def imagined_margin(policy: LatentSafePolicy, run: Run, seen: int, failed: int) -> float:
    """The least l on the way to tick `failed`, imagined from tick `seen` on under what was then executed."""
    skip, last = policy.model.config.world_model.frame_skip, len(run.heard) - 1
    ticks = (torch.arange(t, t + skip).clamp(max=last) for t in range(seen, failed, skip))
    return least_margin(policy.model, run.latents[seen], (run.heard[some].reshape(1, -1) for some in ticks))


@lru_cache(maxsize=2)
def _filter(setting: FilterSetting) -> LatentSafePolicy:
    torch.set_num_threads(1)
    return setting.load()


def explain(job: dict) -> dict:
    """One run of a variant of the bag from a seed, pulled up by its closed end: its cause, and when things happened."""
    policy, variant = _filter(FilterSetting.from_job(job["filter"])), job["variant"]
    scene = bag_scene(MECHANICS.get(variant, variant))
    operator = iter(recording(job["seed"]))
    scene.reset(job["seed"])
    run = watched(scene, policy, operator)
    if not run.spilled.any():
        return {"cause": None}
    failed = int(np.flatnonzero(run.spilled)[0])
    way_out = last_way_out(scene, run, failed)
    acts = np.flatnonzero(run.acts)
    return {
        "cause": cause_of(policy, run, way_out), "spilled": failed, "way_out": way_out,
        "acted": int(acts[0]) if len(acts) else None,
    }  # fmt: skip


def explain_filters(settings: dict[str, FilterSetting], n: int, output: Path, workers: int = 1) -> None:
    """Explain what spills under each filter on the red bag and on bags that only feel otherwise; write it and draw it.

    Args:
        settings: name -> filter.
        n: starts of each bag.
    """
    variants, seeds = (SEEN, *MECHANICS), range(FIRST_SEED, FIRST_SEED + n)
    cells = [(name, variant, seed) for name in settings for variant in variants for seed in seeds]
    jobs = [{"filter": as_job(settings[name]), "variant": variant, "seed": seed} for name, variant, seed in cells]
    rows = run_resumable(output.with_suffix(".jsonl"), jobs, explain, workers)
    missed: dict[str, dict[str, list]] = {name: {cause: [] for cause in CAUSES} for name in settings}
    for (name, variant, seed), row in zip(cells, rows):
        if row["cause"] is not None:
            when = {key: row[key] for key in ("acted", "way_out", "spilled")}
            missed[name][row["cause"]].append({"bag": variant, "seed": seed, **when})
    counts = {name: {cause: len(runs) for cause, runs in causes.items()} for name, causes in missed.items()}
    print(counts)
    save(causes_of_misses(counts), output.with_suffix(".png"))
    minutes = sum(row["cpu_s"] for row in rows) / 60
    table = {name: {"runs": n * len(variants), "missed": causes} for name, causes in missed.items()}
    write_json(output, {"summary": counts, **table, **provenance([seeds[0], seeds[-1]], minutes)})
