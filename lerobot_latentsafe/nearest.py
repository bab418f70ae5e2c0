"""Law `nearest`: in place of an action that does not pass, the nearest one to it that does.

Candidates are blends of the proposal with the fallback, the proposal with one command dropped or reversed, draws near
the proposal, and steps along the slope of V. All go through imagination in one batch, where the critic alone says
roughly how safe each is. The few that are near and seem safe are judged as any proposal is, and one of these is taken.
"""

from typing import NamedTuple

import numpy as np
import torch

from lerobot_latentsafe.decision import FilterDecision
from lerobot_latentsafe.host import all_of, on_host
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.limits import Limits
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.thinking import Hold, Thinking
from lerobot_latentsafe.units import Units

BLENDS = 8
DRAWS = 32
WIDEST = 1.0
"""Standard deviation of the widest draws, in standardised units."""
PROJECTIONS = (1.5,)
"""How far candidates go along the slope of V, in multiples of what would just pass if V were linear."""
SHORTLIST = 3
"""Candidates beside those that are judged as any proposal is."""


class Asked(NamedTuple):
    """Of R robots whose proposal did not pass.

    Attributes:
        latent: what is believed of each, (R, ...).
        proposed, fallback, hold: (R, A) in robot units.
        pose: (R, S), the state.
        before: (R, A) in robot units each, what was proposed before, the latest last.
        value: (R,), V of the proposals.
        threshold: (R,), what V must exceed.
        accepted: (R,), the candidate that was taken at the last tick; -1 where none was.
    """

    latent: Latent
    proposed: np.ndarray
    fallback: np.ndarray
    hold: np.ndarray
    pose: np.ndarray
    before: list[np.ndarray]
    value: np.ndarray
    threshold: np.ndarray
    accepted: np.ndarray


class Found(NamedTuple):
    """The nearest action of each robot that is found safe.

    Attributes:
        action: (R, A) in robot units; NaN where none was found.
        candidate: (R,), which one it is; -1 where none was found.
    """

    action: np.ndarray
    candidate: np.ndarray

    @classmethod
    def nothing(cls, n: int, size: int) -> "Found":
        """For n robots that take actions of this size."""
        return cls(np.full((n, size), np.nan, np.float32), np.full(n, -1))


