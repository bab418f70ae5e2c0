"""How strange a picture is, patch by patch, beside the pictures of a dataset: no training, no labels, no encoder.

A picture is cut into GRID x GRID patches. A patch is 2 x 2 cells, each with its mean colour and how fine its detail is.
For every patch of every camera a dataset shows a few kinds: table, arm, object. A patch is as strange as its distance
from the nearest kind, in standard deviations of that kind (as PaDiM, Defard et al. 2021, with several Gaussians a patch
instead of one: one that spans table and arm calls everything between them usual).

And a picture has so many points of each colour. Patches overlook a thing of a new colour that is small or moves about,
and what is gone; the colours of the whole picture do not.

The same was measured on tokens of a frozen encoder: these tell light and small cover worse, and cost more.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.host import on_host
from lerobot_latentsafe.pictures import averaged

GRID, CELLS = 6, 12
"""Patches and cells a side."""
FINEST = 96
"""Pixels a side that are looked at, at most."""
NUMBERS = 16
"""Of a patch: four cells, each of three colours and a detail."""
KINDS = 16
"""Kinds of each patch."""
LEAST = 0.02
"""Least standard deviation of a number: five grey levels, as a live picture was never compressed to a video."""
STRANGEST = 4
"""Patches whose mean distance is the second score."""
POINTS, SHADES = 48, 6
"""Points a side whose colours are counted, and the shades of red, green and blue that are told apart."""
OFFENDING = 8
"""Colours whose mean distance is the third score."""
FURTHEST = 100.0
"""A colour counts as so far off at most, a squared distance: one that the data lack is infinitely far from nothing."""
SCORES = 3
"""Of each camera; where it stands is a fourth, see `placement`."""
FRAMES = 6_000
"""Frames that the kinds are learned from, at most."""
ROUNDS = 8
"""Of k-means."""
PRIOR = 20
"""Frames that the deviations of all kinds of a patch count for, beside those of the kind itself."""


class Seen(NamedTuple):
    """What is looked at of B frames of C cameras.

    Attributes:
        patches: (B, C, P, NUMBERS).
        colours: (B, C, SHADES^3), the root of the number of points of each colour, of POINTS^2 at most.
        grey: uint8 (B, C, H, W), the pictures without colour, of FINEST pixels a side at most.
    """

    patches: np.ndarray
    colours: np.ndarray
    grey: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence["Seen"]) -> "Seen":
        """Frames one after the other."""
        return cls(*(np.concatenate(numbers) for numbers in zip(*parts)))


class Library(NamedTuple):
    """What is familiar.

    Attributes:
        mean, precision: of the kinds of each patch, and the inverse variances of their numbers, both (C, P, KINDS,
            NUMBERS).
        colours, spread: mean and standard deviation of the roots of counts, both (C, SHADES^3).
    """

    mean: np.ndarray
    precision: np.ndarray
    colours: np.ndarray
    spread: np.ndarray


def views(images: dict[str, Tensor], keys: list[str]) -> Seen:
    """What is looked at of pictures, on the host.

    Args:
        images: camera key -> (B, 3, H, W) in [0, 1].
        keys: of the C cameras, in order.
    """
    pictures = torch.stack([images[key] for key in keys], 1)
    if max(pictures.shape[-2:]) > FINEST:
        pictures = averaged(pictures, FINEST)
    apart = (pictures[..., ::2, ::2] - pictures[..., 1::2, 1::2]).abs().mean(-3, keepdim=True)
    detail = (averaged(apart, CELLS) + 1e-4).sqrt()
    cells = on_host(torch.cat([averaged(pictures, CELLS), detail], -3))
    n, c, of = cells.shape[:3]
    apart_cells = cells.reshape(n, c, of, GRID, 2, GRID, 2)
    patches = apart_cells.transpose(0, 1, 3, 5, 2, 4, 6).reshape(n, c, GRID**2, NUMBERS)
    points = averaged(pictures, POINTS) if max(pictures.shape[-2:]) > POINTS else pictures
    grey = (pictures.mean(-3) * 255).round().clamp(0, 255).to(torch.uint8)
    return Seen(patches, on_host(_colours(points)), on_host(grey, torch.uint8))


def _colours(points: Tensor) -> Tensor:
    """Roots of the number of points (..., 3, H, W) of each colour: (..., SHADES^3)."""
    red, green, blue = (points.clamp(0, 1) * (SHADES - 1e-3)).long().flatten(-2).unbind(-2)
    colour = (red * SHADES + green) * SHADES + blue
    counts = points.new_zeros(*colour.shape[:-1], SHADES**3)
    return counts.scatter_add_(-1, colour, torch.ones_like(colour, dtype=counts.dtype)).sqrt()


def strangeness(seen: Seen, library: Library) -> np.ndarray:
    """Scores (B, C, SCORES) of each camera: logs of the mean distance of all patches, of the STRANGEST of them, and of
    the OFFENDING colours."""
    apart = seen.patches[:, :, :, None] - library.mean
    apart *= apart
    apart *= library.precision
    distance = np.sort(apart.mean(-1).min(-1), -1)  # (B, C, P)
    off = np.minimum(np.square((seen.colours - library.colours) / library.spread), FURTHEST)
    offending = np.partition(off, -OFFENDING, -1)[..., -OFFENDING:]
    means = [part.mean(-1) for part in (distance, distance[..., -STRANGEST:], offending)]
    return np.log(np.stack(means, -1) + 1e-6)


def learn(seen: Seen) -> Library:
    """What is familiar of N frames: the kinds of each patch by k-means from starts that lie far apart, and colours."""
    n = len(seen.patches)
    if n > FRAMES:
        drawn = np.random.default_rng(0).choice(n, FRAMES, replace=False)
        seen = Seen(*(numbers[drawn] for numbers in seen))
    cameras = [_kinds(torch.from_numpy(np.ascontiguousarray(camera))) for camera in seen.patches.transpose(1, 2, 0, 3)]
    means, precisions = zip(*cameras)
    # A point more or less says nothing.
    return Library(np.stack(means), np.stack(precisions), seen.colours.mean(0), seen.colours.std(0) + 1)


def _kinds(x: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Means and inverse variances (P, KINDS, NUMBERS) of the numbers (P, N, NUMBERS) of one camera's patches."""
    patches = torch.arange(len(x))
    centres = x[:, :1]
    nearest = (x - centres).square().sum(-1)
    for _ in range(KINDS - 1):
        furthest = x[patches, nearest.argmax(1)][:, None]
        centres = torch.cat([centres, furthest], 1)
        nearest = torch.minimum(nearest, (x - furthest).square().sum(-1))
    for _ in range(ROUNDS):
        share, count = _shares(x, centres)
        moved = torch.einsum("pnk,pnj->pkj", share, x) / count.clamp(min=1)[..., None]
        centres = torch.where(count[..., None] > 0, moved, centres)
    share, count = _shares(x, centres)
    apart = (x - torch.einsum("pnk,pkj->pnj", share, centres)).square()
    own = torch.einsum("pnk,pnj->pkj", share, apart) + PRIOR * apart.mean(1, keepdim=True)
    variance = own / (count + PRIOR)[..., None] + LEAST**2
    return centres.numpy(), (1 / variance).numpy()


def _shares(x: Tensor, centres: Tensor) -> tuple[Tensor, Tensor]:
    """Which centre is nearest, one-hot (P, N, KINDS), and of how many frames each is (P, KINDS)."""
    share = torch.nn.functional.one_hot(torch.cdist(x, centres).argmin(-1), centres.shape[1]).float()
    return share, share.sum(1)
