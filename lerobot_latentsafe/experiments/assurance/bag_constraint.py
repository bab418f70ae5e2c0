"""A new constraint without training, on the bag: where the hand must not be, besides spilling nothing.

Three recordings that go there are labelled. An operator who wants to go there then acts bare, under the filter as it
was, and under the filter with the constraint, from the same starts.
"""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

from lerobot_latentsafe.constraints import ConstraintError
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

N_MARKED = 3
FIRST_SEED = 340_000
"""Of the starts."""
CASES = {"bare": None, "as it was": ["failure"], "with it": ["failure", "place"], "it alone": ["place"]}
"""The constraints that count; None: no filter."""


@dataclass(frozen=True)
class Place:
    """Where the hand must not be.

    Attributes:
        between: number of the state -> least and largest there, m; of the gripper, opening.
        operator: who wants to go there.
    """

    between: dict[str, tuple[float, float]]
    operator: str

    def holds(self, state: np.ndarray) -> np.ndarray:
        """Whether the hand is there, of states (..., S): bool (...)."""
        numbers = {name: state[..., STATE_NAMES.index(name)] for name in self.between}
        return np.all([(low < numbers[name]) & (numbers[name] < high) for name, (low, high) in self.between.items()], 0)


PLACES = {
    "zone": Place({"ee_x.pos": (0.56, np.inf)}, "side_to_side_0.04"),
    "too high": Place({"ee_z.pos": (0.20, np.inf), "gripper.pos": (-np.inf, 0.7)}, "middle"),
}
"""The zone is far from the arm's foot; what the hand holds, by at most .6 open fingers, is lifted too high."""


def mark(policy: LatentSafePolicy, root: Path, place: Place) -> list[dict]:
    """The place, of the first recordings that go there and begin elsewhere; all their frames are labelled."""
    frames, columns = (
        DatasetFrames(load_metadata(f"latentsafe/{root.name}", root)),
        read_frames(root, ["observation.state"]),
    )
    own = {
        episode: place.holds(columns["observation.state"][columns["episode_index"] == episode])
        for episode in frames.episodes
    }
    marked = [episode for episode, fails in own.items() if not fails[0] and fails.sum() >= 4][:N_MARKED]
    if not marked:
        raise ConstraintError(
            f"no episode of {root} begins elsewhere and goes where {place.between} holds for 4 frames; expected such "
            "recordings as `latentsafe collect --source=bag_pulls` makes"
        )
    with torch.no_grad():
        latents, lengths = encode_episodes(policy.model, frames, marked)
        where = policy.model.likeness(policy.model.world_model.features(latents)).numpy()
    places = np.concatenate([row[:n] for row, n in zip(where, lengths)])
    fails = np.concatenate([own[episode] for episode in marked])
    return policy.config.likeness.prototypes(places[fails], places[~fails], [*place.between])


@cache
def loaded(path: str) -> LatentSafePolicy:
    """The filter of this process."""
    return load_filter(path)


def run(job: dict) -> dict:
    """One episode: whether the hand goes there, whether candies fall, success, and steps changed."""
    torch.set_num_threads(1)
    place, scene = PLACES[job["place"]], bag_scene()
    behavior, speed = OPERATORS[place.operator]
    scene.reset(job["seed"])
    operator, policy = begin(behavior, scene, speed, np.random.default_rng([0, job["seed"]])), None
    if job["constraints"]:
        policy = loaded(job["filter"])
        likeness = policy.config.likeness
        policy.config.change(
            likeness=replace(likeness, known={**likeness.own_failure, "place": job["prototypes"]}),
            constraints=job["constraints"],
        )
    world = SceneWorld(scene, STEPS) if policy else SceneWorld(scene, STEPS, ())
    entered, changed = False, 0
    for step in steps(world, OperatorActor(operator, policy)):
        entered |= bool(place.holds(scene.proprioception()))
        changed += 0 if step.decision is None else int(step.decision.intervened.sum())
    truth = scene.truth()
    return {"entered": entered, "lost": truth["spilled"], "success": bool(truth["is_success"]), "changed": changed}


def study(path: str, recordings: Path, n: int, output: Path, workers: int = 1) -> None:
    """Mark each place, drive, and write the table; each episode is kept beside it as it ends.

    Args:
        path: a filter that takes constraints and says where the hand is.
        recordings: a dataset of the bag with videos, in which the hand goes to each place now and then.
        n: starts.

    Raises:
        ConstraintError: the filter does not say where the hand is, or no recording goes to a place.
    """
    filter = loaded(path)
    asked = {number for place in PLACES.values() for number in place.between}
    unknown = sorted(asked - {*filter.config.likeness.alike})
    if unknown:
        raise ConstraintError(
            f"--filter {path} says nothing of {', '.join(unknown)}; expected a critic that was trained with --alike of "
            "these: see --help"
        )
    marked, law = {name: mark(filter, recordings, place) for name, place in PLACES.items()}, filter.config.law.name
    cells = [(place, case) for place in PLACES for case in CASES]
    jobs = [
        {"filter": path, "law": law, "place": place, "prototypes": marked[place], "constraints": CASES[case],
         "seed": FIRST_SEED + i}
        for place, case in cells
        for i in range(n)
    ]  # fmt: skip
    rows = run_resumable(output.with_suffix(".jsonl"), jobs, run, workers)
    summary: dict[str, dict[str, dict]] = {place: {} for place in PLACES}
    for (place, case), of in zip(cells, np.array_split(np.array(rows, object), len(cells))):
        summary[place][case] = {
            "entered": wilson(sum(row["entered"] for row in of), n),
            "spilled": wilson(sum(row["lost"] > 0 for row in of), n),
            "success": wilson(sum(row["success"] for row in of), n),
            "changed_share": float(np.mean([row["changed"] / STEPS for row in of])),
        }
    minutes = sum(row["cpu_s"] for row in rows) / 60
    write_json(output, {"summary": summary, "marked": marked, **provenance([FIRST_SEED, FIRST_SEED + n - 1], minutes)})
