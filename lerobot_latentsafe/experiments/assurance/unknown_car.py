"""The same question of the car: does the monitor tell of another obstacle, speed or turn rate before the car is in it?

What happens is simulated anew for each kind, under the same actions from the same starts. The monitor is fitted to
random driving that never fails.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.collection.dubins import Episode, random_episodes
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.experiments.assurance.unknown_study import first_alarms, summary, watched
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.monitoring import SMOOTH_S, Replayed, learn, parts_of, replayed, with_monitor

CAMERA = "observation.image"
SEED = 21
LEARNED = 119
"""Healthy episodes that the monitor is fitted to: 59 of them set the threshold, at number 57 for an alpha of 5%."""
ALPHA = 0.05


@dataclass(frozen=True)
class Kind:
    """What is changed: the picture's background, of pixels at x and y in m, and how the car moves."""

    drawn: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] = lambda background, x, y: background
    speed: float = car.SPEED
    turns: float = 1.0


def _ring(x0: float, y0: float, radius: float) -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    def drawn(background: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        on_it = np.abs(np.hypot(x - x0, y - y0) - radius) < car.Renderer.ring_half_width
        return np.where(on_it[..., None], np.array([1, 0, 0], np.float32), background)

    return drawn


HEALTHY = "as it was"
KINDS: dict[str, Kind] = {
    HEALTHY: Kind(),
    "half as fast again": Kind(speed=1.5),
    "half as fast": Kind(speed=0.5),
    "turns half as much": Kind(turns=0.5),
    "turns the other way": Kind(turns=-1.0),
    "a second obstacle": Kind(_ring(-0.6, 0.7, 0.2)),
    "a larger obstacle": Kind(_ring(0, 0, 0.7)),
    "a grey floor": Kind(lambda background, x, y: 0.85 * background),
}
"""None but the first was trained on."""


def driven(kind: Kind, episode: Episode) -> np.ndarray:
    """States (T, 3) of a car of this kind under an episode's actions."""
    states = [episode.states[0]]
    for rate in episode.turn_rates[:-1]:
        x, y, heading = states[-1]
        moved = car.DT * kind.speed * np.array([np.cos(heading), np.sin(heading)])
        states.append(np.array([x + moved[0], y + moved[1], heading + car.DT * kind.turns * rate]))
    return np.stack(states)


def seen(kind: Kind, episode: Episode) -> tuple[Tensor, np.ndarray, np.ndarray, np.ndarray]:
    """Pictures (T, 3, H, W), state and action of such a drive, and whether the car is in the disc, bool (T,)."""
    states, renderer = driven(kind, episode), car.Renderer()
    renderer.background = kind.drawn(renderer.background, renderer.xs[None], renderer.ys[:, None])
    shown = car.observe(states, renderer)
    pictures = torch.from_numpy(shown["image"]).permute(0, 3, 1, 2)
    action = np.stack([episode.turn_rates, np.full_like(episode.turn_rates, car.SPEED)], -1).astype(np.float32)
    return pictures, shown["heading"], action, car.margin(states) < 0


def monitored(policy: LatentSafePolicy, episodes: list[Episode]) -> LatentSafePolicy:
    """The policy with a monitor that is fitted to these healthy episodes."""
    parts = parts_of(list(range(len(episodes))), ALPHA, has_reference=False)
    first, second, third = ([_gathered(policy, episodes[i]) for i in part] for part in parts)
    familiar = learn(first, second, third, SMOOTH_S * car.FPS)
    return with_monitor(policy, familiar, ALPHA, len(first) + len(second))


def _gathered(policy: LatentSafePolicy, episode: Episode) -> Replayed:
    pictures, state, action, _ = seen(KINDS[HEALTHY], episode)
    return replayed(policy.model, ({CAMERA: picture[None]} for picture in pictures), state, action)


def study_car(path: str = "dubins", n: int = 40, healthy: int = 100) -> dict:
    """Kind -> what is told of n episodes, see `summary`; of more that are healthy.

    Episodes of driving at random; those under the car as it was, which the monitor is fitted to and which are healthy,
    never touch the disc.
    """
    torch.set_num_threads(1)
    policy, drives = load_filter(path), random_episodes(10 * (LEARNED + healthy), np.random.default_rng(SEED))
    safe = (episode for episode in drives if (car.margin(episode.states) >= 0).all() and len(episode.states) > 20)
    policy = monitored(policy, [next(safe) for _ in range(LEARNED)])
    known = [next(safe) for _ in range(healthy)]
    others = list(random_episodes(n, np.random.default_rng(SEED + 1)))
    table = {}
    for name, kind in KINDS.items():
        rows = []
        for episode in known if name == HEALTHY else others:
            pictures, state, action, in_disc = seen(kind, episode)
            rows.append(first_alarms(watched(policy, {CAMERA: pictures}, state, action), in_disc))
        table[name] = summary(rows)
        print(name, table[name])
    return table
