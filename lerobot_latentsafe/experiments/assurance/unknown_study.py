"""Does the monitor of the unknown tell before harm? Bags, scenes and cameras that it never saw, and healthy episodes.

What happens is recorded once and kept, so that another monitor is scored on the very same. Faults of cameras are made
of healthy recordings.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from itertools import chain
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_latentsafe.decision import FilterDecision, Reason
from lerobot_latentsafe.encoders.perception import Perception
from lerobot_latentsafe.evaluation.statistics import provenance, run_resumable, wilson, write_json
from lerobot_latentsafe.experiments.filter_settings import fingerprint
from lerobot_latentsafe.franka.bag import BagScene, Variant
from lerobot_latentsafe.franka.behaviors import begin, grasp
from lerobot_latentsafe.franka.scene import CAMERAS
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.pictures import to_model_images
from lerobot_latentsafe.runtime.files import replacing
from lerobot_latentsafe.shield import Shield

STEPS, SIZE = 90, 96
"""Ticks of an episode, its unrecorded grasp included; pixels a side of what is kept."""
FIRST_SEED = 700_000
"""No filter was trained or set on these."""
LOOKS_STRANGE = (Reason.UNKNOWN_APPEARANCE, Reason.OBSERVATION_UNFAMILIAR, Reason.OBSERVATION_MISSING)
"""The monitor says so; or the guard, which knows noise, cameras that are exchanged or turned, and those that show
nothing like the data."""
AT_ONCE = 5
"""Ticks within which a fault of a camera is to be told."""
SHARES = {"rise": (0.5, 0, 0, 0, 0, 0, 0.5), "branch": (0.6, 0, 0, 0.2, 0, 0, 0.2)}
"""What operators do once they hold the bag, and where they hold it, as in the filter's held-out recordings."""


# -- what is new ---


def dark(model: mujoco.MjModel) -> None:
    """Dim all lights of a scene."""
    for light in (model.light_diffuse, model.vis.headlight.diffuse, model.vis.headlight.ambient):
        light[:] *= 0.6


def moved(camera: str, by: tuple[float, float, float]) -> Callable[[mujoco.MjModel], None]:
    """Move a camera in its frame's parent, m."""

    def change(model: mujoco.MjModel) -> None:
        model.cam_pos[model.camera(camera).id] += by

    return change


SECOND_BAG = (
    '<geom type="box" size="0.08 0.035 0.018" pos="0.62 0.22 0.018" rgba="0.78 0.05 0.06 1" contype="0" '
    'conaffinity="0"/>'
)
HAND = (
    '<geom type="capsule" size="0.03" fromto="0.9 0.35 0.10 0.62 0.12 0.06" rgba="0.85 0.62 0.5 1" contype="0" '
    'conaffinity="0"/>'
)


@dataclass(frozen=True)
class Kind:
    """A bag, and what is changed of the scene around it."""

    variant: Variant
    change: Callable[[mujoco.MjModel], None] = lambda model: None


HEALTHY = "red"
KINDS: dict[str, Kind] = {
    HEALTHY: Kind(Variant()),
    "stiff": Kind(Variant(stiffness=0.12)),
    "heavy": Kind(Variant(candy_mass=0.0045)),
    "slippery": Kind(Variant(friction=0.05)),
    "soft": Kind(Variant(stiffness=0.0075)),
    "large": Kind(Variant(candy_radius=0.0078)),
    "green": Kind(Variant(colour="0.15 0.62 0.12")),
    "cloth": Kind(Variant(cloth=True)),
    "purple": Kind(Variant(colour="0.42 0.12 0.55")),
    "dark": Kind(Variant(), dark),
    "front moved": Kind(Variant(), moved("front", (0, 0.03, 0))),
    "wrist moved": Kind(Variant(), moved("wrist", (0.02, 0, 0))),
    "second bag": Kind(Variant(beside=SECOND_BAG)),
    "hand": Kind(Variant(beside=HAND)),
}
"""None but the first was trained on."""


def _one(camera: int, change: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    def changed(pictures: np.ndarray) -> np.ndarray:
        altered = pictures.copy()
        altered[:, camera] = change(pictures[:, camera])
        return altered

    return changed


def _covered(picture: np.ndarray) -> np.ndarray:
    """A grey thing before the lens, a tenth of the picture."""
    picture = picture.copy()
    picture[..., 30:60, 30:60] = 90
    return picture


def _blurred(picture: np.ndarray) -> np.ndarray:
    """Out of focus: each pixel the mean of 5 x 5."""
    return np.mean([np.roll(picture, (i, j), (-2, -1)) for i in range(-2, 3) for j in range(-2, 3)], 0)


def _noisy(picture: np.ndarray) -> np.ndarray:
    return np.clip(picture + np.random.default_rng(0).normal(0, 12, picture.shape), 0, 255)


ALTERED: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "upside down": lambda x: x[..., ::-1, ::-1],
    "mirrored": lambda x: x[..., ::-1],
    "blue for red": lambda x: x[:, ::-1],
    "covered": _covered,
    "blurred": _blurred,
    "noisy": _noisy,
}
FAULTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "swapped": lambda x: x[:, ::-1],
    **{f"{camera} {name}": _one(i, change) for name, change in ALTERED.items() for i, camera in enumerate(CAMERAS)},
}
"""Name -> what it makes of the pictures (T, cameras, 3, SIZE, SIZE) of an episode."""


