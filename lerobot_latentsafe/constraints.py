"""Constraints that are added without training: a failure set that is given by a few frames, and a critic that reads it.

A frame that a user marks as failing is a prototype. `Likeness` says where a latent is, in a few numbers that the
recording holds, such as a position; a prototype is a place among these, and how far the failure reaches around it. The
margin of a set is the least of its prototypes' margins,

    l(z) = min_i |w_i * (phi(z) - p_i)| - 1,

and not the value: V of a set is learned, as one may be able to evade each of two constraints, and not both. So the
critic reads the set, too (`SetNetwork`), and is trained on random ones.

The filter's own margin is the last number of phi. So the failure that it was trained for is a prototype like others.
"""

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lerobot_latentsafe.latent import ABSURD, Latent

SLOTS = 8
"""Prototypes of a set at most; those of all constraints that hold count together."""
MOST = 5
"""Prototypes of one constraint at most."""
REACH = (0.5, 2.5)
"""How far a prototype may reach, as multiples of how far apart alike frames may be."""
KEY = "constraints"
"""Where a latent holds the set that it is judged by, during training."""

Prototype = dict[str, list[float]]
"""Number -> [where, how far the failure reaches], in the recording's units; numbers that are left out do not count."""


class ConstraintError(ValueError):
    """A constraint that a filter does not know, or that cannot be made of what was marked."""


@dataclass
class LikenessConfig:
    """What makes two frames alike, and the constraints that are made of frames. It belongs to the weights.

    Attributes:
        alike: number of the recording, such as `x.pos` -> how far apart alike frames may be in it. Empty: the critic
            knows one failure, and takes no constraints.
        low, high: least and largest of each number in the data, in the order of `alike`.
        known: constraint -> its prototypes; see `Prototype`. Added by `latentsafe add-constraint`.
        own: the failure that the filter's margin was trained for. The margin is one more number, by this name.
        hidden: width of the network that says where a latent is.
    """

    alike: dict[str, float] = field(default_factory=dict)
    low: list[float] = field(default_factory=list)
    high: list[float] = field(default_factory=list)
    known: dict[str, list[Prototype]] = field(default_factory=dict)
    own: str = "failure"
    hidden: int = 64

    @property
    def numbers(self) -> dict[str, float]:
        """Number -> its unit: those of `alike`, and the filter's own margin; none if there are no constraints."""
        return {**self.alike, self.own: 1.0} if self.alike else {}

    @property
    def own_failure(self) -> dict[str, list[Prototype]]:
        """The constraint whose margin is the filter's own: m = |m + 1| - 1, as no bounded margin is below -1."""
        return {self.own: [{self.own: [-1.0, 1.0]}]}

    def __post_init__(self) -> None:
        if self.own in self.alike:
            raise ConstraintError(f"--alike speaks of {self.own}, which is the name of the failure labels")
        for name, apart in self.alike.items():
            if not 0 < apart < math.inf:
                raise ConstraintError(f"--alike says {apart} of {name}; expected a distance, more than 0")

    def require_known(self, names: list[str], trained: bool) -> None:
        """Refuse constraints that are unknown, none at all, or more than the critic was trained on.

        Args:
            trained: whether the critic is.

        Raises:
            ConstraintError: naming what was given, what there is, and the remedy.
        """
        given = f"--policy.constraints is [{', '.join(names)}]"
        if names and not self.alike:
            raise ConstraintError(
                f"{given}, but this filter was trained for one failure, and takes none. Leave the option out, or train "
                "a critic that takes constraints: latentsafe train-reachability --alike='{x.pos: 0.25}'"
            )
        there_are = f"this filter knows {', '.join(self.known) or 'none'}"
        unknown = [name for name in names if name not in self.known]
        if unknown:
            raise ConstraintError(
                f"{given}, and {there_are}. Add {', '.join(unknown)} first: latentsafe add-constraint --specification="
                f"{unknown[0]}"
            )
        if self.alike and trained and not names:
            raise ConstraintError(f"{given}, so nothing would count as a failure; {there_are}. Name at least one")
        n = sum(len(self.known[name]) for name in {*names})
        if n > SLOTS:
            raise ConstraintError(
                f"{given}, which have {n} prototypes together; the critic was trained on {SLOTS} at most. Name fewer"
            )

    def tensor(self, names: list[str]) -> Tensor:
        """The set of these constraints: (SLOTS, 2 m), see `margin_of`."""
        counting = [prototype for name in dict.fromkeys(names) for prototype in self.known[name]]
        empty = [[0.0] * 2 * len(self.numbers)] * (SLOTS - len(counting))
        return torch.tensor([*map(self._row, counting), *empty])

    def _row(self, prototype: Prototype) -> list[float]:
        nowhere = [0.0, math.inf]
        ends = [(*prototype.get(name, nowhere), apart) for name, apart in self.numbers.items()]
        return [where / apart for where, _, apart in ends] + [apart / reach for _, reach, apart in ends]

    def prototypes(self, failing: np.ndarray, safe: np.ndarray, of: list[str] | None = None) -> list[Prototype]:
        """What tells frames that fail from those that are safe.

        Args:
            failing, safe: (N, m - 1) and (M, m - 1), places as multiples of `alike`; see `cover`.
            of: the numbers that count; None: all.

        Raises:
            ConstraintError: a number that does not say what is alike, or frames of which no constraint can be made.
        """
        names, known = of or [*self.alike], [*self.alike]
        unknown = [name for name in names if name not in known]
        if unknown:
            raise ConstraintError(
                f"{', '.join(unknown)} says nothing of what is alike; expected some of {', '.join(known)}"
            )
        columns = [known.index(name) for name in names]
        units = [self.alike[name] for name in names]
        return [
            {name: [round(float(at * unit), 5), round(reach * unit, 5)] for name, at, unit in zip(names, where, units)}
            for where, reach in cover(failing[:, columns], safe[:, columns])
        ]


