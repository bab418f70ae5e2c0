"""Labels that a trained filter disagrees with: where people slip, or where the filter has not understood."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.labels import FAILING, UNLABELLED
from lerobot_latentsafe.labeling.store import LabelStore, in_words
from lerobot_latentsafe.labeling.suggestions import Suggestion, contradiction
from lerobot_latentsafe.reports import html

PICTURES = 9


@dataclass(frozen=True)
class Disagreement:
    """One labelled episode. degree: 0 agrees surely, 0.5 undecided, 1 contradicts surely."""

    episode: int
    degree: float
    margin: np.ndarray
    failure: np.ndarray


def find_disagreements(
    store: LabelStore, specification: str, margins: dict[int, np.ndarray], least: float = 0.6
) -> list[Disagreement]:
    """Labelled episodes whose labels contradict the margin by at least so much, the worst first."""
    found = []
    for episode, margin in margins.items():
        failure = store.labels(specification, episode)
        degree = contradiction(margin, failure)
        if degree >= least and (failure != UNLABELLED).any():
            found.append(Disagreement(episode, degree, margin, failure))
    return sorted(found, key=lambda d: -d.degree)


def write_disagreements(
    path: str | Path, found: list[Disagreement], store: LabelStore, frames: DatasetFrames, specification: str,
    n_shown: int = 30,
) -> None:  # fmt: skip
    """One page with the worst disagreements: both verdicts, the margin over time, and pictures."""
    labelled = sum((store.labels(specification, e) != UNLABELLED).any() for e in range(len(store)))
    parts = [
        html.paragraph(
            f"{len(found)} of {labelled} labelled episodes of {store.repo_id} disagree with the filter about "
            f"{specification!r}. The worst come first; either the label slipped, or the filter has not understood. "
            "Blue: the filter's margin, below zero it sees a failure. Grey: the label, +1 safe, -1 failing. Shaded: "
            "they disagree. Orange frames are labelled as failing."
        )
    ]
    for d in found[:n_shown]:
        verdict, n = store.verdict(specification, d.episode), len(d.margin)
        said = np.select([d.failure == FAILING, d.failure == UNLABELLED], [-1.0, np.nan], 1.0)
        picked = np.unique(np.linspace(0, n - 1, PICTURES).round().astype(int))
        images = list(frames.stream(frames.cameras[0], d.episode, picked))
        parts += [
            html.heading(f"Episode {d.episode}"),
            html.paragraph(
                f"{verdict.by or 'Somebody'}: {in_words(verdict.first, n)}. "
                f"Filter: {in_words(Suggestion.of(d.margin).guess, n)}."
            ),
            html.chart({"margin": d.margin, "label": said}, frames.meta.fps, said * d.margin < 0, 0.0, (-1.0, 1.0)),
            html.strip(images, [f"frame {t}" for t in picked], [said[t] < 0 for t in picked]),
        ]
    html.write_report(path, "Labels and filter disagree", parts)
