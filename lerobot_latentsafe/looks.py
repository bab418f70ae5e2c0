"""What a live observation looks like, learned from a dataset alone, and checks of it that are cheap enough for a tick.

A picture is averaged to SIDE x SIDE pixels, and all else is read from that: how much it shows, how fine its detail is,
whether it is nearer to the dataset's mean picture as it is or turned, mirrored, in other colours, or of another camera.
A stream is compared with what it showed before while the robot moved, and a robot's state with what it was sent. Every
threshold comes from the dataset, with a factor of safety, such that no frame of it alarms; what a dataset does not tell
apart is not tested.
"""

import copy
import functools
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

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

ALTERATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "upside down": lambda x: x.flip(-2, -1),
    "mirrored": lambda x: x.flip(-1),
    "flipped": lambda x: x.flip(-2),
    "turned left": lambda x: x.rot90(1, (-2, -1)),
    "turned right": lambda x: x.rot90(-1, (-2, -1)),
    "with red and blue exchanged": lambda x: x.flip(-3),
    "without colour": lambda x: x.mean(-3, keepdim=True).expand_as(x),
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


def shrink(pictures: Tensor) -> Tensor:
    """Pictures (B, C, H, W), grey or of three colours, averaged to (B, 3, SIDE, SIDE)."""
    small = averaged(pictures, SIDE)
    return small if small.shape[1] == 3 else small.expand(-1, 3, -1, -1)


def thumbnails(small: Tensor) -> Tensor:
    """Pictures (..., SIDE, SIDE) averaged to (..., THUMBNAIL, THUMBNAIL)."""
    return averaged(small, THUMBNAIL)


def coarse(thumbnail: Tensor) -> Tensor:
    """Thumbnails averaged to (..., COARSE, COARSE)."""
    return averaged(thumbnail, COARSE)


def detail(small: Tensor) -> Tensor:
    """Mean difference of neighbouring pixels of pictures (..., 3, SIDE, SIDE): (...,)."""
    return (small[..., ::2, ::2] - small[..., 1::2, 1::2]).abs().mean((-3, -2, -1))


def contrast(picture: Tensor) -> Tensor:
    """Mean deviation of pictures (..., 3, H, W) from each half's mean colour; the same of both halves: (..., 3)."""
    deviate, average = (weights.to(picture) for weights in _of_halves(picture.shape[-2] * picture.shape[-1]))
    return (picture.flatten(-2) @ deviate).abs().flatten(-2) @ average


