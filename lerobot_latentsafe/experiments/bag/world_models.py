"""World models of the bag side by side, on recordings none of them was trained on, and a picture of what they imagine.

What the recordings do not hold, how many candies lie outside the bag, is found by playing their episodes again.
"""

import csv
from collections.abc import Callable
from functools import lru_cache
from itertools import combinations
from pathlib import Path

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_latentsafe.collection.franka import SOURCES, episode_truths
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.folder import load_metadata
from lerobot_latentsafe.datasets.labels import read_frames
from lerobot_latentsafe.evaluation.statistics import provenance, wilson, write_json
from lerobot_latentsafe.evaluation.token_space import Imagination, TokenSpace, moments
from lerobot_latentsafe.evaluation.yardstick import branches_of, compare_world_models, loaded, summarised
from lerobot_latentsafe.franka.actions import STATE_NAMES
from lerobot_latentsafe.reports.figures import imagined_futures, save
from lerobot_latentsafe.robots.franka_mujoco.config_franka_mujoco import LatentSafeFrankaMujocoConfig
from lerobot_latentsafe.robots.franka_mujoco.franka_mujoco import LatentSafeFrankaMujoco
from lerobot_latentsafe.runtime.files import replacing

HELD = {"branches": ("bag_branches", 1), "lifts": ("bag_lifts", 1)}
"""Recording -> its source and seed, as in `scripts/reproduce_bag.sh`."""
FEW = 2
"""So many candies outside the bag, at most, are a small spill."""
DRAWN = ("0.4 s", "0.8 s", "1 s", "2 s")
CAMERA, HEIGHT = "observation.images.front", STATE_NAMES.index("ee_z.pos")
N_DRAWN = 3
"""Branches of one state in the picture."""


def compare_models(models: dict[str, str], data: Path, output: Path, cost: Path | None = None) -> None:
    """Write the table of all models and controls, and beside it the picture of what the first of each kind imagines.

    Args:
        models: name -> checkpoint.
        data: holds, of each recording, `held_<name>` with videos, `held_<name>_tokens`, and for models that read
            pictures `held_<name>_pictures`.
        output: of the table, .json.
        cost: a CSV file with rows `world_model_<name>` and columns user_s and system_s, what training a model took.
    """
    rows = {name: _rows(models, data, name) for name in HELD}
    minutes = _minutes(cost) if cost else {}
    summary = {
        model: {
            "cpu_minutes": minutes.get(f"world_model_{model}"),
            **_summary({name: table[model] for name, table in rows.items()}),
        }
        for model in rows["branches"]
    }
    write_json(output, {"summary": summary, **rows, **provenance(seeds=[0])})
    told = {name: row["world_model"] for name, row in rows["branches"].items() if name in models and row["errors"]}
    first = {kind: name for name, kind in reversed(told.items())}.values()
    draw({name: models[name] for name in models if name in first}, data, output.with_suffix(".png"))


def _rows(models: dict[str, str], data: Path, name: str) -> dict[str, dict]:
    """On one recording."""
    meta, branches = _tokens(data, name), SOURCES[HELD[name][0]].branches
    outside, every = candies_outside(*HELD[name], data / f"held_{name}"), np.arange(meta.total_episodes)
    few = (outside > 0) & (outside <= FEW)
    return compare_world_models(models, meta, every, branches if branches > 1 else 0, _pictures(data, name), few)


def _tokens(data: Path, name: str) -> LeRobotDatasetMetadata:
    return load_metadata(f"latentsafe/held_{name}_cache", data / f"held_{name}_tokens")


def _pictures(data: Path, name: str) -> LeRobotDatasetMetadata | None:
    root = data / f"held_{name}_pictures"
    return load_metadata(f"latentsafe/held_{name}_cache", root) if root.exists() else None


def candies_outside(source: str, seed: int, root: Path) -> np.ndarray:
    """How many candies lie outside the bag at each frame of a recording, (N,), by playing its episodes again.

    That takes a second or two an episode, and is kept beside the recording.

    Raises:
        ValueError: it was not recorded by this source, seed and simulation: other frames fail.
    """
    frames, kept = read_frames(root, ["failure"]), root.with_name(f"{root.name}_outside.npy")
    if not kept.exists():
        outside = _played_again(source, seed, len(np.unique(frames["episode_index"])))
        with replacing(kept) as partial, partial.open("wb") as file:
            np.save(file, outside)
    outside, episode, failing = np.load(kept), frames["episode_index"], frames["failure"].reshape(-1) > 0
    if len(outside) != len(episode) or not np.array_equal(_since_the_first(outside > 0, episode), failing):
        raise ValueError(
            f"{root} does not fail where episodes of {source} with seed {seed} fail when they are played again "
            f"({kept}); delete both and record it anew: latentsafe collect --source={source} --seed={seed}"
        )
    return outside


