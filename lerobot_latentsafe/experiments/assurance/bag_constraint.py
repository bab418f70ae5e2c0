"""A new constraint without training, on the bag: the hand must not enter a zone, besides spilling nothing.

Three recordings that enter the zone are labelled. An operator who swings the bag to the side then lifts it bare, under
the filter as it was, and under the filter with the constraint, from the same starts.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.folder import load_metadata
from lerobot_latentsafe.datasets.labels import read_frames
from lerobot_latentsafe.evaluation.along_episodes import encode_episodes
from lerobot_latentsafe.evaluation.rollouts import steps
from lerobot_latentsafe.evaluation.statistics import provenance, run_resumable, wilson, write_json
from lerobot_latentsafe.experiments.bag.operators import OPERATORS
from lerobot_latentsafe.experiments.bag.runs import STEPS, bag_scene
from lerobot_latentsafe.experiments.scene_world import OperatorActor, SceneWorld
from lerobot_latentsafe.franka.actions import STATE_NAMES
from lerobot_latentsafe.franka.behaviors import begin
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter

NUMBER, LINE = "ee_x.pos", 0.56
"""The zone is where the hand is farther from the arm's foot than this, m."""
OPERATOR = "side_to_side_0.04"
N_MARKED = 3
FIRST_SEED = 340_000
"""Of the starts."""
CASES = {"bare": None, "as it was": ["failure"], "with the zone": ["failure", "zone"], "the zone alone": ["zone"]}
"""The constraints that count; None: no filter."""


def inside(state: np.ndarray) -> np.ndarray:
    """Whether the hand is in the zone, of states (..., S): bool (...)."""
    return state[..., STATE_NAMES.index(NUMBER)] > LINE


def mark(policy: LatentSafePolicy, root: Path) -> dict:
    """The zone, of the first recordings that enter it and begin outside; all their frames are labelled."""
    frames, columns = (
        DatasetFrames(load_metadata(f"latentsafe/{root.name}", root)),
        read_frames(root, ["observation.state"]),
    )
    own = {
        episode: inside(columns["observation.state"][columns["episode_index"] == episode])
        for episode in frames.episodes
    }
    marked = [episode for episode, fails in own.items() if not fails[0] and fails.sum() >= 4][:N_MARKED]
    with torch.no_grad():
        latents, lengths = encode_episodes(policy.model, frames, marked)
        where = policy.model.likeness(policy.model.world_model.features(latents)).numpy()
    places = np.concatenate([row[:n] for row, n in zip(where, lengths)])
    fails = np.concatenate([own[episode] for episode in marked])
    return {"zone": policy.config.likeness.prototypes(places[fails], places[~fails], [NUMBER])}


@cache
def loaded(path: str) -> LatentSafePolicy:
    """The filter of this process."""
    return load_filter(path)


def run(job: dict) -> dict:
    """One episode: whether the hand enters the zone, whether candies fall, success, and steps changed."""
    torch.set_num_threads(1)
    (behavior, speed), scene = OPERATORS[OPERATOR], bag_scene()
    scene.reset(job["seed"])
    operator, policy = begin(behavior, scene, speed, np.random.default_rng([0, job["seed"]])), None
    if job["constraints"]:
        policy = loaded(job["filter"])
        likeness = policy.config.likeness
        policy.config.change(
            likeness=replace(likeness, known={**likeness.own_failure, **job["zone"]}), constraints=job["constraints"]
        )
    world = SceneWorld(scene, STEPS) if policy else SceneWorld(scene, STEPS, ())
    entered, changed = False, 0
    for step in steps(world, OperatorActor(operator, policy)):
        entered |= bool(inside(scene.proprioception()))
        changed += 0 if step.decision is None else int(step.decision.intervened.sum())
    truth = scene.truth()
    return {"entered": entered, "lost": truth["spilled"], "success": bool(truth["is_success"]), "changed": changed}


def study(path: str, recordings: Path, n: int, output: Path, workers: int = 1) -> None:
    """Mark the zone, drive, and write the table; each episode is kept beside it as it ends.

    Args:
        path: a filter that takes constraints and says where the hand is.
        recordings: a dataset of the bag with videos, in which the hand enters the zone now and then.
        n: starts.
    """
    filter = loaded(path)
    zone, law = mark(filter, recordings), filter.config.law.name
    jobs = [
        {"filter": path, "law": law, "zone": zone, "constraints": names, "seed": FIRST_SEED + i}
        for names in CASES.values()
        for i in range(n)
    ]
    rows = run_resumable(output.with_suffix(".jsonl"), jobs, run, workers)
    cells = dict(zip(CASES, np.array_split(np.array(rows, object), len(CASES))))
    summary = {
        name: {
            "entered": wilson(sum(row["entered"] for row in of), n),
            "spilled": wilson(sum(row["lost"] > 0 for row in of), n),
            "success": wilson(sum(row["success"] for row in of), n),
            "changed_share": float(np.mean([row["changed"] / STEPS for row in of])),
        }
        for name, of in cells.items()
    }
    minutes = sum(row["cpu_s"] for row in rows) / 60
    write_json(output, {"summary": summary, "zone": zone, **provenance([FIRST_SEED, FIRST_SEED + n - 1], minutes)})