class Likeness(nn.Module):
    """Features (..., D) -> where a latent is (..., m - 1), each number as a multiple of how far apart alike ones are.

    It is phi without the filter's own margin. It is fitted to numbers of the recording, and reads what the world model
    makes of pictures.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, feature_dim: int, config: LikenessConfig):
        super().__init__()
        self.register_buffer("mean", torch.zeros(feature_dim))
        self.register_buffer("deviation", torch.ones(feature_dim))
        widths = feature_dim, config.hidden, config.hidden, len(config.alike)
        first, second, last = (nn.Linear(n_in, n_out) for n_in, n_out in pairwise(widths))
        self.net = nn.Sequential(first, nn.SiLU(), second, nn.SiLU(), last)

    def forward(self, features: Tensor) -> Tensor:
        """Where latents are; NaN where that is absurd."""
        where = self.net((features - self.mean) / self.deviation)
        return torch.where(where.abs() <= ABSURD, where, torch.nan)


def margin_of(where: Tensor, prototypes: Tensor) -> Tensor:
    """Bounded margin of a set: the least of its prototypes', negative within the reach of one.

    Args:
        where: (..., m), phi of latents.
        prototypes: (..., SLOTS, 2 m): p, and 1 / reach, of which 0 says that a number does not count; and a slot where
            none counts is empty.

    Returns:
        (...,) in (-1, 1]; NaN where phi is.
    """
    place, weight = prototypes.chunk(2, -1)
    beyond = torch.linalg.vector_norm(weight * (where.unsqueeze(-2) - place), dim=-1) - 1
    present = (weight > 0).any(-1) | where.isnan().any(-1, keepdim=True)
    return torch.tanh(torch.where(present, beyond, torch.inf).amin(-1))


class Constrained:
    """An imagination whose failures are a set of prototypes: each latent's own, or the one given for all.

    Features are those of the world model (D), phi (m), and the set (SLOTS x 2 m), side by side.

    Args:
        inside: an `Imagination` (see `reachability.py`), whose margin is the filter's own.
        active: (SLOTS, 2 m), the set that counts where latents hold none.
    """

    def __init__(self, inside: Any, likeness: Likeness, active: Tensor):
        self.inside, self.likeness, self.active = inside, likeness, active
        self.sampled, self.ended, self.complete = inside.sampled, inside.ended, inside.complete

    def step(self, latent: Latent, action: Tensor) -> Latent:
        """Next latent under actions (B, A) in [-1, 1]."""
        return _keep_set(latent, self.inside.step(latent, action))

    def follow(self, latent: Latent, actions: Tensor) -> Latent:
        """Next latent under the actions of a step's ticks, side by side (B, K A)."""
        return _keep_set(latent, self.inside.follow(latent, actions))

    def features(self, latent: Latent) -> Tensor:
        """What actor and critic read: (B, D + m + SLOTS x 2 m)."""
        features, own = self.inside.judged(latent)
        prototypes = latent[KEY] if KEY in latent else self.active.expand(*own.shape, -1, -1)
        return torch.cat([features, self.likeness(features), own.unsqueeze(-1), prototypes.flatten(-2)], -1)

    def margin(self, latent: Latent) -> Tensor:
        """Bounded margin of the set: (B,)."""
        return self.judged(latent)[1]

    def judged(self, latent: Latent) -> tuple[Tensor, Tensor]:
        """Features and bounded margin (B,), both at once."""
        features = self.features(latent)
        size, numbers = self.active.numel(), self.active.shape[-1] // 2
        _, where, prototypes = features.tensor_split([-size - numbers, -size], -1)
        return features, margin_of(where, prototypes.unflatten(-1, self.active.shape))


