"""How good the failure margin gets with few labels: episodes labelled at random, or in the order the page suggests."""

import itertools
import json
import os
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_latentsafe.datasets.clips import ClipReader
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.evaluation.world_model import balanced_accuracy
from lerobot_latentsafe.labeling.suggestions import Suggestion
from lerobot_latentsafe.margin import FailureMargin
from lerobot_latentsafe.reports.figures import save
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.training import fit_margin, load_with_cache, seen_and_imagined

SHARES = (0.02, 0.05, 0.1, 0.2, 1.0)
"""The rounds of labelling: share of the episodes that are labelled after each."""
BLOCK = 10
"""Every fifth block of so many episodes is held out: what was recorded together, such as branches, stays together."""


class Study:
    """Features of a labelled dataset under a frozen world model: as if any share of the episodes had been labelled.

    All of it is NumPy's, so that it can be sent to other processes.

    Attributes:
        seen: (N, D) of every frame, filtered from the first frame of its episode: what is asked about.
        features, frame: (M, D) seen and imagined ones of random windows, (M,) their frames: what is fitted to.
        failure, episode: (N,) of every frame.
        first: frame at which each episode begins.
        pool: episodes that may be labelled.
        held_out: bool (N,), frames of the other episodes.

    Raises:
        ValueError: a frame without a label.
    """

    def __init__(self, model: SafetyModel, reader: ClipReader):
        self.config, labels = model.config.margin, reader.labels
        self.failure, self.episode = labels.failure, labels.episode
        if (self.failure < 0).any():
            raise ValueError(f"{(self.failure < 0).sum()} frames have no label; this study needs a dataset with all")
        self.first = np.unique(self.episode, return_index=True)[1]
        episodes = np.arange(len(self.first))
        self.pool = episodes[episodes // BLOCK % 5 < 4]
        self.held_out = ~np.isin(self.episode, self.pool)
        self.seen = encode(model, reader, self.first).numpy()
        # A frame's number stands in for its label, so that labels can be put on and taken off later.
        numbered = replace(labels, failure=np.arange(len(self.failure)))
        numbers = ClipReader(numbered, reader.cache, reader.length, reader.units, reader.skip)
        generator = torch.Generator().manual_seed(0)
        imagined = seen_and_imagined(model, numbers, self.config.clips, generator)
        self.features, self.frame = (column.cpu().numpy() for column in imagined)

    def fit(self, labelled: np.ndarray, seed: int) -> np.ndarray:
        """Bounded margin (N,) of every frame, after labelling some episodes."""
        torch.manual_seed(seed)
        generator = torch.Generator().manual_seed(seed)
        margin = FailureMargin(self.seen.shape[1], self.config.hidden, self.config.layers)
        known = np.isin(self.episode, labelled)[self.frame]
        features, failure = map(torch.from_numpy, (self.features[known], self.failure[self.frame[known]]))
        fit_margin(margin, features, failure, self.config, generator)
        with torch.no_grad():
            return margin.bounded(torch.from_numpy(self.seen)).numpy()

    def curve(self, suggested: bool, seed: int) -> dict[str, float]:
        """Balanced accuracy on held-out frames after each round; what is labelled first is random either way."""
        torch.set_num_threads(1)
        order, margin, scores = np.random.default_rng(seed).permutation(self.pool), None, {}
        labelled = 0
        for share in SHARES:
            if suggested and margin is not None:
                useful = [Suggestion.of(l).usefulness for l in np.split(margin, self.first[1:])]
                order[labelled:] = sorted(order[labelled:], key=lambda episode: -useful[episode])
            labelled = max(1, round(share * len(order)))
            margin = self.fit(order[:labelled], seed)
            scores[f"{share:g}"] = balanced_accuracy(margin[self.held_out] < 0, self.failure[self.held_out])
        return scores


@torch.no_grad()
def encode(model: SafetyModel, reader: ClipReader, first: np.ndarray) -> torch.Tensor:
    """Features (N, D) of every frame of the episodes that begin at these frames, filtered from there."""
    n, longest = len(reader.labels.episode), int(np.bincount(reader.labels.episode).max())
    features = torch.zeros(n, model.world_model.feature_dim)
    for chunk in np.array_split(first, -(-len(first) // 64)):
        clip = reader.cut(chunk, model.world_model, length=longest)
        index = torch.from_numpy(chunk)[:, None] + torch.arange(longest)
        z = model.world_model.features(model.world_model.encode(clip))
        features[index[clip.valid.cpu()]] = z[clip.valid].cpu()
    return features


def draw_curves(files: list[Path]) -> plt.Figure:
    """One panel a dataset: mean over seeds, lowest to highest shaded, and what all labels give."""
    figure, axes = plt.subplots(1, len(files), figsize=(5.2 * len(files), 3.8), squeeze=False)
    for ax, file in zip(axes[0], files):
        row = json.loads(file.read_text())
        for order, colour in (("random", "tab:gray"), ("suggested", "tab:blue")):
            curves = np.array([list(curve.values()) for curve in row["balanced_accuracy"][order]])
            ax.plot(SHARES, curves.mean(0), "o-", color=colour, label=f"{order} order")
            ax.fill_between(SHARES, curves.min(0), curves.max(0), color=colour, alpha=0.2)
        ax.axhline(curves[:, -1].mean(), color="k", lw=0.8, ls="--", label="all labels")
        ax.set(xscale="log", xticks=SHARES, xticklabels=[f"{share:.0%}" for share in SHARES])
        ax.minorticks_off()
        ax.set(title=f"{file.stem.removeprefix('curve_')}, {row['episodes']} episodes", xlabel="episodes labelled")
        ax.set_ylabel("balanced accuracy, held-out frames")
        ax.legend(loc="lower right")
    figure.tight_layout()
    return figure


def write_curves(path: str, repo_id: str, root: str, seeds: list[int], output: Path, workers: int = 1) -> None:
    """Write the curves of a dataset, and draw all curves of the output's folder into curve.png there.

    Args:
        path: of a filter with a trained world model.
        repo_id, root: of a cached dataset with labels.
        seeds: of what is labelled first.
        output: curve_<name>.json.
        workers: processes.
    """
    policy, reader = load_with_cache(path, LeRobotDatasetMetadata(repo_id, root=root))
    study = Study(policy.model, reader)
    jobs = [(suggested, seed) for suggested in (False, True) for seed in seeds]
    with get_context("spawn").Pool(workers) as pool:
        rows = pool.starmap(study.curve, jobs, chunksize=1)
        pool.close()
        pool.join()
    curves = dict(zip(("random", "suggested"), itertools.batched(rows, len(seeds))))
    for order, rows in curves.items():
        print(order, {share: f"{np.mean([row[share] for row in rows]):.4f}" for share in rows[0]})
    row = {
        "balanced_accuracy": curves,
        "lost_with_a_tenth": {o: float(np.mean([r["1"] - r["0.1"] for r in rows])) for o, rows in curves.items()},
        "labels_shaped_the_features": policy.config.margin.weight > 0,
        "episodes": len(study.pool),
        **provenance(seeds, sum(os.times()[:4]) / 60),
    }
    write_json(output, row)
    save(draw_curves(sorted(output.parent.glob("curve_*.json"))), output.with_name("curve.png"))
