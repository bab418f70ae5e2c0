"""The same question of the second robot: does the monitor tell of another cube, table, light or camera of the SO-101?

Operators push the cube as they like, whatever the filter says; half of them push it over the edge.
"""

from collections.abc import Callable, Iterator

import mujoco
import numpy as np
import torch
from tqdm import trange

from lerobot_latentsafe.experiments.assurance.unknown_study import FAULTS, dark, first_alarms, moved, summary, watched
from lerobot_latentsafe.experiments.so101 import FIRST_SEED, kept
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.so101.actions import CAMERAS, EPISODE_SECONDS, FPS
from lerobot_latentsafe.so101.operators import begin
from lerobot_latentsafe.so101.scene import PushScene

HEALTHY = "as it was"


def _coloured(geom: str, *rgb: float) -> Callable[[mujoco.MjModel], None]:
    def change(model: mujoco.MjModel) -> None:
        model.geom_rgba[_geom(model, geom), :3] = rgb

    return change


def _cube(**numbers: float) -> Callable[[mujoco.MjModel], None]:
    """The cube with a geom's or its body's numbers times these."""

    def change(model: mujoco.MjModel) -> None:
        for name, factor in numbers.items():
            getattr(model, name)[model.body("cube").id if name.startswith("body") else _geom(model, "cube")] *= factor

    return change


def _geom(model: mujoco.MjModel, name: str) -> int:
    return model.body("cube").geomadr[0] if name == "cube" else model.geom(name).id


KINDS: dict[str, Callable[[mujoco.MjModel], None]] = {
    HEALTHY: lambda model: None,
    "a blue cube": _coloured("cube", 0.12, 0.2, 0.85),
    "a larger cube": _cube(geom_size=1.5),
    "a heavy cube": _cube(body_mass=4, body_inertia=4),
    "a slippery cube": _cube(geom_friction=0.3),
    "a grey table": _coloured("table", 0.5, 0.5, 0.52),
    "a green floor": _coloured("floor", 0.2, 0.4, 0.2),
    "dark": dark,
    "front camera moved by 2 cm": moved("front", (0, 0.02, 0)),
    "wrist camera moved by 1 cm": moved("wrist", (0, 0.01, 0)),
}
"""What is changed of the scene. None but the first was recorded."""


def driven(scene: PushScene, behavior: str, seed: int) -> tuple[np.ndarray, ...]:
    """Pictures uint8 (T, cameras, 3, H, W), state and action (T, 6), and whether the cube has fallen, bool (T,)."""
    scene.reset(seed)
    operator = kept(begin(behavior, scene, np.random.default_rng([3, seed])))
    return tuple(map(np.stack, zip(*_ticks(scene, operator, round(EPISODE_SECONDS * FPS)))))


def _ticks(scene: PushScene, operator: Iterator[np.ndarray], n: int) -> Iterator[tuple]:
    for _ in range(n):
        pictures = np.stack([scene.render(camera) for camera in CAMERAS]).transpose(0, 3, 1, 2)
        state, action = scene.proprioception(), np.asarray(next(operator), np.float32)
        yield pictures, state, action, scene.truth()["failure"]
        scene.step(action)


def study_so101(path: str, n: int, healthy: int) -> dict:
    """Kind, or fault of a camera -> what is told of n episodes, see `unknown_study.summary`; of more that are healthy.

    Args:
        path: of a guard or a filter of the SO-101 with a monitor.
    """
    torch.set_num_threads(1)
    policy, scenes = load_filter(path), {name: PushScene() for name in KINDS}
    for name, change in KINDS.items():
        change(scenes[name].model)
    table = {}
    for name in (*KINDS, *FAULTS):
        change = FAULTS.get(name, lambda pictures: pictures)
        count = healthy if name == HEALTHY else n
        rows = [
            _watched(policy, scenes.get(name, scenes[HEALTHY]), change, i, name == HEALTHY)
            for i in trange(count, desc=name, leave=False)
        ]
        table[name] = summary(rows)
        print(f"SO-101, {name}: {table[name]}", flush=True)
    return table


def _watched(
    policy: LatentSafePolicy, scene: PushScene, change: Callable[[np.ndarray], np.ndarray], i: int, careful: bool
) -> dict:
    """One episode; every second one is reckless, unless all are careful."""
    behavior = "careful" if careful or i % 2 else "reckless"
    pictures, state, action, fallen = driven(scene, behavior, FIRST_SEED + i)
    shown = torch.from_numpy(np.ascontiguousarray(change(pictures), dtype=np.uint8))
    by_camera = {f"observation.images.{camera}": shown[:, c] for c, camera in enumerate(CAMERAS)}
    return first_alarms(watched(policy, by_camera, state, action), fallen)
