"""Choosing epsilon on held-out episodes, and keeping the evidence beside it.

On a recorded episode that ends in failure, a monitor with threshold epsilon warns at the first frame with
V <= epsilon. Too small an epsilon warns late or never; too large a one cries wolf on episodes that never fail.
"""

from dataclasses import asdict, dataclass, replace

import numpy as np
import torch

from lerobot_latentsafe.configuration_latentsafe import LatentSafeConfig
from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.datasets.labels import FAILING
from lerobot_latentsafe.latent import map_latent
from lerobot_latentsafe.runtime.options import require_at_least
from lerobot_latentsafe.safety_model import SafetyModel


@dataclass
class Calibration:
    """The chosen epsilon and what it was chosen on.

    Attributes:
        epsilon: the threshold.
        missed: share of failing episodes without a warning at least `lead_steps` frames before the failure.
        false_alarms: share of frames of episodes that never fail with V <= epsilon.
        lead_steps: frames of warning asked for.
        failing_episodes, safe_frames: how much evidence there was.
    """

    epsilon: float
    missed: float
    false_alarms: float
    lead_steps: int
    failing_episodes: int
    safe_frames: int


@torch.no_grad()
def episode_values(model: SafetyModel, reader: ClipReader, episodes: np.ndarray) -> list[dict[str, np.ndarray]]:
    """V and labels along whole episodes, filtered from their first frame: {value (T,), failure (T,)} each."""
    rows = []
    for episode in episodes:
        index = np.flatnonzero(reader.labels.episode == episode)
        # A clip from each of the first frames on, where a world model sees every so many.
        clip = reader.cut(index[: reader.skip], model.world_model, length=-(-len(index) // reader.skip))
        latent = map_latent(model.world_model.encode(clip), lambda t: t.transpose(0, 1).flatten(0, 1))  # in order again
        value = model.value(latent)[: len(index)].cpu().numpy()
        rows.append({"value": value, "failure": reader.labels.failure[index]})
    return rows


def calibrate(rows: list[dict[str, np.ndarray]], max_missed: float = 0.05, lead_steps: int = 3) -> Calibration:
    """The smallest epsilon that warns in time on all but `max_missed` of the failing episodes.

    Args:
        rows: per episode V and labels; only episodes that are safe for their first `lead_steps` frames can be
            warned about and count.

    Raises:
        ValueError: no failing or no safe episode among them, V that is not finite, or options that mean nothing.
    """
    check_options(max_missed, lead_steps)
    _require_finite(rows)
    best_before, safe = [], []
    for row in rows:
        failing = np.flatnonzero(row["failure"] == FAILING)
        if not len(failing):
            safe.append(row["value"])
        elif failing[0] > lead_steps:
            # epsilon must reach the lowest value seen early enough.
            best_before.append(row["value"][: failing[0] - lead_steps + 1].min())
    if not best_before or not safe:
        raise ValueError(
            f"{len(rows)} held-out episodes hold {len(best_before)} that fail after step {lead_steps} and {len(safe)} "
            "that never fail; calibration needs both. Hold out more episodes (--n_episodes)"
        )
    reached = np.sort(best_before)
    allowed = int(np.floor(max_missed * len(reached)))
    epsilon = float(max(0.0, reached[len(reached) - 1 - allowed]))
    quiet = np.concatenate(safe)
    return Calibration(
        epsilon=epsilon,
        missed=float((reached > epsilon).mean()),
        false_alarms=float((quiet <= epsilon).mean()),
        lead_steps=lead_steps,
        failing_episodes=len(reached),
        safe_frames=len(quiet),
    )


def check_options(max_missed: float, lead_steps: int) -> None:
    """Refuse a share that is none or all, and a warning that comes with the failure or after it.

    Raises:
        ValueError: naming the option.
    """
    if not 0 <= max_missed < 1:
        raise ValueError(f"--max_missed is {max_missed}; expected a share from 0 to below 1")
    require_at_least("--lead_steps", lead_steps, 1)


def _require_finite(rows: list[dict[str, np.ndarray]]) -> None:
    """Refuse to count as a warning, or as none, what says nothing."""
    broken = [row for row in rows if not np.isfinite(row["value"]).all()]
    if broken:
        raise ValueError(
            f"V is not finite in {len(broken)} of {len(rows)} held-out episodes, so nothing tells when this filter "
            "warns; check the data with latentsafe check-dataset, and train the filter again"
        )


def store(config: LatentSafeConfig, calibration: Calibration) -> None:
    """Set the threshold of a filter, and keep the evidence beside it."""
    evidence = {k: float(v) for k, v in asdict(calibration).items()}
    config.change(law=replace(config.law, epsilon=calibration.epsilon), calibration=evidence)