def _keep_set(before: Latent, after: Latent) -> Latent:
    return {**after, KEY: before[KEY]} if KEY in before else after


class SetNetwork(nn.Module):
    """A network that reads a set, in whatever order: each prototype as seen from here, then the largest of all.

    Args:
        n_read: numbers C that say where we are, of which the last m are phi.
        numbers: m.
        width: of what is made of each prototype.
        rest: reads these C, what was made of the set (width), and what else is given, such as an action.
    """

    def __init__(self, n_read: int, numbers: int, width: int, rest: nn.Module):
        super().__init__()
        self.sizes, self.numbers = [n_read, SLOTS * 2 * numbers], numbers
        self.here, self.there = nn.Linear(n_read, width), nn.Linear(2 * numbers, width, bias=False)
        self.each, self.rest = nn.Linear(width, width), rest

    def forward(self, x: Tensor) -> Tensor:
        """(..., C + SLOTS x 2 m + what else is given) -> what `rest` gives."""
        here, prototypes, more = x.tensor_split([self.sizes[0], sum(self.sizes)], -1)
        place, weight = prototypes.unflatten(-1, (SLOTS, -1)).chunk(2, -1)
        away = weight * (here[..., None, -self.numbers :] - place)
        seen = torch.relu(self.here(here).unsqueeze(-2) + self.there(torch.cat([away, weight], -1)))
        seen = torch.relu(self.each(seen)) * (weight > 0).any(-1, keepdim=True)
        return self.rest(torch.cat([here, seen.amax(-2), more], -1))


