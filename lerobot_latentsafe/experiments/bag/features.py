"""What a frozen encoder makes of the bag's variants: principal components of patch features as colours."""

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from lerobot_latentsafe.encoders.patch_encoders import PatchEncoder
from lerobot_latentsafe.evaluation.rollouts import steps
from lerobot_latentsafe.experiments.scene_world import OperatorActor, SceneWorld
from lerobot_latentsafe.franka.bag import VARIANTS
from lerobot_latentsafe.franka.behaviors import begin
from lerobot_latentsafe.franka.scene import CAMERAS
from lerobot_latentsafe.franka.scenes import make_scene


def see_variants(image_size: int, behavior: str, step: int, seed: int) -> dict[str, np.ndarray]:
    """What the cameras see of each variant after so many control steps: name -> uint8 (2, S, S, 3)."""
    seen = {}
    for variant in VARIANTS:
        scene = make_scene("bag", variant, image_size)
        scene.reset(seed)
        operator = OperatorActor(begin(behavior, scene, None, np.random.default_rng(seed)))
        for _ in steps(SceneWorld(scene, step, cameras=()), operator):
            pass
        seen[variant] = np.stack([scene.render(camera) for camera in CAMERAS])
        scene.close()
    return seen


def principal_colours(tokens: Tensor) -> Tensor:
    """The first three principal components of tokens (..., C), the same for all, as colours (..., 3) in [0, 1]."""
    flat = tokens.flatten(0, -2)
    flat = flat - flat.mean(0)
    _, _, axes = torch.linalg.svd(flat, full_matrices=False)
    axes = axes[:3] * axes[:3].sum(-1, keepdim=True).sign()  # an axis has no sign of its own
    parts = flat @ axes.T
    low, high = torch.quantile(parts, torch.tensor([0.01, 0.99], device=parts.device), dim=0)
    return ((parts - low) / (high - low).clamp(min=1e-6)).clamp(0, 1).unflatten(0, tokens.shape[:-1])


def draw_features(encoder: PatchEncoder, seen: dict[str, np.ndarray]) -> Figure:
    """A column for each variant: each camera's picture, and below it the colours of its patches.

    Args:
        seen: name -> uint8 (2, S, S, 3), as `see_variants` gives it.
    """
    images = torch.from_numpy(np.stack(list(seen.values()))).permute(0, 1, 4, 2, 3) / 255.0
    tokens = torch.cat([encoder(pair).tokens for pair in images]).unflatten(0, images.shape[:2])
    colours = torch.stack([principal_colours(tokens[:, i]) for i in range(len(CAMERAS))], 1)
    side = round(colours.shape[-2] ** 0.5)
    n_rows = 2 * len(CAMERAS)
    figure, axes = plt.subplots(n_rows, len(seen), figsize=(1.35 * len(seen), 1.4 * n_rows), squeeze=False)
    for column, (variant, pictures) in enumerate(seen.items()):
        axes[0, column].set_title(variant, fontsize=9)
        for row in range(n_rows):
            i = row // 2
            patches = colours[column, i].unflatten(0, (side, side)).numpy()
            axes[row, column].imshow(patches if row % 2 else pictures[i])
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
    for row in range(n_rows):
        axes[row, 0].set_ylabel("features" if row % 2 else CAMERAS[row // 2], fontsize=9)
    figure.tight_layout(pad=0.3)
    return figure