class Distance:
    """How far actions are apart, in standardised units: half the range that the data show of each motion is 1.

    Commands that the data never vary do not count.
    """

    def __init__(self, units: Units):
        half = on_host(units.motion_high - units.motion_low) / 2
        varies = on_host(units.action_varies, torch.bool) & (half > 0)
        self.half_range = np.where(varies, half, np.inf).astype(np.float32)

    def __call__(self, action: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Of actions in robot units, (..., A) each, at the same state: (...,)."""
        return np.linalg.norm((action - other) / self.half_range, axis=-1)


class Candidates:
    """Actions beside proposals, always as many and in the same order. The first is the proposal itself.

    Args:
        seed: of the draws, which are the same at every tick: whoever decides again decides the same.
    """

    def __init__(self, units: Units, limits: Limits, seed: int = 0):
        self.distance, self.limits = Distance(units), limits
        varies = np.isfinite(self.distance.half_range)
        self.moves = varies & ~limits.frozen
        self.half_range = np.where(varies, self.distance.half_range, 0.0)
        wide = np.linspace(WIDEST / DRAWS, WIDEST, DRAWS)[:, None]
        draws = np.random.default_rng(seed).standard_normal((DRAWS, len(varies))) * wide
        self.offsets = (draws * self.half_range * self.moves).astype(np.float32)
        self.dropped = np.eye(len(varies), dtype=bool)[varies]
        self.reversed = np.eye(len(varies), dtype=bool)[self.moves]

    def beside(self, asked: Asked) -> np.ndarray:
        """Candidates (N, R, A) in robot units. To drop a command is to stay; switches and grips are never reversed."""
        proposed, hold = asked.proposed[None], asked.hold[None]
        share = (np.arange(1, BLENDS + 1, dtype=np.float32) / (BLENDS + 1))[:, None, None]
        blends = np.where(self.moves, proposed + share * (asked.fallback - proposed), proposed)
        dropped = np.where(self.dropped[:, None], hold, proposed)
        reverse = np.where(self.reversed[:, None], 2 * hold - proposed, proposed)
        return np.concatenate([proposed, blends, dropped, reverse, proposed + self.offsets[:, None]])

    def along(self, asked: Asked, candidates: np.ndarray, value: np.ndarray) -> np.ndarray:
        """Actions (P, R, A) along the slope of V, fitted to the values (N, R) of candidates (N, R, A)."""
        scale = np.where(self.moves, self.half_range, 1.0)
        known = np.isfinite(value) & np.isfinite(value[0])  # what is no number says nothing of the slope
        away = np.where(self.moves & known[..., None], (candidates - asked.proposed) / scale, 0.0)
        away, level = away.swapaxes(0, 1).astype(np.float64), np.where(known, value, 0.0)
        rise = np.where(known, level - level[0], 0.0).T[..., None]
        square = away.swapaxes(1, 2) @ away + 1e-6 * np.eye(away.shape[-1])
        slope = np.linalg.solve(square, away.swapaxes(1, 2) @ rise)[..., 0]
        lacks = (asked.threshold - asked.value)[:, None] / np.maximum((slope**2).sum(-1, keepdims=True), 1e-6)
        step = (np.where(np.isfinite(slope), slope, 0.0) * lacks * scale * self.moves).astype(np.float32)
        return asked.proposed + np.array(PROJECTIONS, np.float32)[:, None, None] * step

    def checked(self, asked: Asked, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Actions (N, R, A) clipped into the data's range, and which could have been proposed: bool (N, R).

        What is no number, or jumps, could not.
        """
        clipped, _ = self.limits.clip(actions, asked.pose)
        return clipped, all_of(np.isfinite(clipped)) & ~self.limits.leaps(clipped, asked.before)


class Nearest:
    """Looks for the nearest safe action.

    Args:
        model: a trained safety model, and by its configuration the law.

    Attributes:
        thinking: asks the model.
    """

    def __init__(self, model: SafetyModel):
        self.model, self.candidates = model, Candidates(model.units, model.limits)
        self.distance = self.candidates.distance
        n = 1 + BLENDS + len(self.candidates.dropped) + len(self.candidates.reversed) + DRAWS
        self.thinking = Thinking(model, [Hold(n, True), Hold(SHORTLIST + len(PROJECTIONS), False)])

    def find(self, asked: Asked) -> Found:
        """The nearest action that passes, judged as any proposal is."""
        kappa = self.model.config.law.kappa
        actions, sound = self.candidates.checked(asked, self.candidates.beside(asked))
        rough = self._value(asked, actions, roughly=True)
        more, sound_too = self.candidates.checked(asked, self.candidates.along(asked, actions, rough))
        away = self.distance(actions, asked.proposed)
        picked = shortlist(rough, away, sound, asked.threshold, kappa)
        rows = np.arange(picked.shape[1])
        actions = np.concatenate([actions[picked, rows], more])
        number = np.concatenate([picked, np.broadcast_to(-2 - np.arange(len(more))[:, None], more.shape[:2])])
        sound = np.concatenate([sound[picked, rows], sound_too])
        value = np.where(sound, self._value(asked, actions), np.nan)
        chosen = choose(value, self.distance(actions, asked.proposed), asked.threshold, kappa, number == asked.accepted)
        found = chosen >= 0
        return Found(
            np.where(found[:, None], actions[chosen, rows], np.nan).astype(np.float32),
            np.where(found, number[chosen, rows], -1),
        )

    def deviation(self, decision: FilterDecision) -> np.ndarray:
        """How far what is executed is from what was proposed, in standardised units: (B,); NaN of no proposal."""
        return self.distance(on_host(decision.action), on_host(decision.proposed))

    def _value(self, asked: Asked, actions: np.ndarray, roughly: bool = False) -> np.ndarray:
        """V of actions (N, R, A) in robot units: (N, R); what is no number is not asked about."""
        model, (n, rows, size) = self.model, actions.shape
        known = np.where(np.isfinite(actions), actions, asked.hold).reshape(n * rows, size)
        at = model.tensor(np.tile(asked.pose, (n, 1))) if model.units.has_targets else None
        heard = model.units.heard_action(model.tensor(known), at).nan_to_num(0.0)
        return on_host(self.thinking.hold(asked.latent, heard, roughly)).reshape(n, rows)


def shortlist(
    value: np.ndarray, away: np.ndarray, sound: np.ndarray, threshold: np.ndarray, kappa: float
) -> np.ndarray:
    """The candidates to judge (SHORTLIST, R): the one that seems safest, and the nearest that seem safe enough.

    Args:
        value, away: (N, R), what is roughly known of V, and the distance to the proposal.
        sound: bool (N, R), those that could have been proposed.
        threshold: (R,).
    """
    value = np.where(sound & np.isfinite(value), value, -np.inf)
    seems_safe = (value > threshold) & (value >= value.max(0) - kappa)
    nearest = np.argsort(np.where(seems_safe, away, np.inf), axis=0, kind="stable")[: SHORTLIST - 1]
    return np.concatenate([value.argmax(0)[None], nearest])


def choose(value: np.ndarray, away: np.ndarray, threshold: np.ndarray, kappa: float, last: np.ndarray) -> np.ndarray:
    """Of candidates (N, R) the nearest with V above the threshold (R,) and within kappa of the best; -1: none (R,).

    Args:
        last: bool (N, R), the one that was taken at the last tick, which is taken again where two are as near.
    """
    value = np.where(np.isfinite(value), value, -np.inf)
    passes = (value > threshold) & (value >= value.max(0) - kappa)
    nearest = np.where(passes, away - np.where(last, 1e-6, 0.0), np.inf).argmin(0)
    return np.where(passes.any(0), nearest, -1)