def random_sets(places: Tensor, n: int, generator: torch.Generator) -> Tensor:
    """Sets of 1 to SLOTS prototypes at places of the data (N, m - 1), each of another reach: (n, SLOTS, 2 m).

    Now and then one number of several does not count, as of a line that must not be crossed. In a third of the sets the
    filter's own failure is one of them.
    """
    numbers = places.shape[1]
    rand = lambda *shape: torch.rand(shape, generator=generator)  # noqa: E731
    place = places[torch.randint(len(places), (n, SLOTS), generator=generator)]
    low, high = math.log(REACH[0]), math.log(REACH[1])
    weight = torch.exp(-(low + (high - low) * rand(n, SLOTS, 1))).repeat(1, 1, numbers)
    left_out = torch.randint(numbers, (n, SLOTS, 1), generator=generator)
    some = (rand(n, SLOTS, 1) < 0.15) & (numbers > 1)
    weight = torch.where(some & (torch.arange(numbers) == left_out), 0.0, weight)
    own = (rand(n, 1, 1) < 1 / 3) & (torch.arange(SLOTS)[:, None] == 0)  # (n, SLOTS, 1)
    row = torch.cat([place * ~own, -1.0 * own, weight * ~own, 1.0 * own], -1)
    present = torch.arange(SLOTS) < torch.randint(1, SLOTS + 1, (n, 1), generator=generator)
    return row * present[..., None]


def cover(failing: np.ndarray, safe: np.ndarray) -> list[tuple[np.ndarray, float]]:
    """A few prototypes that tell frames that fail from those that do not: (where (m,), reach) each.

    Where nothing is known to be safe, each failing frame is one, and reaches as far as alike frames are apart.
    Otherwise, one after the other, that which adds most to the balanced accuracy.

    Args:
        failing, safe: (N, m) and (M, m), places as multiples of how far apart alike frames are.

    Raises:
        ConstraintError: no frame fails, or more than MOST fail and none is safe.
    """
    if not len(failing):
        raise ConstraintError("no frame is marked as failing; mark 1 to 5 on the page of latentsafe label")
    if not len(safe):
        if len(failing) > MOST:
            raise ConstraintError(
                f"{len(failing)} frames are marked as failing, and none as safe; expected 1 to {MOST}, or episodes "
                "that are labelled as a whole, which tell how far the failure reaches"
            )
        return [(where, 1.0) for where in failing]
    tried, reaches = _centres(failing), np.geomspace(*REACH, 65)
    inside = lambda rows: np.linalg.norm(rows[:, None] - tried, axis=-1)[..., None] <= reaches  # noqa: E731
    caught, wronged = inside(failing[:: -(-len(failing) // 2000)]), inside(safe[:: -(-len(safe) // 2000)])
    chosen: list[tuple[np.ndarray, float]] = []
    best = 0.0
    has, costs = np.zeros(len(caught), bool), np.zeros(len(wronged), bool)
    while len(chosen) < MOST:
        worth = (caught | has[:, None, None]).mean(0) - (wronged | costs[:, None, None]).mean(0)
        if worth.max() <= best + 0.01:
            break
        i, j = _middle(tried, reaches, worth == worth.max())
        best = worth[i, j]
        has, costs = has | caught[:, i, j], costs | wronged[:, i, j]
        chosen.append((tried[i], float(reaches[j])))
    if not chosen:
        raise ConstraintError(
            "the frames marked as failing lie among those marked as safe, in all numbers that say what is alike; "
            "train with other numbers: latentsafe train-reachability --alike=..."
        )
    return chosen


def _centres(failing: np.ndarray) -> np.ndarray:
    """Where a prototype may be: at some failing frames, and between them, as recordings may pass a failure by."""
    rng, at = np.random.default_rng(0), np.linspace(0, len(failing) - 1, min(len(failing), 100)).astype(int)
    share = rng.dirichlet(np.ones(4), 400)
    between = share[:, None] @ failing[rng.integers(len(failing), size=share.shape)]
    return np.concatenate([failing[at], between[:, 0]])


def _middle(centres: np.ndarray, reaches: np.ndarray, equal: np.ndarray) -> tuple[int, int]:
    """Of balls that tell frames apart equally well, bool (centres, reaches), the one most like all of them.

    Of those with its centre it is the one that reaches farthest: what is not known to be safe is forbidden.
    """
    i, j = np.nonzero(equal)
    away = np.linalg.norm(centres[i] - centres[i].mean(0), axis=-1) + np.abs(reaches[j] - reaches[j].mean())
    k = int(i[away.argmin()])
    return k, int(np.flatnonzero(equal[k])[-1])
