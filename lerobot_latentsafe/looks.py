"""What a live observation looks like, learned from a dataset alone, and checks of it that are cheap enough for a tick.

A picture is averaged to SIDE x SIDE pixels, and all else is read from that: how much it shows, how fine its detail is,
whether it is nearer to the dataset's mean picture as it is or turned, mirrored, in other colours, or of another camera.
A stream is compared with what it showed before while the robot moved, and a robot's state with what it was sent. Every
threshold comes from the dataset, with a factor of safety, such that no frame of it alarms; what a dataset does not tell
apart is not tested.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from torch import Tensor

from lerobot_latentsafe.host import QUIET, any_of, on_host
from lerobot_latentsafe.pictures import averaged

SIDE, THUMBNAIL, COARSE = 32, 16, 8
"""Pixels a side: what is looked at, what is compared with the past, and what with the dataset's mean."""
NOTHING = 0.003
"""What deviates less from its mean colour, on average, shows nothing: less than one of 256 grey levels."""
FACTOR = 2.0
"""A live picture may leave what the dataset shows by this factor."""
APART = 0.2
"""An alteration is told where every frame of the dataset is on its side by so much; the means are at -1 and 1."""
SAME = 0.004
"""Thumbnails that differ nowhere by more are the same picture, encoded again: a grey level."""
KEPT, REPEATS = 8, 3
"""Different pictures that are remembered; and ticks in a row after which a picture that comes again is an old one."""
MOVED, MOVED_UNSEEN = 0.05, 0.15
"""Standard deviations by which a number of the state may always change unseen, by a camera whose look is not known; and
by one of which it is known."""
UNSEEN_FACTOR = 2.5
"""Times what the dataset shows to change unseen, beyond which a picture that stays the same is an old one."""

ALTERATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "upside down": lambda x: x[..., ::-1, ::-1],
    "mirrored": lambda x: x[..., ::-1],
    "flipped": lambda x: x[..., ::-1, :],
    "turned left": lambda x: np.rot90(x, 1, (-2, -1)),
    "turned right": lambda x: np.rot90(x, -1, (-2, -1)),
    "with red and blue exchanged": lambda x: x[..., ::-1, :, :],
    "without colour": lambda x: np.broadcast_to(x.mean(-3, keepdims=True), x.shape),
}
"""Name -> what it makes of pictures (..., 3, H, W)."""


@dataclass
class Look:
    """What the pictures of one camera have in common; colours in [0, 1].

    Attributes:
        mean: 3 x COARSE x COARSE, the mean picture, channel by channel and row by row.
        furthest: largest distance of a frame from it, root mean square.
        contrast: least `contrast` of a frame, of its upper and of its lower half; of frames that show anything.
        detail: least and largest mean difference of neighbouring pixels, at SIDE pixels a side; empty where the
            pictures that were seen are smaller.
        told: alterations that every frame tells apart from what is: of ALTERATIONS, or keys of other cameras.
        unseen: how far each number of the state went while the picture stayed the same, standard deviations.
        frames: how many were looked at.
    """

    mean: list[float] = field(default_factory=list)
    furthest: float = 0.0
    contrast: list[float] = field(default_factory=list)
    detail: list[float] = field(default_factory=list)
    told: list[str] = field(default_factory=list)
    unseen: list[float] = field(default_factory=list)
    frames: int = 0


def shrink(pictures: Tensor) -> np.ndarray:
    """Pictures (B, C, H, W), grey or of three colours, averaged to (B, 3, SIDE, SIDE), on the host."""
    small = on_host(averaged(pictures, SIDE))
    return small if small.shape[1] == 3 else small.repeat(3, 1)


def halved(pictures: np.ndarray) -> np.ndarray:
    """Pictures (..., H, W) averaged to half the size: of SIDE, thumbnails; and of THUMBNAIL, those of COARSE pixels."""
    lines = pictures[..., ::2, :] + pictures[..., 1::2, :]
    return (lines[..., ::2] + lines[..., 1::2]) / 4


