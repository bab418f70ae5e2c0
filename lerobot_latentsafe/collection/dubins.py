"""Recording the car in bulk: LeRobotDatasets (v3) with failure labels, without a person."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.collection.parts import record_in_parts
from lerobot_latentsafe.datasets.labels import FAILING, SAFE
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.dubins.ground_truth import sample_task_start
from lerobot_latentsafe.runtime.tasks import Tasks

EPISODES_A_PART = 100
FEATURES = {
    "observation.image": {"dtype": "image", "shape": (128, 128, 3), "names": ["height", "width", "channels"]},
    "observation.state": {"dtype": "float32", "shape": (2,), "names": car.STATE_NAMES},
    "action": {"dtype": "float32", "shape": (2,), "names": car.ACTION_NAMES},
    "failure": {"dtype": "int64", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}
POSITION = {"observation.environment_state": {"dtype": "float32", "shape": (2,), "names": car.POSITION_NAMES}}


@dataclass
class Episode:
    """One trajectory: states (T, 3), turn rates (T,) taken after each state, and whether it ended by itself."""

    states: np.ndarray
    turn_rates: np.ndarray
    ended: bool


def random_episodes(
    n: int, rng: np.random.Generator, turn_rates: np.ndarray | None = None, max_steps: int = 100
) -> Iterator[Episode]:
    """The paper's data: uniformly random actions from a random start until the arena is left.

    Args:
        turn_rates: the discrete set to draw from; None draws from the whole range, each held for 1 to 8 steps
            (a rate drawn anew every step would average out to going straight).
    """
    for _ in range(n):
        while True:
            position = rng.uniform(-car.ARENA, car.ARENA, 2)
            if np.hypot(*position) >= car.RADIUS:
                break
        # Facing the obstacle, roughly: headings that leave the arena at once teach little.
        state = np.array([*position, np.arctan2(-position[1], -position[0]) + rng.normal()])
        if turn_rates is not None:
            actions = rng.choice(turn_rates, max_steps)
        else:
            held = rng.uniform(-car.MAX_TURN_RATE, car.MAX_TURN_RATE, max_steps)
            actions = np.repeat(held, rng.integers(1, 9, max_steps))[:max_steps]
        yield _drive(state, lambda s, t, a=actions: a[t], max_steps, _left_arena)


def _left_arena(state: np.ndarray) -> bool:
    return bool(np.abs(state[:2]).max() > car.ARENA)


def _arrived(state: np.ndarray) -> bool:
    return bool(state[0] >= 0.9) or not bool(car.in_view(state))


def reckless_driver(state: np.ndarray) -> float:
    """Heads straight for (1.2, 0), through the obstacle if it is in the way."""
    return _steer(state, np.array([1.2, 0.0]))


def careful_driver(state: np.ndarray, clearance: float = 0.75) -> float:
    """Heads for the goal; where the way there passes within `clearance` of the centre, along the nearer tangent."""
    goal, position, heading = np.array([1.2, 0.0]), state[:2], state[2]
    bearing, centre = (np.arctan2(*to[::-1]) for to in (goal - position, -position))
    half = np.arcsin(min(1.0, clearance / np.hypot(*position)))
    blocked = abs(_wrap(bearing - centre)) < half and position @ (goal - position) < 0
    turns = [_wrap(centre + side * half - heading) for side in (1, -1)] if blocked else [_wrap(bearing - heading)]
    return _turn_towards(min(turns, key=abs))


def _wrap(angle: float) -> float:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _turn_towards(error: float) -> float:
    return float(np.clip(3.0 * error, -car.MAX_TURN_RATE, car.MAX_TURN_RATE))


def _steer(state: np.ndarray, goal: np.ndarray) -> float:
    return _turn_towards(_wrap(np.arctan2(*(goal - state[:2])[::-1]) - state[2]))


def goal_episodes(
    n: int,
    rng: np.random.Generator,
    driver: Callable[[np.ndarray], float],
    noise: float = 0.2,
    max_steps: int = 80,
) -> Iterator[Episode]:
    """Demonstrations of the task of `DubinsEnv`, with a little noise on the turn rate for coverage."""
    for _ in range(n):
        jitter = rng.normal(0, noise, max_steps)
        limit = car.MAX_TURN_RATE

        def act(state: np.ndarray, t: int, jitter: np.ndarray = jitter, limit: float = limit) -> float:
            return float(np.clip(driver(state) + jitter[t], -limit, limit))

        yield _drive(sample_task_start(rng), act, max_steps, _arrived)


def _drive(
    state: np.ndarray,
    act: Callable[[np.ndarray, int], float],
    max_steps: int,
    over: Callable[[np.ndarray], bool],
) -> Episode:
    states, actions = [], []
    for t in range(max_steps):
        states.append(state)
        ended = over(state)
        actions.append(0.0 if ended else act(state, t))
        if ended:
            return Episode(np.array(states), np.array(actions), True)
        state = car.step(state, actions[-1])
    return Episode(np.array(states), np.array(actions), False)


SOURCES: dict[str, Callable[[int, np.random.Generator], Iterator[Episode]]] = {
    "random": lambda n, rng: random_episodes(n, rng, car.TURN_RATES),
    "random_located": lambda n, rng: random_episodes(n, rng, car.TURN_RATES),
    "random_continuous": lambda n, rng: random_episodes(n, rng),
    "random_left_only": lambda n, rng: random_episodes(n, rng, car.TURN_RATES[1:]),
    "careful": lambda n, rng: goal_episodes(n, rng, careful_driver),
    "reckless": lambda n, rng: goal_episodes(n, rng, reckless_driver),
}
"""What `latentsafe collect --source=...` can record."""
WITH_POSITION = ("careful", "reckless", "random_located")


def collect_dubins(
    source: str, repo_id: str, root: str | Path, n_episodes: int | None, seed: int, tasks: Tasks | None = None
) -> LeRobotDataset | None:
    """Record episodes of the car, or go on recording them; None records the paper's 2,000.

    Demonstrations also store the car's position as observation.environment_state, which lets a diffusion policy
    of a few hundred kB do the task; the safety filter reads images and heading only. `random_located` stores it, too:
    a filter that takes new constraints learns from it which frames are alike.

    Returns, raises:
        See `record_in_parts`; ValueError for an unknown source, too.
    """
    if source not in SOURCES:
        raise ValueError(f"--source is {source!r}; expected one of {', '.join(SOURCES)}")
    n = 2000 if n_episodes is None else n_episodes
    record = partial(_record, source, repo_id, n, seed)
    options = {"source": source, "repo_id": repo_id, "seed": seed}
    return record_in_parts(repo_id, root, options, n, record, EPISODES_A_PART, tasks=tasks)


@lru_cache(1)
def _episodes(source: str, n: int, seed: int) -> list[Episode]:
    """All of them: one stream of random numbers runs through."""
    return list(SOURCES[source](n, np.random.default_rng(seed)))


def _record(source: str, repo_id: str, n: int, seed: int, numbers: range, root: Path) -> Iterator[None]:
    return _write(_episodes(source, n, seed)[numbers.start : numbers.stop], source, repo_id, root)


def _write(episodes: list[Episode], source: str, repo_id: str, root: Path) -> Iterator[None]:
    """Write the dataset of some episodes; yields after each."""
    features = {**FEATURES, **(POSITION if source in WITH_POSITION else {})}
    dataset = LeRobotDataset.create(
        repo_id, car.FPS, features, root=root, robot_type="latentsafe_dubins", use_videos=False,
        metadata_buffer_size=EPISODES_A_PART,
    )  # fmt: skip
    renderer = car.Renderer()
    for episode in episodes:
        for frame in episode_frames(episode, renderer, features):
            dataset.add_frame(frame)
        dataset.save_episode()
        yield
    dataset.finalize()


def episode_frames(episode: Episode, renderer: car.Renderer, features: dict) -> Iterator[dict]:
    """The frames of an episode as `LeRobotDataset.add_frame` takes them."""
    seen = car.observe(episode.states, renderer)
    failing = car.margin(episode.states) < 0
    last = len(episode.states) - 1
    for t, turn_rate in enumerate(episode.turn_rates):
        frame = {
            "observation.image": seen["image"][t],
            "observation.state": seen["heading"][t],
            "observation.environment_state": seen["position"][t],
            "action": np.array([turn_rate, car.SPEED], np.float32),
            "failure": np.array([FAILING if failing[t] else SAFE]),
            "next.done": np.array([episode.ended and t == last]),
        }
        yield {**{key: frame[key] for key in features}, "task": "drive"}
