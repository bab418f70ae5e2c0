"""Does a calibrated filter miss as rarely as is stated? Held-out episodes, drawn into calibration and test many times.

Of n failing episodes epsilon is chosen, and on the others it is counted what is missed. Over calibrations the share
missed should be 1 - k / (n + 1) <= alpha on average, follow Beta(n + 1 - k, k), and exceed the stated 95% bound in at
most 5%. On the car, whose safe set is known exactly, misses are counted by state and by episode, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.stats import betabinom

from lerobot_latentsafe.calibration import Scores, calibrate
from lerobot_latentsafe.collection.dubins import Episode, goal_episodes, random_episodes, reckless_driver
from lerobot_latentsafe.conformal import CONFIDENCE, at_most, needed, rank
from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.datasets.folder import load_metadata
from lerobot_latentsafe.datasets.frame_cache import FrameCache
from lerobot_latentsafe.datasets.labels import FailureLabels
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.dubins.ground_truth import exact_value
from lerobot_latentsafe.evaluation.decision_values import EpisodeDecisions, decision_values
from lerobot_latentsafe.evaluation.statistics import provenance, wilson, write_json
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.reports.figures import save
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.training import load_with_cache

ALPHA, LEAD_STEPS, RESAMPLINGS, SEED = 0.05, 3, 1000, 2000
CAR_EPISODES = 600


@dataclass(frozen=True)
class Resampled:
    """Shares missed over resamplings.

    The stated bound is of all episodes there could be; of finitely many that are tested chance takes a share beyond it
    a little more often, by the beta-binomial distribution, whose own 95th percentile stands beside it.

    Attributes:
        n, k, n_test: failing episodes that epsilon is chosen on, the rank, and those that are tested.
        missed: (R,), share missed of the tested.
        before: (R,), the same of the rule of earlier versions, which let floor(alpha n) of the n be missed.
    """

    n: int
    k: int
    n_test: int
    missed: np.ndarray
    before: np.ndarray

    def row(self) -> dict:
        """The numbers."""
        bound = at_most(self.n - self.k, self.n)
        expected = betabinom(self.n_test, self.n + 1 - self.k, self.k)
        return {
            "n": self.n,
            "k": self.k,
            "n_test": self.n_test,
            "resamplings": len(self.missed),
            "missed_mean": float(self.missed.mean()),
            "missed_mean_expected": 1 - self.k / (self.n + 1),
            "missed_at_most": bound,
            "over_the_bound": float((self.missed > bound + 1e-9).mean()),
            "over_the_bound_expected": float(expected.sf(np.floor(bound * self.n_test + 1e-9))),
            "of_tested_at_most": float(expected.ppf(CONFIDENCE) / self.n_test),
            "over_that": float((self.missed > expected.ppf(CONFIDENCE) / self.n_test + 1e-9).mean()),
            "missed_quantiles": np.quantile(self.missed, [0.05, 0.5, 0.95]).tolist(),
            "missed_quantiles_expected": (expected.ppf([0.05, 0.5, 0.95]) / self.n_test).tolist(),
            "before": {
                "missed_mean": float(self.before.mean()),
                "over_alpha": float((self.before > ALPHA + 1e-9).mean()),
            },
        }


def resampled(scores: np.ndarray, alpha: float, n: int, rng: np.random.Generator, times: int) -> Resampled:
    """Choose epsilon on n of the scores (N,), count what is missed of the others, and again."""
    missed, before, k = [], [], rank(n, alpha)
    for _ in range(times):
        drawn = rng.permutation(scores)
        chosen, rest = np.sort(drawn[:n]), drawn[n:]
        missed.append((rest > chosen[k - 1]).mean())
        before.append((rest > chosen[n - 1 - int(alpha * n)]).mean())
    return Resampled(n, k, len(scores) - n, np.array(missed), np.array(before))


# -- the car, whose safe set is known ---


def car_reader(model: SafetyModel, episodes: Sequence[Episode]) -> ClipReader:
    """Episodes of the car as a dataset and its cache, in memory."""
    states = np.concatenate([episode.states for episode in episodes])
    turn_rates = np.concatenate([episode.turn_rates for episode in episodes])
    number = np.repeat(np.arange(len(episodes)), [len(episode.states) for episode in episodes])
    renderer, (key,) = car.Renderer(), model.world_model.image_keys
    pictures, heading = [], []
    for part in np.array_split(states, -(-len(states) // 512)):
        seen = car.observe(part, renderer)
        pictures.append(model.images(torch.from_numpy(seen["image"]).permute(0, 3, 1, 2)))
        heading.append(seen["heading"])
    failing = (car.margin(states) < 0).astype(np.int8)
    labels = FailureLabels(failing, np.full_like(failing, -1), number)
    action = np.stack([turn_rates, np.full_like(turn_rates, car.SPEED)], -1).astype(np.float32)
    cache = FrameCache({key: torch.cat(pictures)}, {}, np.concatenate(heading), action, {})
    sizes = model.config.world_model
    return ClipReader(labels, cache, sizes.clip_length, model.units, sizes.frame_skip)


def judged(model: SafetyModel, episodes: Sequence[Episode]) -> list[EpisodeDecisions]:
    """What the filter would have decided by along them."""
    return decision_values(model, car_reader(model, episodes), np.arange(len(episodes)))


def against_the_truth(rows: list[EpisodeDecisions], episodes: Sequence[Episode], epsilon: float) -> dict:
    """Misses of an epsilon by state and by episode, where nothing but the exact value says what was dangerous.

    A state is dangerous if no steering keeps the car safe after the action that was taken there. An episode is missed
    if nothing was said until the last state from which the car could still be kept safe.
    """
    missed = dangerous = alarms = harmless = late = doomed = 0
    for row, episode in zip(rows, episodes):
        value, turn_rates = exact_value(episode.states), episode.turn_rates
        after = exact_value(car.step(episode.states, turn_rates))
        alive, warned = value > 0, row.value <= epsilon
        unsafe = alive & (after <= 0)
        missed, dangerous = missed + (unsafe & ~warned).sum(), dangerous + unsafe.sum()
        alarms, harmless = alarms + (alive & ~unsafe & warned).sum(), harmless + (alive & ~unsafe).sum()
        if unsafe.any() and alive[0]:
            doomed, late = doomed + 1, late + (not warned[: np.flatnonzero(unsafe)[0] + 1].any())
    return {
        "states_missed": wilson(missed, dangerous),
        "states_false_alarms": wilson(alarms, harmless),
        "episodes_missed": wilson(late, doomed),
    }


def until_the_last_chance(rows: list[EpisodeDecisions], episodes: Sequence[Episode]) -> dict[int, float]:
    """Episode -> its lowest V until the last state from which steering could have kept the car safe."""
    lowest = {}
    for row, episode in zip(rows, episodes):
        value, after = exact_value(episode.states), exact_value(car.step(episode.states, episode.turn_rates))
        unsafe = np.flatnonzero((value > 0) & (after <= 0))
        if len(unsafe) and value[0] > 0:
            lowest[row.episode] = float(row.value[: unsafe[0] + 1].min())
    return lowest


def study_car(path: str = "dubins", n_episodes: int = CAR_EPISODES) -> dict[str, tuple[dict, Resampled]]:
    """The committed filter of the car on random driving of new seeds; and what it then misses of another policy's.

    Once epsilon is chosen for a warning so many steps before a failure, as on any robot; and once, as the truth is
    known, for a warning while the car can still be kept safe.
    """
    model, rng = load_filter(path).model, np.random.default_rng
    random = list(random_episodes(n_episodes, rng(SEED), car.TURN_RATES))
    reckless = list(goal_episodes(n_episodes // 4, rng(SEED + 1), reckless_driver))
    rows, others = judged(model, random), judged(model, reckless)
    by_lead, theirs = (Scores.of(some, LEAD_STEPS) for some in (rows, others))
    studies = {
        "car": (by_lead, theirs.failing),
        "car, last chance": (
            Scores(until_the_last_chance(rows, random), by_lead.safe),
            until_the_last_chance(others, reckless),
        ),
    }
    found = {}
    for name, (scores, of_others) in studies.items():
        lowest = np.array([*scores.failing.values()])
        shares = resampled(lowest, ALPHA, len(lowest) // 3, rng(SEED), RESAMPLINGS)
        chosen = calibrate(scores, ALPHA, LEAD_STEPS, car.FPS)
        missed = sum(score > chosen.epsilon for score in of_others.values())
        row = {
            "alpha": ALPHA,
            **shares.row(),
            "calibration": chosen.as_json(),
            "truth": against_the_truth(rows, random, chosen.epsilon),
            "another_policy": {
                "missed": wilson(missed, len(of_others)),
                "truth": against_the_truth(others, reckless, chosen.epsilon),
            },
            "scores": lowest.tolist(),
        }
        found[name] = row, shares
    return found


# -- recordings ---


def study_recordings(path: str, roots: Sequence[str], lead_steps: int) -> tuple[dict, Resampled]:
    """A filter on held-out recordings: cached datasets with labels.

    Raises:
        ValueError: too few failing episodes to choose on some and count on others.
    """
    lowest: list[float] = []
    quiet: list[float] = []
    for root in roots:
        policy, reader = load_with_cache(path, load_metadata(f"local/{Path(root).name}", Path(root)))
        scores = Scores.of(decision_values(policy.model, reader, np.unique(reader.labels.episode)), lead_steps)
        lowest += scores.failing.values()
        quiet += scores.safe.values()
    alpha = next((a for a in (ALPHA, 0.1, 0.2) if 2 * needed(a) <= len(lowest)), None)
    if alpha is None:
        raise ValueError(f"--data holds {len(lowest)} failing episodes; expected at least {2 * needed(0.2)}")
    n = max(needed(alpha), len(lowest) // 2)
    found = resampled(np.array(lowest), alpha, n, np.random.default_rng(SEED), RESAMPLINGS)
    both = Scores(dict(enumerate(lowest)), dict(enumerate(quiet)))
    chosen = calibrate(both, alpha, lead_steps, policy.config.trained_on.fps)
    row = {"alpha": alpha, **found.row(), "calibration": chosen.as_json(), "scores": lowest}
    return row, found


# -- files ---


def draw(studies: dict[str, Resampled]) -> Figure:
    """How often each share was missed, and how often it should be; dashed: the stated bound."""
    figure, axes = plt.subplots(1, len(studies), figsize=(5.2 * len(studies), 3.6), squeeze=False)
    for ax, (name, found) in zip(axes[0], studies.items()):
        row, counts = found.row(), np.arange(found.n_test + 1)
        often = np.bincount(np.round(found.missed * found.n_test).astype(int), minlength=len(counts))
        expected = betabinom(found.n_test, found.n + 1 - found.k, found.k).pmf(counts)
        shown = counts <= max(often.nonzero()[0][-1], 0.15 * found.n_test)
        shares = 100 * counts[shown] / found.n_test
        ax.bar(shares, 100 * often[shown] / often.sum(), 90 / found.n_test, color="tab:blue", alpha=0.5)
        ax.plot(
            shares, 100 * expected[shown], "k.-", lw=0.8, ms=4, label=f"by Beta({found.n + 1 - found.k}, {found.k})"
        )
        ax.axvline(100 * row["missed_mean"], color="tab:blue", lw=1, label=f"mean {row['missed_mean']:.1%}")
        ax.axvline(
            100 * row["missed_at_most"], color="tab:red", ls="--", lw=1,
            label=f"stated bound {row['missed_at_most']:.1%}: over it {row['over_the_bound']:.1%}"
            f"\n({row['over_the_bound_expected']:.1%} expected of {found.n_test} tested)",
        )  # fmt: skip
        ax.set(
            title=f"{name}: epsilon by n = {found.n}", xlabel="failing episodes missed (%)", ylabel="resamplings (%)"
        )
        ax.legend(fontsize=8)
    figure.tight_layout()
    return figure


def write_calibration_study(
    output: Path, bag: str | None = None, data: Sequence[str] = (), lead_steps: int = LEAD_STEPS
) -> None:
    """Write calibration.json, with a summary, and calibration.png beside it.

    Args:
        bag: a filter of the bag, with held-out recordings of it, cached.
    """
    studies = study_car()
    if bag:
        studies["bag"] = study_recordings(bag, data, lead_steps)
    rows = {name: row for name, (row, _) in studies.items()}
    told = (
        "alpha", "n", "k", "n_test", "missed_mean", "missed_at_most", "over_the_bound", "over_the_bound_expected",
        "over_that", "before",
    )  # fmt: skip
    summary = {name: {key: row[key] for key in told} for name, row in rows.items()}
    for name, row in rows.items():
        truth = {what: rate["k"] / rate["n"] for what, rate in row.get("truth", {}).items()}
        summary[name] |= {"epsilon": row["calibration"]["epsilon"], **truth}
        print(name, ", ".join(f"{key} {n:.4g}" for key, n in summary[name].items() if not isinstance(n, dict)))
    write_json(output, {"summary": summary, **rows, **provenance(seeds=[SEED, SEED + 1])})
    save(draw({name: shares for name, (_, shares) in studies.items()}), output.with_suffix(".png"))
