"""How strange it is what came of actions: what a world model foretold some ticks ago, beside what it believes now.

Every tick begins a foretelling, and all that are under way go on by one step under what was executed: one more batched
step a tick. A foretelling of h steps is compared with the belief of its tick in the features that margin and critic
read, of every world model alike.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.host import on_host
from lerobot_latentsafe.latent import Latent, map_latent

AGES = (1, 3, 6)
"""Ticks ago that a prediction was made."""
AXES = 48
"""Principal components of a difference that are judged one by one; the rest is judged together."""


def ages(frame_skip: int) -> list[int]:
    """The ages in steps of a world model whose step is so many ticks: 1, 3, 6; of three ticks 1 and 2."""
    return sorted({max(1, round(age / frame_skip)) for age in AGES})


@dataclass(frozen=True)
class Foretold:
    """What was foretold of the present, by how many steps ago.

    Attributes:
        latent: of N ages one after the other, of B robots each, the youngest first: (N B, ...); None: nothing.
        n_robots: B.
    """

    latent: Latent | None = None
    n_robots: int = 0

    def after(self, before: Latent, step: Callable[[Latent, Tensor], Latent], led: Tensor, oldest: int) -> "Foretold":
        """One step on, from the belief before it under the actions (B, K A) that led on; ages beyond the oldest end."""
        n, start = len(led), before
        if self.latent is not None and self.n_robots == n:
            start = map_latent(before, lambda new, old: torch.cat([new, old[: (oldest - 1) * n]]), self.latent)
        n_ages = len(start["action"]) // n
        return Foretold(step(start, led.repeat(n_ages, *[1] * (led.dim() - 1))), n)

    def differences(self, features: Callable[[Latent], Tensor], now: Latent, of_ages: list[int]) -> np.ndarray:
        """Features foretold minus those believed now: (B, ages, D), NaN of an age at which nothing was foretold."""
        believed = features(now)
        n, size = believed.shape
        apart = torch.full((n, len(of_ages), size), torch.nan, device=believed.device)
        if self.latent is not None:
            known = features(self.latent).unflatten(0, (-1, n)) - believed  # (N, B, D)
            for place, age in enumerate(of_ages):
                if age <= len(known):
                    apart[:, place] = known[age - 1]
        return on_host(apart)


class Usual(NamedTuple):
    """How foretellings of each age usually differ from what comes.

    Attributes:
        mean, deviation: (H, D), of each feature.
        axes: (H, D, K), onto which differences in deviations have variance 1.
        rest: (H,), the mean square of what the axes leave unsaid.
    """

    mean: np.ndarray
    deviation: np.ndarray
    axes: np.ndarray
    rest: np.ndarray


def surprise(differences: np.ndarray, usual: Usual) -> np.ndarray:
    """Two scores of each age: log of the mean square along the axes, and of what these leave unsaid.

    Args:
        differences: (B, H, D); NaN of an age of which nothing is known.

    Returns:
        (B, H, 2).
    """
    apart = (differences - usual.mean) / usual.deviation
    along = np.matmul(apart[:, :, None], usual.axes)[:, :, 0]  # (B, H, K)
    length = np.square(usual.axes).sum(1)  # of an axis, 1 / the variance along it
    unsaid = np.square(apart).sum(-1) - (np.square(along) / length).sum(-1)
    said = np.square(along).mean(-1)
    return np.log(np.stack([said, np.maximum(unsaid, 0) / usual.rest], -1) + 1e-6)


def learn(differences: np.ndarray) -> Usual:
    """What is usual, from differences (N, H, D); rows with NaN do not count."""
    whole = differences[np.isfinite(differences).all((1, 2))].astype(np.float64)
    ages = [_usual(apart) for apart in whole.transpose(1, 0, 2)]
    return Usual(*(np.stack(numbers).astype(np.float32) for numbers in zip(*ages)))


def _usual(apart: np.ndarray) -> tuple[np.ndarray, ...]:
    """Mean, deviation, axes and rest of the differences (N, D) of one age."""
    mean, deviation = apart.mean(0), apart.std(0) + 1e-4
    variance, axes = np.linalg.eigh(np.cov((apart - mean) / deviation, rowvar=False).reshape(len(mean), -1))
    kept = axes[:, -AXES:] / np.sqrt(variance[-AXES:].clip(min=1e-4))
    return mean, deviation, kept, np.maximum(variance[:-AXES].sum(), 1e-3)
