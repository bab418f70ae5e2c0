"""The simulated scenes by name, without importing a simulator."""

import importlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lerobot_latentsafe.franka.scene import FrankaScene


@dataclass(frozen=True)
class SceneInfo:
    """What configurations need to know of a scene; sizes in pixels, times in seconds."""

    module: str
    class_name: str
    fps: int
    image_size: int
    episode_seconds: float
    variants: tuple[str, ...]
    """The first is the default."""


SCENES: dict[str, SceneInfo] = {
    "bag": SceneInfo(
        "lerobot_latentsafe.franka.bag", "BagScene", 15, 224, 6.0,
        ("red", "green", "purple", "cloth", "stiff", "heavy", "sealed"),
    ),
    "blocks": SceneInfo("lerobot_latentsafe.franka.blocks", "BlocksScene", 20, 128, 3.0, ("standard",)),
}  # fmt: skip


CLUMSINESS = 3.0
"""Of grasps of the bag that are only just such, as policies' are."""
HELD_ANYWHERE = (0.4, 0.15, 0.05, 0.2, 0.05, 0.05, 0.1)
"""How likely the clumsy hold the bag by each of its segments, from the closed end on."""


def check_scene(name: str, variant: str | None, image_size: int | None) -> SceneInfo:
    """The scene's info.

    Raises:
        ValueError: unknown scene or variant, or an image size that cannot be drawn.
    """
    if name not in SCENES:
        raise ValueError(f"scene is {name!r}; expected one of {', '.join(SCENES)}")
    info = SCENES[name]
    if variant is not None and variant not in info.variants:
        raise ValueError(f"variant of the {name} is {variant!r}; expected one of {', '.join(info.variants)}")
    if image_size is not None and not 16 <= image_size <= 1024:
        raise ValueError(f"image_size is {image_size}; expected 16 to 1024 pixels")
    return info


def make_scene(name: str, variant: str | None = None, image_size: int | None = None) -> "FrankaScene":
    """A scene; None takes its default variant and image size."""
    info = check_scene(name, variant, image_size)
    scene = getattr(importlib.import_module(info.module), info.class_name)
    return scene(variant or info.variants[0], image_size=image_size or info.image_size)