# -- recording ---


@cache
def _scene(kind: str) -> BagScene:
    scene = BagScene(KINDS[kind].variant)
    KINDS[kind].change(scene.model)
    return scene


def record(kind: str, seed: int) -> dict[str, np.ndarray]:
    """An episode that begins when the bag is held: pictures uint8 (T, cameras, 3, SIZE, SIZE), state (T, S), action
    (T, A), and spilled (T + 1,), candies outside before each tick and at the end."""
    scene, rng = _scene(kind), np.random.default_rng([7, seed])
    scene.reset(seed)
    does = "rise" if seed % 2 == 0 else "branch"
    taken = 0
    for taken, action in enumerate(grasp(scene, int(rng.choice(7, p=SHARES[does])), rng), 1):  # noqa: B007
        scene.step(action)
    operator = begin(does, scene, None, np.random.default_rng([0, seed]))
    rows: dict[str, list] = {"pictures": [], "state": [], "action": [], "spilled": []}
    action = np.zeros(7)
    for _ in range(STEPS - taken):
        action = next(operator, np.append(np.zeros(6), action[6]))
        shown = torch.from_numpy(np.stack([scene.render(camera) for camera in CAMERAS])).permute(0, 3, 1, 2)
        rows["pictures"].append((to_model_images(shown, SIZE) * 255).round().to(torch.uint8).numpy())
        rows["state"].append(scene.proprioception())
        rows["action"].append(action.astype(np.float32))
        rows["spilled"].append(int(scene.spilled().sum()))
        scene.step(action)
    rows["spilled"].append(int(scene.spilled().sum()))
    return {name: np.array(values) for name, values in rows.items()}


def recorded(folder: Path, kind: str, seed: int) -> dict[str, np.ndarray]:
    """The same, of the folder where it is kept."""
    file = folder / f"{kind.replace(' ', '_')}_{seed}.npz"
    if not file.exists():
        with replacing(file) as partial, partial.open("wb") as stream:
            np.savez(stream, **dict[str, Any](record(kind, seed)))
    with np.load(file) as kept:
        return {name: kept[name] for name in kept.files}


# -- scoring ---


@cache
def _policy(path: str) -> LatentSafePolicy:
    torch.set_num_threads(1)
    return load_filter(path)


def run(folder: Path, job: dict) -> dict:
    """One episode of a kind, perhaps with a fault of a camera: see `first_alarms`."""
    policy, episode = _policy(job["policy"]), recorded(folder, job["kind"], job["seed"])
    pictures = episode["pictures"] if job["fault"] is None else FAULTS[job["fault"]](episode["pictures"])
    shown = torch.from_numpy(np.ascontiguousarray(pictures, dtype=np.uint8))
    by_camera = {f"observation.images.{camera}": shown[:, i] for i, camera in enumerate(CAMERAS)}
    decisions = watched(policy, by_camera, episode["state"], episode["action"])
    return first_alarms(decisions, episode["spilled"] > 0)


@torch.no_grad()
def watched(
    policy: LatentSafePolicy, pictures: dict[str, Tensor], state: np.ndarray, action: np.ndarray
) -> list[FilterDecision]:
    """What the filter decides along an episode that goes on as it was recorded.

    Args:
        pictures: camera key -> uint8 (T, 3, H, W).
        state, action: (T, S) and (T, A) in robot units.
    """
    shield, decisions = Shield(policy.model, clock=standing_still), []
    for t, (s, a) in enumerate(zip(torch.from_numpy(state), torch.from_numpy(action))):
        images = {key: shown[t : t + 1].float() / 255.0 for key, shown in pictures.items()}
        decisions.append(shield({**images, OBS_STATE: s[None]}, a[None]))
        shield.was_executed(a[None])
    return decisions


def first_alarms(decisions: list[FilterDecision], harm: np.ndarray) -> dict:
    """The first tick, or None, at which an episode's cameras are found strange, its dynamics are, the filter stops
    anything for whatever reason, and harm is done; and M as a share of the threshold.

    Args:
        harm: bool (T,) or longer.
    """
    reasons = np.array([decision.reason.item() for decision in decisions])
    strange = [decision.unknown.item() for decision in decisions]
    return {
        "appearance": _first(np.isin(reasons, LOOKS_STRANGE)),
        "dynamics": _first(reasons == Reason.UNKNOWN_DYNAMICS),
        "stopped": _first(np.array([decision.unsafe.item() for decision in decisions])),
        "harm": _first(harm),
        "most": round(float(np.max(strange)), 3),
    }


