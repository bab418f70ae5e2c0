"""Choosing epsilon on held-out episodes: how often a filter misses, on what evidence, and what that belongs to.

The filter acts where V <= epsilon. The score s_i of an episode that fails is the lowest V that it would have decided by
until `lead_steps` before the failure: the episode is missed if s_i > epsilon. Split conformal prediction takes

    epsilon = s_(k), the k-th smallest of n scores,   k = ceil((n + 1) (1 - alpha)).

What that promises is in `conformal.py`.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

import numpy as np

from lerobot_latentsafe.conformal import allowed, at_most, needed, needed_for_sure, rank, weighted_quantile
from lerobot_latentsafe.datasets.labels import FAILING, SAFE
from lerobot_latentsafe.decision import LawConfig
from lerobot_latentsafe.runtime.options import require_at_least

ALL = "all episodes"
"""The group of all episodes."""
DECIDING = (
    "name", "epsilon", "resume_above", "proposal_steps", "lookahead", "samples", "history_frames", "retreat",
    "retreat_after", "min_retreat_steps", "max_retreat_steps",
)  # fmt: skip
"""What of a law changes V or the decision; the rest says what is in time, and whether it acts."""
OF_NEAREST = ("kappa", "replan_above")
"""What of the law `nearest` does so, too."""
MORE = "hold out more episodes (--dataset.episodes, --n_episodes)"


# -- episodes ---


class JudgedEpisode(Protocol):
    """What a filter would have decided by along an episode; see `evaluation.decision_values`."""

    @property
    def episode(self) -> int:
        """Its number."""

    @property
    def value(self) -> np.ndarray:
        """V (T,)."""

    @property
    def failure(self) -> np.ndarray:
        """Labels (T,)."""


@dataclass(frozen=True)
class Scores:
    """What held-out episodes say of a threshold; an episode counts once.

    Attributes:
        failing: episode -> its lowest V until the lead before its failure; it is missed where that is above epsilon.
        safe: episode that never fails -> its lowest V; it is a false alarm where that is not above epsilon.
        too_early: episodes that fail before the lead has passed: nothing can warn of them in time.
        unlabelled: episodes that show no failure, and of which not all frames are labelled: nobody knows.
    """

    failing: dict[int, float]
    safe: dict[int, float]
    too_early: int = 0
    unlabelled: int = 0

    @classmethod
    def of(cls, rows: Sequence[JudgedEpisode], lead_steps: int) -> "Scores":
        """Raises ValueError where V is not finite: that is no warning, and no silence."""
        broken = sum(not np.isfinite(row.value).all() for row in rows)
        if broken:
            raise ValueError(
                f"V is not finite in {broken} of {len(rows)} held-out episodes, so nothing tells when this filter "
                "warns; check the data with latentsafe check-dataset, and train the filter again"
            )
        failing, safe, too_early, unlabelled = {}, {}, 0, 0
        for row in rows:
            failures = np.flatnonzero(row.failure == FAILING)
            if not len(failures):
                if (row.failure == SAFE).all():
                    safe[row.episode] = float(row.value.min())
                else:
                    unlabelled += 1
            elif failures[0] < lead_steps:
                too_early += 1
            else:
                failing[row.episode] = float(row.value[: failures[0] - lead_steps + 1].min())
        return cls(failing, safe, too_early, unlabelled)

    def require_both(self, lead_steps: int) -> None:
        """Raise ValueError unless there are failing episodes that can be warned of, and safe ones."""
        if not self.failing or not self.safe:
            raise ValueError(
                f"the held-out episodes hold {len(self.failing)} that fail after step {lead_steps} and "
                f"{len(self.safe)} that never fail ({self.too_early} fail sooner, {self.unlabelled} are not labelled "
                f"to the end); calibration needs both: {MORE}"
            )


# -- the choice ---


@dataclass(frozen=True)
class Statement:
    """What n failing episodes say of an epsilon.

    Attributes:
        n, k: episodes, and the rank of the one whose score suffices; of weighted ones there is no k.
        quantile: that score.
        missed: episodes whose score is above epsilon.
        missed_at_most: 95% bound of the share missed; None of weighted episodes, for which none is known.
        sure_epsilon: by which at most alpha would be missed with 95% confidence; None: that takes more episodes.
    """

    n: int
    k: int | None
    quantile: float
    missed: int
    missed_at_most: float | None
    sure_epsilon: float | None


@dataclass(frozen=True)
class Calibration:
    """A chosen epsilon, and all that it was chosen on. It is JSON, and stands in the filter's configuration.

    Attributes:
        epsilon: of the open loop: where the filter warns in time.
        alpha: share of failing episodes that may be missed.
        lead_steps, lead_s: warning asked for before the failure.
        groups: by name; `ALL` is all episodes.
        safe_episodes, false_alarms, false_alarms_at_most: episodes that never fail, those with V <= epsilon, and the
            95% bound of their share.
        too_early, unlabelled: see `Scores`.
        weighted: whether episodes were weighted by a likelihood ratio.
        closed_loop: what running the shielded policy said, where that was asked; see `fixed_sequence`.
        trained_on_known: whether it is known that none of these episodes was trained on.
        belongs_to: see `belonging`.
    """

    epsilon: float
    alpha: float
    lead_steps: int
    lead_s: float
    groups: dict[str, Statement]
    safe_episodes: int
    false_alarms: int
    false_alarms_at_most: float
    too_early: int = 0
    unlabelled: int = 0
    weighted: bool = False
    closed_loop: dict[str, Any] | None = None
    trained_on_known: bool = False
    belongs_to: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def read(cls, evidence: dict[str, Any]) -> "Calibration | None":
        """What stands in a configuration; None where that was edited, or is of an earlier version."""
        try:
            groups = {name: Statement(**group) for name, group in evidence["groups"].items()}
            found = cls(**{**evidence, "groups": groups})
            in_words(found)
            shares = [found.alpha, found.false_alarms_at_most]
            shares += [group.missed_at_most for group in groups.values() if group.missed_at_most is not None]
            counted = all(0 <= group.missed <= group.n for group in groups.values())
            counted &= 0 <= found.false_alarms <= found.safe_episodes
            return found if counted and all(0 <= share <= 1 for share in shares) else None
        except (KeyError, TypeError, ValueError, AttributeError, StopIteration):
            return None

    def as_json(self) -> dict[str, Any]:
        """The same as plain numbers, words, lists and objects."""
        return asdict(self)


def check_options(alpha: float, lead_steps: int, max_false_alarms: float | None = None) -> None:
    """Refuse shares that are none or all, and a warning that comes with the failure or after it.

    Raises:
        ValueError: naming the option.
    """
    for option, share in (("--alpha", alpha), ("--max_false_alarms", max_false_alarms)):
        if share is not None and not 0 < share < 1:
            raise ValueError(f"{option} is {share}; expected a share above 0 and below 1, such as 0.05")
    require_at_least("--lead_steps", lead_steps, 1)


def calibrate(
    scores: Scores, alpha: float, lead_steps: int, fps: float, *, floor: float = 0.0,
    groups: dict[str, list[int]] | None = None, weights: dict[int, float] | None = None,
) -> Calibration:  # fmt: skip
    """The smallest epsilon by which at most a share alpha of failing episodes is missed.

    Args:
        fps: ticks a second.
        floor: epsilon is no lower. V <= 0 says that nothing keeps the robot safe any more, by the filter's own account:
            such an action must not pass, even where a lower epsilon would miss few enough. A risk, whose V is -risk,
            has no such number: -1.
        groups: name -> episodes. Each group is asked for alpha, and epsilon is the largest of theirs.
        weights: episode -> likelihood ratio of where the filter is to be used and of these recordings
            (Tibshirani et al., 2019). The next episode is taken to be as heavy as the heaviest of these.

    Raises:
        ValueError: no failing or no safe episode, too few of them for alpha, or groups and weights at once.
    """
    check_options(alpha, lead_steps)
    scores.require_both(lead_steps)
    if groups and weights:
        raise ValueError("--by and --weights are given; a group has no weights: give one of them")
    apart = {ALL: [*scores.failing]} | {name: [e for e in some if e in scores.failing] for name, some in
                                        (groups or {}).items()}  # fmt: skip
    values = {name: np.array([scores.failing[e] for e in some]) for name, some in apart.items()}
    for name, own in reversed(values.items()):  # a group's want is the more telling
        _require_enough(name, len(own), alpha)
    if weights is None:
        quantiles = {name: float(np.sort(own)[rank(len(own), alpha) - 1]) for name, own in values.items()}
    else:
        quantiles = {ALL: weighted_quantile(values[ALL], np.array([weights[e] for e in apart[ALL]]), alpha)}
    epsilon = max(floor, *quantiles.values())
    alarms = sum(lowest <= epsilon for lowest in scores.safe.values())
    return Calibration(
        epsilon, alpha, lead_steps, lead_steps / fps,
        {name: _statement(own, alpha, quantiles[name], epsilon, weights is None) for name, own in values.items()},
        len(scores.safe), alarms, at_most(alarms, len(scores.safe)), scores.too_early, scores.unlabelled,
        weights is not None,
    )  # fmt: skip


def _require_enough(group: str, n: int, alpha: float) -> None:
    if rank(n, alpha) > n:
        of = "" if group == ALL else f" of the group {group!r}"
        more = f", or ask for --alpha={math.ceil(1000 / (n + 1)) / 1000:g}" if n else ""
        raise ValueError(
            f"--alpha={alpha:g} takes {needed(alpha)} failing held-out episodes{of}, and there are {n} that can be "
            f"warned of in time; {MORE}{more}"
        )


def _statement(values: np.ndarray, alpha: float, quantile: float, epsilon: float, exchangeable: bool) -> Statement:
    n, missed = len(values), int((values > epsilon).sum())
    if not exchangeable:
        return Statement(n, None, quantile, missed, None, None)
    k, few = rank(n, alpha), allowed(n, alpha)
    # Ties, a floor and other groups only take misses away: n - k is the count that was fixed before anything was seen.
    sure = None if few is None else float(np.sort(values)[n - 1 - few])
    return Statement(n, k, quantile, missed, at_most(n - k, n), sure)


def curve(scores: Scores) -> list[dict[str, float]]:
    """Every epsilon at which anything changes, with the shares of misses and of false alarms and their 95% bounds."""
    failing, safe = (np.array([*numbers.values()]) for numbers in (scores.failing, scores.safe))
    rows = []
    for epsilon in np.unique(np.concatenate([failing, safe, [0.0]])):
        missed, alarms = int((failing > epsilon).sum()), int((safe <= epsilon).sum())
        rows.append(
            {
                "epsilon": float(epsilon),
                "missed": missed / len(failing),
                "missed_at_most": at_most(missed, len(failing)),
                "false_alarms": alarms / len(safe),
                "false_alarms_at_most": at_most(alarms, len(safe)),
            }
        )
    return rows


def require_few_alarms(found: Calibration, scores: Scores, share: float) -> None:
    """Refuse an epsilon by which more than a share of the safe episodes may be overridden, by its 95% bound.

    Raises:
        ValueError: with both numbers, and what would keep to the share.
    """
    if found.false_alarms_at_most <= share:
        return
    what = (
        f"misses and false alarms cannot both be kept: epsilon = {found.epsilon:.4g} misses at most {found.alpha:.1%}, "
        f"and it overrides {found.false_alarms} of {found.safe_episodes} safe episodes, up to "
        f"{found.false_alarms_at_most:.1%} with 95% confidence; --max_false_alarms is {share:g}"
    )
    if allowed(found.safe_episodes, share) is None:
        raise ValueError(f"{what}. That takes {needed_for_sure(share)} safe episodes without any override; {MORE}")
    kept = [row for row in curve(scores) if row["false_alarms_at_most"] <= share]
    instead = f"epsilon = {kept[-1]['epsilon']:.4g} keeps to that and misses {kept[-1]['missed']:.1%}" if kept else (
        "no epsilon of these keeps to that")  # fmt: skip
    raise ValueError(f"{what}. {instead}. Ask for less of one, or train a better filter; --json and --figure show both")


# -- what it belongs to ---


def belonging(
    law: LawConfig, weights: str, base_policy: str | None, name: str | None = None, constraints: dict | None = None
) -> dict[str, Any]:
    """What a calibration is of: the law, the weights and the policy that is shielded.

    Args:
        weights, base_policy: digests; see `runtime.checkpoint.weights_digest`. None: no policy was named.
        name: of the base policy, for people.
        constraints: those that count -> their prototypes, of a filter that takes some.
    """
    decides = {key: getattr(law, key) for key in (*DECIDING, *(OF_NEAREST if law.name == "nearest" else ()))}
    if constraints:
        decides["constraints"] = constraints
    return {"law": decides, "weights": weights, "base_policy": base_policy, "base_policy_name": name}


def differences(evidence: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """In words, why evidence does not speak of a filter as it is now; empty where it does, or where there is none."""
    if not evidence:
        return []
    found = Calibration.read(evidence)
    if found is None:
        return ["its evidence is not whole, or of an earlier version, which promised nothing"]
    then, reasons = found.belongs_to, []
    law = {key: (then.get("law", {}).get(key), value) for key, value in now["law"].items()}
    changed = [f"{key} is {value!r}, was {before!r}" for key, (before, value) in law.items() if before != value]
    if changed:
        reasons.append(f"calibrated for another law: {', '.join(changed)}")
    if then.get("weights") != now["weights"]:
        reasons.append("calibrated for other weights of world model, margin or critic")
    if then.get("base_policy") != now["base_policy"]:
        names = (
            source["base_policy_name"] if source.get("base_policy") else "no named policy" for source in (now, then)
        )
        reasons.append("calibrated for another base policy: this is {}, that was {}".format(*names))
    return reasons


# -- in words ---


def in_words(found: Calibration) -> str:
    """How often the filter misses and cries wolf, and on what evidence: one paragraph for the card and the report."""
    trained = "None of these was trained on." if found.trained_on_known else "Whether these were trained on is unknown."
    said = [
        *([_closed_loop(found.closed_loop)] if found.closed_loop else []),
        *_misses(found),
        f"It overrides {found.false_alarms} of {found.safe_episodes} held-out episodes that never fail, at most "
        f"{found.false_alarms_at_most:.1%} with 95% confidence.",
        trained,
        "All of it holds for episodes like these only: of the same policy, robot and scene.",
    ]
    return " ".join(said)


def _misses(found: Calibration) -> Iterator[str]:
    everyone = found.groups[ALL]
    which = "a weighted quantile" if found.weighted else f"number k = {everyone.k}"
    yield (
        f"Of failing episodes it misses at most {found.alpha:.1%} (alpha), on average over calibrations: epsilon = "
        f"{found.epsilon:.4g} was chosen on n = {everyone.n} failing episodes held out, by {which} of their lowest "
        f"values until {found.lead_s:.2g} s ({found.lead_steps} steps) before the failure; {everyone.missed} of them "
        "were missed."
    )
    if len(found.groups) == 1 and everyone.quantile < found.epsilon:
        yield f"{everyone.quantile:.4g} would have sufficed; epsilon is not put below {found.epsilon:g}."
    if everyone.missed_at_most is not None:
        yield f"With 95% confidence it misses at most {everyone.missed_at_most:.1%} of such episodes."
        if everyone.missed_at_most > found.alpha:
            yield (
                f"{found.alpha:.1%} with that confidence takes {needed_for_sure(found.alpha)} failing episodes or more."
                if everyone.sure_epsilon is None
                else f"{found.alpha:.1%} with that confidence takes epsilon = {everyone.sure_epsilon:.4g}."
            )
    for name, one in found.groups.items():
        if name != ALL:
            yield f"Of {name}: k = {one.k} of n = {one.n}, {one.missed} missed, at most {one.missed_at_most:.1%}."
    if found.too_early:
        yield f"{found.too_early} more failed too soon after their start to be warned of in time."


def _closed_loop(tested: dict[str, Any]) -> str:
    last = next(test for test in tested["tests"] if test["epsilon"] == tested["epsilon"])
    return (
        f"In closed loop the shielded policy fails in at most {tested['alpha']:.1%} of the episodes with 95% "
        f"confidence: at epsilon = {last['epsilon']:.4g}, which is set, {last['failures']} of {last['n']} runs failed "
        "(tests in a fixed sequence). The open loop, which asks for warnings alone:"
    )
