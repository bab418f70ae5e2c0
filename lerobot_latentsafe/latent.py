"""z, the latent of a world model: a batch-first dict of tensors, Markov by construction.

Everything that a world model needs to go on is in it, among it the `action` (B, A) that led to it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

Latent = dict[str, Tensor]
FRAME = "frame"
"""In latents of recordings: which frame each is of, where that is asked for."""

ABSURD = 1e3
"""Larger numbers than this mean nothing: those of trained models stay within a few tens."""


def map_latent(latent: Latent, function: Callable[..., Tensor], *others: Latent) -> Latent:
    """Apply a function to each tensor of a latent (and to the same tensors of others)."""
    return {key: function(value, *(other[key] for other in others)) for key, value in latent.items()}


def select(latent: Latent, index: Tensor | slice) -> Latent:
    """Rows of a batch of latents."""
    return map_latent(latent, lambda t: t[index])


def replace_rows(latent: Latent, new: Latent, where: Tensor) -> Latent:
    """Rows of `new` where the mask (B,) holds, of `latent` elsewhere."""
    return map_latent(latent, lambda a, b: torch.where(where.reshape(-1, *[1] * (a.ndim - 1)), b, a), new)


def is_sound(tensors: Latent) -> Tensor:
    """Whether a batch of latents, or of percepts, holds what a model can mean: finite, no number absurd. Bool (B,)."""
    # NaN is not at most anything.
    return torch.stack([(t.abs() <= ABSURD).reshape(len(t), -1).all(1) for t in tensors.values()]).all(0)


@dataclass(frozen=True)
class Recorded:
    """What recordings of N frames did.

    Attributes:
        action: (N, K A), the actions of the ticks from each frame to that of the next step, side by side.
        following: (N,), which frame that is.
    """

    action: Tensor
    following: Tensor


@dataclass(frozen=True)
class Belief:
    """What is believed of an episode so far.

    Attributes:
        latent: the posterior.
        younger: where old frames are forgotten: one that knows the last frames only, and will take its place.
        n_frames: seen so far.
    """

    latent: Latent | None = None
    younger: Latent | None = None
    n_frames: int = 0

    def led_on(self, history_frames: int = 0) -> list[Latent | None]:
        """The latents that the next frame leads on, of which it makes the next belief; None: an episode begins there.

        Args:
            history_frames: frames to remember at most, and at least half as many; 0: all.
        """
        half = history_frames // 2
        if not half:
            return [self.latent]
        return [self.younger, None] if self.n_frames % half == 0 else [self.latent, self.younger]

    def after(self, observe: Callable[[Latent | None], Latent], history_frames: int = 0) -> "Belief":
        """One frame on.

        Args:
            observe: posterior, or None at the start -> that after the frame.
            history_frames: see `led_on`.
        """
        latent, younger = (*map(observe, self.led_on(history_frames)), None)[:2]
        return Belief(latent, younger, self.n_frames + 1)