def _first(found: np.ndarray) -> int | None:
    """The first tick (T,) at which it is true."""
    ticks = np.flatnonzero(found)
    return int(ticks[0]) if len(ticks) else None


def _before(tick: int | None, harm: int) -> bool:
    return tick is not None and tick < harm


def summary(rows: list[dict]) -> dict:
    """Of the episodes of one kind: those that alarm, at once and at all; those told before harm, and by how many ticks;
    those that do harm without a word, neither an alarm nor a low value before; and beside these the harmless ones that
    have a word, too, for a filter that always stops says one before every harm.

    Args:
        rows: of `run`.
    """
    alarms = [min((t for t in (row["appearance"], row["dynamics"]) if t is not None), default=None) for row in rows]
    harmed = [(alarm, row["harm"]) for alarm, row in zip(alarms, rows) if row["harm"] is not None]
    silent = [row for row in rows if row["harm"] is not None and not _before(row["stopped"], row["harm"])]
    harmless = [row for row in rows if row["harm"] is None]
    leads = [harm - alarm for alarm, harm in harmed if _before(alarm, harm)]
    return {
        "alarmed": wilson(sum(alarm is not None for alarm in alarms), len(rows)),
        "at_once": wilson(sum(alarm is not None and alarm < AT_ONCE for alarm in alarms), len(rows)),
        "by_dynamics": sum(row["dynamics"] is not None for row in rows),
        "told_before_harm": wilson(len(leads), len(harmed)) if harmed else None,
        "without_a_word": wilson(len(silent), len(harmed)) if harmed else None,
        "harmless_with_a_word": wilson(sum(row["stopped"] is not None for row in harmless), len(harmless))
        if harmless
        else None,
        "median_lead_ticks": float(np.median(leads)) if leads else None,
        "median_most": float(np.median([row["most"] for row in rows])),
    }


def cost_ms(policy: LatentSafePolicy, episode: dict[str, np.ndarray]) -> dict[str, float]:
    """Median CPU milliseconds of a tick with the monitor and without, and what it adds."""
    keys = [f"observation.images.{camera}" for camera in CAMERAS]
    shields = {
        "with": Shield(policy.model, clock=standing_still),
        "without": Shield(policy.model, clock=standing_still),
    }
    shields["without"].monitor = None
    took: dict[str, list[float]] = {name: [] for name in shields}
    for t in range(len(episode["state"])):
        shown = torch.from_numpy(episode["pictures"][t]).float() / 255.0
        seen = {key: shown[i : i + 1] for i, key in enumerate(keys)}
        seen["observation.state"] = torch.from_numpy(episode["state"][t : t + 1])
        for name in (("with", "without"), ("without", "with"))[t % 2]:
            Perception.forget()  # else the second is told what the first saw
            began = time.thread_time()
            shields[name](seen, torch.from_numpy(episode["action"][t : t + 1]))
            took[name].append(1e3 * (time.thread_time() - began))
    medians = {name: round(float(np.median(values[5:])), 3) for name, values in took.items()}
    added = float(np.median(np.subtract(took["with"], took["without"])[5:]))
    return {**medians, "added": round(added, 3)}


def study(
    path: str, folder: Path, n: int, healthy: int, output: Path, workers: int = 1, others: dict | None = None
) -> None:
    """Score a monitored filter of the bag on every kind and fault; write the table.

    Args:
        folder: of the recordings, made where they are missing.
        n: episodes of a kind; healthy: of the bag that is known.
        others: tables of other robots, to stand beside it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    common = {"policy": path, "fingerprint": fingerprint(path)}
    cells = {kind: [(kind, None, i) for i in range(healthy if kind == HEALTHY else n)] for kind in KINDS}
    cells |= {fault: [(HEALTHY, fault, i) for i in range(n)] for fault in FAULTS}
    jobs = {
        name: [{**common, "kind": kind, "fault": fault, "seed": FIRST_SEED + i} for kind, fault, i in cell]
        for name, cell in cells.items()
    }
    rows = iter(run_resumable(output.with_suffix(".jsonl"), [*chain(*jobs.values())], partial(run, folder), workers))
    table = {name: summary([next(rows) for _ in cell]) for name, cell in jobs.items()}
    record = _policy(path).config.trained_on.monitor
    result = {
        "summary": {
            "alpha": record.alpha, "episodes": record.episodes, "rank": record.rank, "dynamics": record.dynamics,
            "healthy_alarmed": table[HEALTHY]["alarmed"],
            "kinds": {kind: table[kind] for kind in KINDS if kind != HEALTHY},
            "camera_faults": {fault: table[fault] for fault in FAULTS},
            "cost_ms": cost_ms(_policy(path), recorded(folder, HEALTHY, FIRST_SEED)),
            **(others or {}),
        },
        **provenance([FIRST_SEED, FIRST_SEED + max(n, healthy) - 1]),
    }  # fmt: skip
    write_json(output, result)