def detail(small: np.ndarray) -> np.ndarray:
    """Mean difference of neighbouring pixels of pictures (..., 3, SIDE, SIDE): (...,)."""
    apart = np.abs(small[..., ::2, ::2] - small[..., 1::2, 1::2])
    return apart.reshape(*small.shape[:-3], -1).sum(-1) / (3 * THUMBNAIL**2)


def contrast(picture: np.ndarray) -> np.ndarray:
    """Mean deviation of pictures (..., 3, COARSE, COARSE) from each half's mean colour; the same of both halves:
    (..., 3)."""
    deviation = np.abs(picture.reshape(*picture.shape[:-2], -1) @ _DEVIATE)
    return deviation.reshape(*picture.shape[:-3], -1) @ _AVERAGE


def _of_halves(n: int) -> tuple[np.ndarray, np.ndarray]:
    """What takes the mean of its half out of each of n pixels (n, n); what averages those of three colours over the
    whole and over each half (3 n, 3)."""
    halves = np.eye(2, dtype=np.float32).repeat(n // 2, 0)  # (n, 2)
    average = np.concatenate([halves.mean(1, keepdims=True), halves], 1) * 2 / n
    return np.eye(n, dtype=np.float32) - halves @ halves.T * 2 / n, np.tile(average, (3, 1)) / 3


_DEVIATE, _AVERAGE = _of_halves(COARSE**2)


class Stream:
    """What cameras showed before, of B robots with C cameras each: the last KEPT pictures that differ.

    Args:
        same: thumbnails that differ nowhere by more are the same picture.
    """

    def __init__(self, same: float = SAME):
        self.same = same
        self.reset()

    def reset(self) -> None:
        """Forget them."""
        self._shown: np.ndarray | None = None

    def went_unseen(self, thumbnail: np.ndarray, state: np.ndarray) -> np.ndarray:
        """How far each number of the state is from where it was when a camera first showed what it shows now.

        Args:
            thumbnail: (B, C, 3, THUMBNAIL, THUMBNAIL), of this tick.
            state: (B, S), standard deviations.

        Returns:
            (B, C, S); zero for a camera that shows something new.
        """
        size = n, n_cameras = thumbnail.shape[:2]
        shown = thumbnail.reshape(n, n_cameras, -1)
        if self._shown is None:
            self._shown = np.full((*size, KEPT, shown.shape[-1]), np.inf, np.float32)
            self._states = np.zeros((*size, KEPT, state.shape[-1]), np.float32)
            self._oldest = np.zeros(size, np.int64)
        apart = self._shown - shown[:, :, None]
        same = np.abs(apart, out=apart).max(-1) <= self.same
        again = any_of(same)
        went = np.zeros((*size, state.shape[-1]), np.float32)
        if again.any():
            moved = np.abs(self._states - state[:, None, None])
            went = np.where(same[..., None] & ~np.isnan(moved), moved, 0.0).max(2)
        new = np.nonzero(~again & np.isfinite(shown).all(-1))
        place = (*new, self._oldest[new])
        self._shown[place], self._states[place] = shown[new], state[new[0]]
        self._oldest[new] = (self._oldest[new] + 1) % KEPT
        return went


class Response:
    """How far commands went since the state of a robot last changed: one that does not answer, or shows an old state.

    Args:
        rest: (S,), by how much each number of the state may change and still count as unchanged, robot units.
        adds_up: bool (A,), commands of which each adds to those before: deltas and velocities; a target does not.
        limit: (A,), how far each may go unanswered, robot units.
    """

    def __init__(self, rest: np.ndarray, adds_up: np.ndarray, limit: np.ndarray | float = np.inf):
        self.rest, self.adds_up, self.limit = rest, adds_up, limit
        self.reset()

    def see(self, state: np.ndarray, sent: np.ndarray) -> None:
        """Note the state of a tick, and what was executed before it; see `unanswered`."""
        self._went = self.unanswered(state, sent)

    def is_missing(self, proposed: np.ndarray) -> np.ndarray:
        """Which robots do not answer, and would be led further from where they were seen: bool (B,).

        What leads back passes, so that a robot that stands at its limits does not stand there for ever; and one whose
        state is frozen never goes further than the limit, unseen.

        Args:
            proposed: (B, A), what is to be executed next.
        """
        far = self._went > self.limit
        if not far.any():
            return any_of(far)
        place = np.where(self.adds_up, self._sum + proposed, proposed)
        back = np.abs(place - self._begin) < self._went
        return any_of(far & ~back)

    def reset(self) -> None:
        """Start an episode."""
        self._since: np.ndarray | None = None

    @QUIET
    def unanswered(self, state: np.ndarray, sent: np.ndarray) -> np.ndarray:
        """How far each command went while no number of the state changed: (B, A) in robot units.

        Args:
            state: (B, S) of this tick, robot units; numbers that are not usable are NaN.
            sent: (B, A), what was executed before it; NaN at the start of an episode.
        """
        if self._since is None:
            self._since, self._begin, self._sum = state, sent, np.zeros_like(sent)
        self._sum = self._sum + np.where(self.adds_up & ~np.isnan(sent), sent, 0.0)
        place = np.where(self.adds_up, self._sum, sent)
        changed = any_of(np.abs(state - self._since) > self.rest)[:, None]
        self._since = np.where(changed, state, self._since)
        self._begin = np.where(changed | np.isnan(self._begin), place, self._begin)
        went = np.abs(place - self._begin)
        return np.where(np.isnan(went), 0.0, went)


class Cameras:
    """Checks the cameras of B robots at every tick.

    Args:
        keys: of the cameras.
        looks: of those whose look is known, key -> look; of the others only what is wrong with any camera is checked.
    """

    def __init__(self, keys: list[str], looks: dict[str, Look] | None = None):
        looks = looks or {}
        self.keys = list(keys)
        each = [looks.get(key, Look()) for key in keys]
        self._sees = [[*look.told] for look in each]
        least = np.array([look.contrast or [0.0] * 3 for look in each], np.float32).reshape(-1, 3) / FACTOR
        self._least = np.where(least > NOTHING, least, 0.0)  # a half that may be even is not judged
        self._least[:, 0] = self._least[:, 0].clip(min=NOTHING)
        finest = [look.detail or [0.0, np.inf] for look in each]
        self._finest = np.array([[low / FACTOR, high * FACTOR] for low, high in finest], np.float32).reshape(-1, 2)
        self._sizes = [SIDE if look.detail else 0 for look in each]
        nowhere = [0.0] * (3 * COARSE**2)
        mean = np.array([look.mean or nowhere for look in each], np.float32).reshape(-1, 3, COARSE, COARSE)
        furthest = np.array([FACTOR * look.furthest if look.mean else np.inf for look in each], np.float32)
        self._weight, self._limit = _templates(mean, furthest, keys, self._sees)
        known = bool(each) and all(look.unseen for look in each)
        self._allowed: np.ndarray | float = MOVED
        if known:
            self._allowed = UNSEEN_FACTOR * np.array([look.unseen for look in each], np.float32) + MOVED_UNSEEN
        self._stream = Stream(SAME if known else 0.0)
        self.reset()

    def reset(self) -> None:
        """Start an episode."""
        self._stream.reset()
        self._repeats = np.zeros((1, 1), np.int64)
        self._checked: tuple[np.ndarray, ...] = ()

    def check(
        self, pictures: dict[str, Tensor], sides: dict[str, int] | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which robots have a camera that shows nothing, and which one that shows what the dataset never does.

        Args:
            pictures: camera key -> (B, C, H, W) in [0, 1]; pixels that are no numbers alarm nothing here.
            sides: the shorter side of what the camera showed, pixels, if these pictures were averaged of it.

        Returns:
            dead, unfamiliar: bool (B,); and thumbnails (B, cameras, 3, THUMBNAIL, THUMBNAIL) for `repeats`.
        """
        small = np.stack([shrink(pictures[key]) for key in self.keys], 1)
        thumbnail = halved(small)
        picture = halved(thumbnail)
        dead = any_of(contrast(picture) < self._least)
        fine = detail(small)
        blurred = fine < self._finest[:, 0]
        sides = sides or {key: min(picture.shape[-2:]) for key, picture in pictures.items()}
        tiny = [sides[key] < size for key, size in zip(self.keys, self._sizes)]
        if any(tiny):
            blurred |= tiny
        pixels = picture.reshape(*picture.shape[:2], -1)
        score = (self._weight @ pixels[..., None])[..., 0]  # (B, C, 1 + N), see _templates
        score[..., 0] += (pixels * pixels).sum(-1)
        beyond = score > self._limit
        strange = blurred | (fine > self._finest[:, 1]) | beyond[..., 0]
        altered = beyond[..., 1:]
        self._checked = dead, blurred, strange, altered
        return any_of(dead), any_of(strange | any_of(altered)), thumbnail

    def repeats(self, thumbnail: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Which robots have a camera that shows an old picture, though they moved: frozen, or going round and round.

        Args:
            thumbnail: of `check`.
            state: (B, S), standard deviations; numbers that are not usable are NaN.
        """
        old = any_of(self._stream.went_unseen(thumbnail, state) > self._allowed)
        self._repeats = (self._repeats + 1) * old
        return any_of(self._repeats >= REPEATS)

    def adopt(self, other: "Cameras") -> None:
        """Take over what others remember of the same cameras."""
        self._stream, self._repeats = copy.deepcopy(other._stream), other._repeats

    @property
    def wrong(self) -> list[str]:
        """What the last `check` found, in words."""
        said = []
        for c, key in enumerate(self.keys if self._checked else []):
            dead, blurred, strange, altered = (found[:, c] for found in self._checked)
            seen = [name for name, any_row in zip(self._sees[c], any_of(altered, 0)) if any_row]
            if dead.any():
                said.append(f"{key} shows nothing")
            elif seen:
                said.append(f"{key} seems to be {' or '.join(seen)}")
            elif blurred.any():
                said.append(f"{key} shows no detail")
            elif strange.any():
                said.append(f"{key} shows nothing like the data")
        return said


def _templates(
    mean: np.ndarray, furthest: np.ndarray, keys: list[str], sees: list[list[str]]
) -> tuple[np.ndarray, np.ndarray]:
    """Weights w (C, 1 + N, D) and limits (C, 1 + N) for a picture x (D,) of each of C cameras.

    x x + w_0 x exceeds its limit where |x - m|, root mean square, exceeds `furthest`; w_n x where x is on the side of
    alteration n: |x - m|^2 - |x - a|^2, which is linear in x, exceeds the share APART of |a - m|^2, as it does of those
    altered in the data. Rows beyond a camera's alterations never do.
    """
    most = 1 + max([len(names) for names in sees], default=0)
    n_pixels = mean[0].size if len(mean) else 0
    weight = np.zeros((len(mean), most, n_pixels), np.float32)
    limit = np.full((len(mean), most), np.inf, np.float32)
    for c, names in enumerate(sees):
        weight[c, 0] = -2 * mean[c].ravel()
        limit[c, 0] = n_pixels * furthest[c] ** 2 - _square(mean[c])
        for n, name in enumerate(names, 1):
            altered = ALTERATIONS[name](mean[c]) if name in ALTERATIONS else mean[keys.index(name)]
            weight[c, n] = 2 * (altered - mean[c]).ravel()
            limit[c, n] = _square(altered) - _square(mean[c]) + APART * _square(altered - mean[c])
    return weight, limit


def _square(picture: np.ndarray) -> np.ndarray:
    """The sum of squares of pictures (..., 3, H, W): (...,)."""
    return (picture * picture).sum((-3, -2, -1))


# -- learning ---


def learn_looks(
    shown: dict[str, np.ndarray], fine: dict[str, np.ndarray], state: np.ndarray, episode: np.ndarray
) -> dict[str, Look]:
    """What the cameras of a dataset look like.

    Args:
        shown: camera key -> (N, 3, THUMBNAIL, THUMBNAIL), of whole episodes.
        fine: camera key -> (N,), their `detail`; none of cameras whose pictures are smaller than SIDE.
        state: (N, S), standard deviations.
        episode: (N,), the number of each frame's.
    """
    pictures = {key: halved(thumbnail) for key, thumbnail in shown.items()}
    healthy = {key: contrast(picture)[:, 0] >= NOTHING for key, picture in pictures.items()}
    pictures = {key: picture[healthy[key]] for key, picture in pictures.items()}
    means = {key: picture.mean(0) for key, picture in pictures.items() if len(picture)}
    unseen = _went_unseen(np.stack(list(shown.values()), 1), state, episode)
    looks = {}
    for c, key in enumerate(shown):
        if key not in means:
            continue  # it shows nothing, ever
        picture, mean = pictures[key], means[key]
        others = {k: (means[k], pictures[k]) for k in means if k != key}
        lines = fine[key][healthy[key]] if key in fine else None
        looks[key] = Look(
            mean=_rounded(mean),
            furthest=round(float(np.sqrt(_square(picture - mean) / mean.size).max()), 5),
            contrast=_rounded(contrast(picture).min(0)),
            detail=[] if lines is None else _rounded(np.array([lines.min(), lines.max()])),
            told=_told(picture, mean, others),
            unseen=_rounded(unseen[c]),
            frames=len(picture),
        )
    return looks


def _told(picture: np.ndarray, mean: np.ndarray, others: dict[str, tuple[np.ndarray, np.ndarray]]) -> list[str]:
    """Alterations that each of the pictures (N, 3, COARSE, COARSE) tells apart from what it is, and it from them."""
    altered = {name: (alter(mean), alter(picture)) for name, alter in ALTERATIONS.items()}
    return [
        name
        for name, (other, seen) in (altered | others).items()
        if _side(picture, mean, other).max() < -APART and _side(seen, mean, other).min() > APART
    ]


def _side(picture: np.ndarray, mean: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Where pictures (N, 3, h, w) lie between one mean, at -1, and another, at 1: (N,)."""
    apart = other - mean
    nearer = 2 * (picture * apart).sum((1, 2, 3)) + _square(mean) - _square(other)
    return nearer / _square(apart).clip(min=1e-9)


def _went_unseen(shown: np.ndarray, state: np.ndarray, episode: np.ndarray) -> np.ndarray:
    """The largest `went_unseen` of each camera and number of the state: (C, S)."""
    most, stream = np.zeros((shown.shape[1], state.shape[1]), np.float32), Stream()
    for frames in by_tick(episode):
        thumbnail = np.where((frames >= 0)[:, None, None, None, None], shown[frames], np.nan)
        most = np.maximum(most, stream.went_unseen(thumbnail, state[frames]).max(0))
    return most


def by_tick(episode: np.ndarray) -> np.ndarray:
    """Frames that are the first, the second and so on of every episode (T, E); -1 after an episode's end."""
    begins = np.flatnonzero(np.diff(episode, prepend=episode[0] - 1))
    lengths = np.diff(begins, append=len(episode))
    ticks = np.arange(lengths.max())[:, None]
    return np.where(ticks < lengths, begins + ticks, -1)


def _rounded(numbers: np.ndarray) -> list[float]:
    return [round(number, 5) for number in numbers.ravel().tolist()]