def _played_again(source: str, seed: int, n: int) -> np.ndarray:
    with LatentSafeFrankaMujoco(LatentSafeFrankaMujocoConfig(scene="bag")) as robot:
        episodes = (episode_truths(robot, SOURCES[source], episode, seed) for episode in range(n))
        return np.array([truth["spilled"] for truths in episodes for truth in truths])


def _since_the_first(fails: np.ndarray, episode: np.ndarray) -> np.ndarray:
    """Whether a frame of its episode has failed up to each one: bool (N,)."""
    return np.concatenate([np.logical_or.accumulate(fails[episode == e]) for e in np.unique(episode)])


def _summary(rows: dict[str, dict]) -> dict:
    """Of one model: recording -> its row."""
    told = {name: summarised(row) for name, row in rows.items()}
    return {
        **{what: told["branches"][what] for what in ("errs", "hears", "foretells")},
        **{f"{name}_told_apart": numbers["tells_apart"] for name, numbers in told.items()},
        **{what: _sum([numbers[what] for numbers in told.values()]) for what in ("fails_holding", "few_missed")},
    }


def _sum(rates: list[dict | None]) -> dict | None:
    known = [rate for rate in rates if rate is not None]
    return wilson(*(sum(rate[key] for rate in known) for key in ("k", "n"))) if known else None


def _minutes(cost: Path) -> dict[str, float]:
    """Step -> CPU minutes."""
    with cost.open() as file:
        return {row["step"]: (float(row["user_s"]) + float(row["system_s"])) / 60 for row in csv.DictReader(file)}


# -- the picture ---


def draw(models: dict[str, str], data: Path, path: Path) -> None:
    """One state's future under three actions: as recorded, and as the recorded frames nearest to what is imagined."""
    meta, pictures = _tokens(data, "branches"), _pictures(data, "branches")
    space, picture = TokenSpace(meta), _camera(data / "held_branches")
    shown = [moment for moment in moments(space.fps) if moment.name in DRAWN]
    states = branches_of(space, meta, np.arange(meta.total_episodes), SOURCES[HELD["branches"][0]].branches)
    height, last = space.cache.state[:, HEIGHT], shown[-1]
    rise = height[states.follow + last.ticks] - height[states.follow]
    best = furthest_apart(rise, states.group)
    chosen, done = states.of(best), [f"hand {round(100 * rise[i]):+d} cm in {last.name}" for i in best]
    ahead = {moment.name: chosen.follow + moment.ticks for moment in shown}
    rows = {"recorded": ahead}
    for name, policy_path in models.items():
        imagination = Imagination(*loaded(policy_path, space, meta, pictures), space)
        rows[name] = {m.name: space.nearest(tokens) for m, tokens in imagination(chosen.start, chosen.follow, 1)}
    told = {
        who: {
            what: [picture(index[name][i]) if name in index else None for name in DRAWN] for i, what in enumerate(done)
        }
        for who, index in rows.items()
    }
    save(imagined_futures(picture(chosen.start[0]), told, DRAWN), path)


def furthest_apart(rise: np.ndarray, group: np.ndarray) -> list[int]:
    """N_DRAWN branches of one state that differ most in how far the hand rises (B,), the highest first."""
    order = np.argsort(-rise)
    sets = (c for g in np.unique(group) for c in combinations(order[group[order] == g].tolist(), N_DRAWN))
    return list(max(sets, key=lambda chosen: -np.diff(rise[list(chosen)]).max()))


def _camera(root: Path) -> Callable[[int], np.ndarray]:
    """The pictures (H, W, 3) of a recording, by the index of the frame."""
    frames = DatasetFrames(load_metadata(f"latentsafe/{root.name}", root), None)
    begins = np.array([row["dataset_from_index"] for row in frames.meta.episodes])
    episode = lru_cache(maxsize=16)(lambda number: frames.images(CAMERA, number))

    def picture(index: int) -> np.ndarray:
        number = int(np.searchsorted(begins, index, side="right")) - 1
        return episode(number)[index - begins[number]]

    return picture
