"""What every path into a world model does to pictures, and which pictures it refuses."""

import functools
import math

import numpy as np
import torch
from torch import Tensor

from lerobot_latentsafe.host import on_host


def to_model_images(images: Tensor, size: int) -> Tensor:
    """What every path into a world model does to images: area-average to (size, size), round to 8 bits.

    Args:
        images: (..., C, H, W), uint8 or float in [0, 1], of three channels or, if they are grey, of one.

    Returns:
        float (..., 3, size, size) in [0, 1].
    """
    if images.shape[-3] == 1:
        images = images.expand(*images.shape[:-3], 3, *images.shape[-2:])
    scale, images = (1.0, images.float()) if images.dtype == torch.uint8 else (255.0, images)
    return (averaged(images, size) * scale + 1e-3).round() / 255.0  # the offset keeps x.5 from rounding by float noise


def averaged(images: Tensor, size: int) -> Tensor:
    """Float pictures (..., C, H, W), area-averaged to (..., C, size, size); colours stay last in memory if they are."""
    if images.shape[-2:] == (size, size):
        return images
    pixels = images.movedim(-3, -1)
    if pixels.is_contiguous():  # as cameras and videos give them: long lines, of which few products are made
        rows = _averaged_rows(pixels.flatten(-2), size)
        return _averaged_colours(rows.unflatten(-1, pixels.shape[-2:]), size).movedim(-1, -3)
    return _averaged_rows(_averaged_rows(images, size).mT, size).mT


def _averaged_rows(images: Tensor, size: int) -> Tensor:
    """Pictures (..., H, W), area-averaged to (..., size, W).

    Where both are many times some number of rows, 224 and 96 are 32 times 7 and 3, each such part is averaged alone.
    """
    n_parts = math.gcd(images.shape[-2], size)
    parts = images.unflatten(-2, (n_parts, -1))
    return (_averages(parts.shape[-2], size // n_parts).to(images) @ parts).flatten(-3, -2)


def _averaged_colours(pixels: Tensor, size: int) -> Tensor:
    """Lines of colours (..., W, C), averaged to (..., size, C), in parts likewise."""
    n_parts, colours = math.gcd(pixels.shape[-2], size), pixels.shape[-1]
    parts = pixels.unflatten(-2, (n_parts, -1)).flatten(-2)
    weights = _averages(pixels.shape[-2] // n_parts, size // n_parts, colours).to(pixels)
    return (parts @ weights.mT).flatten(-2).unflatten(-1, (size, colours))


@functools.cache
def _averages(n: int, size: int, colours: int = 1) -> Tensor:
    """(size, n), each times the colours: averages of a line's numbers over equal parts, as in interpolation by area,
    which is slower."""
    weights = torch.zeros(size, n)
    for i in range(size):
        first, end = i * n // size, -(-(i + 1) * n // size)
        weights[i, first:end] = 1 / (end - first)
    return torch.kron(weights, torch.eye(colours))


def surely_colours(pictures: Tensor) -> bool:
    """Whether all numbers are from 0 to 1, as far as that is told in one quick pass: on the host.

    Read as integers, floats from 0 on keep their order, and what is negative or no number comes after 1.
    """
    return pictures.device.type == "cpu" and bool(
        on_host(pictures).view(np.uint32).max() <= np.float32(1).view(np.uint32)
    )


def extremes(pictures: Tensor) -> np.ndarray:
    """The least and the largest number of each of the pictures (B, C, H, W): (2, B); NaN of one that has any."""
    return on_host(torch.stack([pictures.amin((1, 2, 3)), pictures.amax((1, 2, 3))]))


def check_proportions(key: str, shape: tuple[int, ...], trained: tuple[int, ...]) -> None:
    """Pictures of any size are averaged to the model's, but not stretched: refuse other proportions than in training.

    Args:
        shape, trained: (C, H, W) of the pictures now and of those that the filter was trained on.

    Raises:
        ValueError: naming both.
    """
    if len(shape) != 3 or shape[0] != trained[0] or shape[1] * trained[2] != shape[2] * trained[1]:
        raise ValueError(
            f"{key} has shape {tuple(shape)}, the filter was trained on {tuple(trained)} (channels, height, width); "
            "crop the pictures to these proportions, or train a filter on data of this camera"
        )