@functools.cache
def _of_halves(n: int) -> tuple[Tensor, Tensor]:
    """What takes the mean of its half out of each of n pixels (n, n); what averages those of three colours over the
    whole and over each half (3 n, 3)."""
    halves = torch.eye(2).repeat_interleave(n // 2, 0)  # (n, 2)
    average = torch.cat([torch.full((n, 1), 1 / n), halves * 2 / n], 1).repeat(3, 1) / 3
    return torch.eye(n) - halves @ halves.T * 2 / n, average


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
        self._shown: Tensor | None = None

    def went_unseen(self, thumbnail: Tensor, state: Tensor) -> Tensor:
        """How far each number of the state is from where it was when a camera first showed what it shows now.

        Args:
            thumbnail: (B, C, 3, THUMBNAIL, THUMBNAIL), of this tick.
            state: (B, S), standard deviations.

        Returns:
            (B, C, S); zero for a camera that shows something new.
        """
        shown = thumbnail.flatten(2)[:, :, None]
        if self._shown is None:
            self._shown = shown.new_full((*shown.shape[:2], KEPT, shown.shape[3]), torch.inf)
            self._states = state.new_zeros(*shown.shape[:2], KEPT, state.shape[1])
        state = state[:, None, None]
        same = (self._shown - shown).abs().amax(-1) <= self.same
        apart = (self._states - state).abs().nan_to_num(0.0)
        new = (~same.any(-1) & shown[:, :, 0].isfinite().all(-1))[..., None, None]
        if new.any():  # the oldest goes
            state = state.expand(-1, shown.shape[1], -1, -1)
            self._shown = torch.where(new, torch.cat([self._shown[:, :, 1:], shown], 2), self._shown)
            self._states = torch.where(new, torch.cat([self._states[:, :, 1:], state], 2), self._states)
        return (apart * same[..., None]).amax(2)


class Response:
    """How far commands went since the state of a robot last changed: one that does not answer, or shows an old state.

    Args:
        rest: (S,), by how much each number of the state may change and still count as unchanged, robot units.
        adds_up: bool (A,), commands of which each adds to those before: deltas and velocities; a target does not.
        limit: (A,), how far each may go unanswered, robot units.
    """

    def __init__(self, rest: Tensor, adds_up: Tensor, limit: Tensor | float = torch.inf):
        self.rest, self.adds_up, self.limit = rest, adds_up, torch.as_tensor(limit)
        self.reset()

    def see(self, state: Tensor, sent: Tensor) -> None:
        """Note the state of a tick, and what was executed before it; see `unanswered`."""
        self._went = self.unanswered(state, sent)

    def is_missing(self, proposed: Tensor) -> Tensor:
        """Which robots do not answer, and would be led further from where they were seen: bool (B,).

        What leads back passes, so that a robot that stands at its limits does not stand there for ever; and one whose
        state is frozen never goes further than the limit, unseen.

        Args:
            proposed: (B, A), what is to be executed next.
        """
        far = self._went > self.limit
        if not far.any():
            return far.any(-1)
        place = torch.where(self.adds_up, self._sum + proposed, proposed)
        back = (place - self._begin).abs() < self._went
        return (far & ~back).any(-1)

    def reset(self) -> None:
        """Start an episode."""
        self._since: Tensor | None = None

    def unanswered(self, state: Tensor, sent: Tensor) -> Tensor:
        """How far each command went while no number of the state changed: (B, A) in robot units.

        Args:
            state: (B, S) of this tick, robot units; numbers that are not usable are NaN.
            sent: (B, A), what was executed before it; NaN at the start of an episode.
        """
        if self._since is None:
            self.rest, self.adds_up, self.limit = (
                numbers.to(state.device) for numbers in (self.rest, self.adds_up, self.limit)
            )
            self._since, self._begin, self._sum = state, sent, torch.zeros_like(sent)
        self._sum = self._sum + torch.where(self.adds_up, sent.nan_to_num(0.0), 0.0)
        place = torch.where(self.adds_up, self._sum, sent)
        changed = ((state - self._since).abs() > self.rest).any(-1, keepdim=True)
        self._since = torch.where(changed, state, self._since)
        self._begin = torch.where(changed | self._begin.isnan(), place, self._begin)
        return (place - self._begin).abs().nan_to_num(0.0)


class Cameras:
    """Checks the cameras of B robots at every tick.

    Args:
        keys: of the cameras.
        looks: of those whose look is known, key -> look; of the others only what is wrong with any camera is checked.
    """

    def __init__(self, keys: list[str], looks: dict[str, Look] | None = None):
        looks = looks or {}
        self.keys, self.known = list(keys), [key in looks for key in keys]
        each = [looks.get(key, Look()) for key in keys]
        self._sees = [[*look.told] for look in each]
        least = torch.tensor([look.contrast or [0.0] * 3 for look in each]).view(-1, 3) / FACTOR
        self._least = torch.where(least > NOTHING, least, 0.0)  # a half that may be even is not judged
        self._least[:, 0].clamp_(min=NOTHING)
        finest = [look.detail or [0.0, torch.inf] for look in each]
        self._finest = torch.tensor([[low / FACTOR, high * FACTOR] for low, high in finest]).view(-1, 2)
        self._sizes = [SIDE if look.detail else 0 for look in each]
        nowhere = [0.0] * (3 * COARSE**2)
        mean = torch.tensor([look.mean or nowhere for look in each]).view(-1, 3, COARSE, COARSE)
        furthest = torch.tensor([FACTOR * look.furthest if look.mean else torch.inf for look in each])
        self._weight, self._limit = _templates(mean, furthest, keys, self._sees)
        unseen = [UNSEEN_FACTOR * torch.tensor(look.unseen) + MOVED_UNSEEN if look.unseen else None for look in each]
        self._unseen = None if None in unseen else torch.stack(unseen)
        self._stream = Stream(SAME if self._unseen is not None else 0.0)
        self.reset()

    def reset(self) -> None:
        """Start an episode."""
        self._stream.reset()
        self._repeats: Tensor | int = 0
        self._checked: tuple[Tensor, ...] = ()

    def check(self, pictures: dict[str, Tensor], sides: dict[str, int] | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Which robots have a camera that shows nothing, and which one that shows what the dataset never does.

        Args:
            pictures: camera key -> (B, C, H, W) in [0, 1]; pixels that are no numbers alarm nothing here.
            sides: the shorter side of what the camera showed, pixels, if these pictures were averaged of it.

        Returns:
            dead, unfamiliar: bool (B,); and thumbnails (B, cameras, 3, THUMBNAIL, THUMBNAIL) for `repeats`.
        """
        small = self._shrunk([pictures[key] for key in self.keys])
        self._move_to(small.device)
        thumbnail = thumbnails(small)
        picture = coarse(thumbnail)
        dead = (contrast(picture) < self._least).any(-1)
        fine = detail(small)
        blurred = fine < self._finest[:, 0]
        sides = sides or {key: min(picture.shape[-2:]) for key, picture in pictures.items()}
        tiny = [sides[key] < size for key, size in zip(self.keys, self._sizes)]
        if any(tiny):
            blurred = blurred | torch.tensor(tiny, device=small.device)
        pixels = picture.flatten(2)
        score = (self._weight @ pixels[..., None]).squeeze(-1)  # (B, C, 1 + N), see _templates
        score[..., 0] += pixels.square().sum(-1)
        beyond = score > self._limit
        strange = blurred | (fine > self._finest[:, 1]) | beyond[..., 0]
        altered = beyond[..., 1:]
        self._checked = dead, blurred, strange, altered
        return dead.any(1), (strange | altered.any(-1)).any(1), thumbnail

    def _shrunk(self, pictures: list[Tensor]) -> Tensor:
        """Pictures (B, C, H, W) of each camera, averaged: (B, cameras, 3, SIDE, SIDE)."""
        if len({picture.shape for picture in pictures}) == 1 and pictures[0].shape[1] == 3:  # all in one go
            return shrink(torch.stack(pictures, 1).flatten(0, 1)).unflatten(0, (-1, len(pictures)))
        return torch.stack([shrink(picture) for picture in pictures], 1)

    def _move_to(self, device: torch.device) -> None:
        """Have all thresholds where the pictures are."""
        if self._least.device != device:
            for name in ("_least", "_finest", "_weight", "_limit", "_unseen"):
                known = getattr(self, name)
                setattr(self, name, None if known is None else known.to(device))

    def repeats(self, thumbnail: Tensor, state: Tensor) -> Tensor:
        """Which robots have a camera that shows an old picture, though they moved: frozen, or going round and round.

        Args:
            thumbnail: of `check`.
            state: (B, S), standard deviations; numbers that are not usable are NaN.
        """
        went = self._stream.went_unseen(thumbnail, state)
        allowed = MOVED if self._unseen is None else self._unseen
        old = (went > allowed).any(-1)
        self._repeats = (self._repeats + 1) * old
        return (self._repeats >= REPEATS).any(1)

    def adopt(self, other: "Cameras") -> None:
        """Take over what others remember of the same cameras."""
        self._stream, self._repeats = copy.copy(other._stream), other._repeats

    @property
    def wrong(self) -> list[str]:
        """What the last `check` found, in words."""
        said = []
        for c, key in enumerate(self.keys if self._checked else []):
            dead, blurred, strange, altered = (found[:, c] for found in self._checked)
            seen = [name for name, any_row in zip(self._sees[c], altered.any(0).tolist()) if any_row]
            if dead.any():
                said.append(f"{key} shows nothing")
            elif seen:
                said.append(f"{key} seems to be {' or '.join(seen)}")
            elif blurred.any():
                said.append(f"{key} shows no detail")
            elif strange.any():
                said.append(f"{key} shows nothing like the data")
        return said


def _templates(mean: Tensor, furthest: Tensor, keys: list[str], sees: list[list[str]]) -> tuple[Tensor, Tensor]:
    """Weights w (C, 1 + N, D) and limits (C, 1 + N) for a picture x (D,) of each of C cameras.

    x x + w_0 x exceeds its limit where |x - m|, root mean square, exceeds `furthest`; w_n x where x is on the side of
    alteration n: |x - m|^2 - |x - a|^2, which is linear in x, exceeds the share APART of |a - m|^2, as it does of those
    altered in the data. Rows beyond a camera's alterations never do.
    """
    most = 1 + max([len(names) for names in sees], default=0)
    n_pixels = mean[0].numel() if len(mean) else 0
    weight, limit = mean.new_zeros(len(mean), most, n_pixels), mean.new_full((len(mean), most), torch.inf)
    for c, names in enumerate(sees):
        weight[c, 0] = -2 * mean[c].flatten()
        limit[c, 0] = n_pixels * furthest[c].square() - mean[c].square().sum()
        for n, name in enumerate(names, 1):
            altered = ALTERATIONS[name](mean[c]) if name in ALTERATIONS else mean[keys.index(name)]
            weight[c, n] = 2 * (altered - mean[c]).flatten()
            limit[c, n] = altered.square().sum() - mean[c].square().sum() + APART * (altered - mean[c]).square().sum()
    return weight, limit


# -- learning ---


def learn_looks(shown: dict[str, Tensor], fine: dict[str, Tensor], state: Tensor, episode: Tensor) -> dict[str, Look]:
    """What the cameras of a dataset look like.

    Args:
        shown: camera key -> (N, 3, THUMBNAIL, THUMBNAIL), of whole episodes.
        fine: camera key -> (N,), their `detail`; none of cameras whose pictures are smaller than SIDE.
        state: (N, S), standard deviations.
        episode: (N,), the number of each frame's.
    """
    pictures = {key: coarse(thumbnail) for key, thumbnail in shown.items()}
    healthy = {key: contrast(picture)[:, 0] >= NOTHING for key, picture in pictures.items()}
    pictures = {key: picture[healthy[key]] for key, picture in pictures.items()}
    means = {key: picture.mean(0) for key, picture in pictures.items() if len(picture)}
    unseen = _went_unseen(torch.stack(list(shown.values()), 1), state, episode)
    looks = {}
    for c, key in enumerate(shown):
        if key not in means:
            continue  # it shows nothing, ever
        picture, mean = pictures[key], means[key]
        others = {k: (means[k], pictures[k]) for k in means if k != key}
        lines = fine[key][healthy[key]] if key in fine else None
        looks[key] = Look(
            mean=_rounded(mean),
            furthest=round(float((picture - mean).square().mean((1, 2, 3)).sqrt().max()), 5),
            contrast=_rounded(contrast(picture).amin(0)),
            detail=[] if lines is None else _rounded(torch.stack([lines.min(), lines.max()])),
            told=_told(picture, mean, others),
            unseen=_rounded(unseen[c]),
            frames=len(picture),
        )
    return looks


def _told(picture: Tensor, mean: Tensor, others: dict[str, tuple[Tensor, Tensor]]) -> list[str]:
    """Alterations that each of the pictures (N, 3, COARSE, COARSE) tells apart from what it is, and it from them."""
    altered = {name: (alter(mean), alter(picture)) for name, alter in ALTERATIONS.items()}
    return [
        name
        for name, (other, seen) in (altered | others).items()
        if _side(picture, mean, other).max() < -APART and _side(seen, mean, other).min() > APART
    ]


def _side(picture: Tensor, mean: Tensor, other: Tensor) -> Tensor:
    """Where pictures (N, 3, h, w) lie between one mean, at -1, and another, at 1: (N,)."""
    apart = other - mean
    nearer = 2 * (picture * apart).sum((1, 2, 3)) + mean.square().sum() - other.square().sum()
    return nearer / apart.square().sum().clamp(min=1e-9)


def _went_unseen(shown: Tensor, state: Tensor, episode: Tensor) -> Tensor:
    """The largest `went_unseen` of each camera and number of the state: (C, S)."""
    most, stream = state.new_zeros(shown.shape[1], state.shape[1]), Stream()
    for frames in by_tick(episode):
        thumbnail = torch.where((frames >= 0)[:, None, None, None, None], shown[frames], torch.nan)
        most = torch.maximum(most, stream.went_unseen(thumbnail, state[frames]).amax(0))
    return most


def by_tick(episode: Tensor) -> Tensor:
    """Frames that are the first, the second and so on of every episode (T, E); -1 after an episode's end."""
    lengths = episode.unique_consecutive(return_counts=True)[1]
    places = torch.full((int(lengths.max()), len(lengths)), -1)
    for column, (begin, length) in enumerate(zip((lengths.cumsum(0) - lengths).tolist(), lengths.tolist())):
        places[:length, column] = torch.arange(begin, begin + length)
    return places


def _rounded(numbers: Tensor) -> list[float]:
    return [round(number, 5) for number in numbers.flatten().tolist()]
