"""Contact sheets of what the simulated Franka's operators do, one row an episode."""

from pathlib import Path

import numpy as np
from PIL import Image

from lerobot_latentsafe.evaluation.rollouts import steps
from lerobot_latentsafe.experiments.scene_world import OperatorActor, SceneWorld
from lerobot_latentsafe.franka.behaviors import begin
from lerobot_latentsafe.franka.scenes import make_scene

OUT = Path("results/franka")
SHEETS = {
    "bag": (
        [("red", "closed_end"), ("red", "middle"), ("red", "open_end"), ("red", "side_to_side"), ("red", "random")],
        [0, 14, 26, 34, 37, 40, 45, 60],
    ),
    "bag_variants": (
        [(variant, "closed_end") for variant in ("green", "purple", "cloth", "stiff", "heavy", "sealed")],
        [0, 14, 26, 34, 37, 40, 45, 60],
    ),
    "blocks": (
        [("standard", "pluck_careful"), ("standard", "pluck_careless"), ("standard", "random")],
        [0, 8, 16, 22, 26, 30, 36, 50],
    ),
}
"""Name -> (variant, behaviour) of each row, and the control steps shown."""


def row(name: str, variant: str, behavior: str, shown: list[int], seed: int = 5) -> np.ndarray:
    """The front camera's images above the wrist camera's, at the beginning and after so many steps."""
    scene = make_scene(name, variant, 128)
    scene.reset(seed)
    seen = lambda: np.vstack([scene.render("front"), scene.render("wrist")])  # noqa: E731
    operator = OperatorActor(begin(behavior, scene, None, np.random.default_rng(seed)))
    columns = [seen()]
    for t, _ in enumerate(steps(SceneWorld(scene, shown[-1], cameras=()), operator), 1):
        if t in shown:
            columns.append(seen())
    scene.close()
    return np.hstack(columns)


def draw_sheets() -> None:
    """Write results/franka/<name>.png."""
    OUT.mkdir(parents=True, exist_ok=True)
    for sheet, (rows, shown) in SHEETS.items():
        scene = sheet.split("_")[0]
        picture = np.vstack([row(scene, variant, behavior, shown) for variant, behavior in rows])
        Image.fromarray(picture).quantize(128).save(OUT / f"{sheet}.png", optimize=True)
        print(OUT / f"{sheet}.png")
