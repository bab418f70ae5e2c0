"""No change of the code's structure may change a decision: every committed filter decides as it did, to 1e-5.

tests/data/decisions.npz holds two short episodes of each committed filter (what it was shown and what was proposed),
and the decisions on each step under a few laws, modes and injected faults. `record_decisions.py` made it.
"""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.modeling_latentsafe import load_filter

FILE = Path(__file__).parent / "data" / "decisions.npz"
FILTERS = ("dubins", "bag", "blocks")
VARIANTS = {
    "committed": {},
    "faults": {},
    "monitor": {"mode": "monitor"},
    "critic_alone": {"lookahead": 0, "proposal_steps": 1},
    "look_ahead": {"lookahead": 8, "proposal_steps": 2, "epsilon": 0.3, "resume_above": 0.6},
    "plan": {"name": "plan", "lookahead": 10},
    "margin": {"name": "margin"},
    "short_history": {"history_frames": 6},
    "samples": {"samples": 3, "proposal_steps": 2, "lookahead": 4},
}
"""Changes of the filter's law; "faults" breaks what it is shown instead."""
OUTCOMES = ("action", "value", "margin", "reason", "intervened")


def break_something(t: int, batch: dict, proposed: torch.Tensor) -> tuple[dict, torch.Tensor | None, float]:
    """One fault a step, on the first of the two robots where a fault has a row, and a few steps without."""
    batch, proposed, age = {key: value.clone() for key, value in batch.items()}, proposed.clone(), 0.0
    pictures = [key for key in batch if "image" in key]
    if t == 3:
        batch["observation.state"][0, 0] = math.nan
    elif t == 5:
        batch[pictures[0]][0] = 0.4
    elif t == 6:
        batch[pictures[-1]][0, 0, 0, 0] = math.inf
    elif t == 8:
        age = 3.0
    elif t == 9:
        proposed[0, 0] = math.nan
    elif t == 11:
        proposed[0, 0] *= 1000
    elif t == 13:
        proposed = None
    return batch, proposed, age


@torch.no_grad()
def decide_all(name: str, variant: str, seen: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Decisions (T, 2, ...) along the recorded steps."""
    policy, rows = load_filter(name, law=LawOptions(**VARIANTS[variant])), []
    policy.shield.clock = standing_still  # however busy the machine is
    for t in range(len(seen["action"])):
        batch = {
            key: torch.from_numpy(value[t]).float() / (255 if value.dtype == np.uint8 else 1)
            for key, value in seen.items()
            if key != "action"
        }
        proposed, age = torch.from_numpy(seen["action"][t]), 0.0
        if variant == "faults":
            batch, proposed, age = break_something(t, batch, proposed)
        torch.manual_seed(t)  # where futures are drawn
        decision = policy.shield(batch, proposed, age)
        rows.append({outcome: getattr(decision, outcome).numpy() for outcome in OUTCOMES})
    return {outcome: np.stack([row[outcome] for row in rows]) for outcome in OUTCOMES}


@pytest.fixture(scope="module")
def recorded() -> dict[str, np.ndarray]:
    with np.load(FILE) as file:
        return dict(file)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", FILTERS)
def test_filter_decides_as_it_did(recorded, name, variant):
    inputs = [key.removeprefix(f"{name}/") for key in recorded if key.startswith(f"{name}/") and key.count("/") == 1]
    decided = decide_all(name, variant, {key: recorded[f"{name}/{key}"] for key in inputs})
    for outcome in OUTCOMES:
        before = recorded[f"{name}/{variant}/{outcome}"]
        np.testing.assert_allclose(decided[outcome], before, rtol=0, atol=1e-5, err_msg=f"{name}, {variant}: {outcome}")


def test_the_recording_holds_overrides_passes_and_faults_of_every_filter(recorded):
    for name in FILTERS:
        acted = recorded[f"{name}/committed/intervened"]
        assert acted.any() and not acted.all(), name
        assert len(np.unique(recorded[f"{name}/faults/reason"])) >= 5, name
    assert FILE.stat().st_size < 2e6
