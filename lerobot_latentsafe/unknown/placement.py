"""Whether a camera stands where it stood, and is as sharp, by the edges that never move.

Where the gradient of the grey picture is nearly the same in all frames of a dataset, something stands still: the edge
of a table, the fingers before a wrist camera. A picture is compared with the mean picture g_0 as it is, and with the
pictures g_a that a camera would show which had been moved, turned, brought nearer, mirrored or put out of focus. The
score is by how much the best of these explains the picture g better,

    max_a  sum_p w_ap (m_p0 - m_pa - min(m_p0, m_pa)) / sum_p w_ap,   m_pa = min(1, |g_p - g_ap| / w_ap),

with w_ap = |g_ap - g_0p|, over pixels p at edges that stand still: from -1 (as it was) to 1. What neither explains,
such as what covers an edge, speaks against a camera that was moved.
"""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

STILL = 1.0
"""An edge stands still where its mean gradient is more than so many standard deviations."""
LEAST = 0.004
"""Least standard deviation of a gradient: a grey level."""
APART = 0.1
"""Another camera is thought of where its edges differ from those of the mean picture by such a share of these: of a
symmetric scene the mirrored picture says nothing."""
POINTS = 120
"""Pixels at which g_0, and each g_a, are compared: those of the strongest edges."""
SIDE = 96.0
"""Pixels a side of the picture in which shifts are given below."""
NEAR, FAR = (-3.0, -1.5, 0.0, 1.5, 3.0), (-5.0, 0.0, 5.0)
"""Pixels by which the camera may have been moved, to the side and up: nearby in small steps."""


class Background(NamedTuple):
    """What stands still before C cameras.

    Attributes:
        mean: (C, H, W), the mean grey picture in [0, 1].
        still: bool (C, 2, H - 1, W - 1), where the gradient to the right and down stands still.
    """

    mean: np.ndarray
    still: np.ndarray


def learn(grey: np.ndarray) -> Background:
    """The background of grey pictures uint8 (N, C, H, W)."""
    mean = grey.mean(0).round().astype(np.float32) / 255  # as a file keeps it
    slope, usual = gradients(mean), gradients(grey.mean(0) / 255)
    square = np.zeros_like(usual)
    for picture in grey:  # gradients of all pictures at once would fill the memory
        square += np.square(gradients(picture.astype(np.float32) / 255) - usual)
    return Background(mean, np.abs(slope) > STILL * (np.sqrt(square / len(grey)) + LEAST))


def gradients(grey: np.ndarray) -> np.ndarray:
    """To the right and down, of pictures (..., H, W): (..., 2, H - 1, W - 1)."""
    here = grey[..., 1:, 1:]
    return np.stack([here - grey[..., 1:, :-1], here - grey[..., :-1, 1:]], -3)


def _others(height: int, width: int) -> list[Callable[[np.ndarray], np.ndarray]]:
    """What other cameras make of a picture (H, W)."""

    def seen_through(matrix: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        return lambda x: cv2.warpAffine(x, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)

    def blurred(radius: float) -> Callable[[np.ndarray], np.ndarray]:
        return lambda x: cv2.GaussianBlur(x, (0, 0), radius * unit)

    unit, centre = max(height, width) / SIDE, (width / 2, height / 2)
    shifts = {(dx, dy) for steps in (NEAR, FAR) for dx in steps for dy in steps} - {(0.0, 0.0)}
    moved = [seen_through(np.array([[1, 0, dx * unit], [0, 1, dy * unit]])) for dx, dy in sorted(shifts)]
    turned = [seen_through(cv2.getRotationMatrix2D(centre, *by)) for by in ((-4, 1), (4, 1), (0, 0.94), (0, 1.06))]
    mirrored = [lambda x: np.ascontiguousarray(x[:, ::-1]), lambda x: np.ascontiguousarray(x[::-1])]
    return [*moved, *turned, blurred(1.5), blurred(3.0), *mirrored]


class Placement:
    """Scores where C cameras stand.

    Args:
        background: of their pictures.
    """

    def __init__(self, background: Background):
        others = _others(*background.mean.shape[-2:])
        cameras = [_hypotheses(mean, still, others) for mean, still in zip(*background)]
        self._places, self._usual, self._other = (np.stack(parts) for parts in zip(*cameras))
        self._weight = np.abs(self._other - self._usual)
        self._unit = self._weight + 1e-6
        self._total = self._weight.sum(-1) + 1e-6
        edges = np.abs(self._usual[..., :POINTS]).sum(-1)
        self._told = self._total > APART * edges + 1e-3

    def scores(self, grey: np.ndarray) -> np.ndarray:
        """Of pictures uint8 (B, C, H, W): (B, C)."""
        found = np.empty(grey.shape[:2], np.float32)
        for camera in range(grey.shape[1]):
            slopes = gradients(grey[:, camera].astype(np.float32) / 255).reshape(len(grey), -1)
            at = slopes[:, self._places[camera]]  # (B, alternatives, points)
            unit = self._unit[camera]
            usual, other = (_apart(at, expected[camera], unit) for expected in (self._usual, self._other))
            gain = usual - other - np.minimum(usual, other)
            gain = (gain * self._weight[camera]).sum(-1) / self._total[camera]
            found[:, camera] = gain.max(-1, initial=-1.0, where=self._told[camera])
        return found


def _apart(at: np.ndarray, expected: np.ndarray, unit: np.ndarray) -> np.ndarray:
    return np.minimum(np.abs(at - expected) / unit, 1)


def _hypotheses(
    mean: np.ndarray, still: np.ndarray, others: list[Callable[[np.ndarray], np.ndarray]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each of A alternatives, where it is compared, and what is expected there as it was, and under it: (A, P)."""
    slope = gradients(mean).ravel()
    padded = np.pad(still.astype(np.float32), ((0, 0), (1, 0), (1, 0)))  # a gradient belongs to its lower right pixel
    own = _strongest(np.abs(slope) * still.ravel())
    places, expected = [], []
    for seen in others:
        other = gradients(seen(mean)).ravel()
        moved = np.stack([seen(part)[1:, 1:] for part in padded]).ravel() > 0.5
        places.append(np.concatenate([own, _strongest(np.abs(other) * moved)]))
        expected.append(other[places[-1]])
    at = np.stack(places)
    return at, slope[at], np.stack(expected)


def _strongest(edges: np.ndarray) -> np.ndarray:
    """The POINTS places at which these are largest."""
    return np.argsort(-edges, kind="stable")[:POINTS]
