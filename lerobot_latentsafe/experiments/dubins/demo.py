"""The whole road in miniature: episodes -> world model -> reachability -> a shielded diffusion policy -> a report."""

import json
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import mean

import numpy as np

from lerobot_latentsafe.dubins.ground_truth import grid_states
from lerobot_latentsafe.evaluation.statistics import provenance, wilson, write_json
from lerobot_latentsafe.experiments.demo import (
    NO_GUARANTEE,
    SIDE_BY_SIDE,
    Demo,
    durations,
    in_16_bits,
    told,
    where_the_minutes_went,
)
from lerobot_latentsafe.model_card import rate_in_words
from lerobot_latentsafe.reports import html

MODULES = (
    "lerobot.scripts.lerobot_train",
    "lerobot.policies.diffusion.modeling_diffusion",
    *(f"lerobot_latentsafe.cli.{group}" for group in ("record", "train", "deploy", "evaluate")),
)
"""What the commands import."""
CANDIDATES = "[[-1.25,1.0],[0.0,1.0],[1.25,1.0]]"
N_RANDOM, N_RECKLESS = 400, 40
"""Episodes. With 320 random ones, two seeds, 7 of 120 runs entered the disc, and only 41 succeeded."""
WORLD_MODEL_STEPS, CRITIC_STEPS = 2200, 1000
"""Of 600 steps, on 250 episodes and 16 pixels, came a filter under which all of 20 runs entered the disc."""
PROPOSAL_STEPS = 6
"""Imagined ticks for which a proposal is held: time to turn away."""
FEW = ("--policy.margin.clips=1000", "--policy.reachability.pool=65536", "--policy.drop_n_last_frames=8")
"""What of configs/dubins_rssm.yaml takes long. Of clips that start in the last 8 frames most is padding."""
USUAL_MINUTES = {
    "collect reckless": 0.15,
    "cache reckless": 0.03,
    "train reckless diffusion policy": 0.25,
    "collect random": 1.0,
    "cache random": 0.1,
    "train world model": 1.8,
    "fit the failure margin": 0.05,
    "reachability in imagination": 0.3,
    "wrap": 0.01,
    "monitor against the exact safe set": 0.3,
    "bare against shielded": 0.3,
}
"""Of CPU time, about, for the progress bar."""


def world_model_options(root: str) -> tuple[str, ...]:
    """Of lerobot-train, beside its configuration, for a world model of cached random episodes at a path."""
    return (
        f"--policy.frame_cache={root}", f"--policy.fallback.action_candidates={CANDIDATES}",
        f"--steps={WORLD_MODEL_STEPS}", f"--policy.scheduler_steps={WORLD_MODEL_STEPS}", *FEW,
    )  # fmt: skip


class DubinsDemo(Demo):
    """The car's road from episodes to a shielded policy.

    Args:
        out: folder, new.
        seed: of what is recorded and trained.
    """

    def __init__(self, out: Path, seed: int):
        super().__init__(out, MODULES, USUAL_MINUTES)
        self.seed = seed

    def data(self, source: str, n: int) -> str:
        """Collect episodes and cache their frames; returns the cache's folder."""
        root, repo = self.out / source, f"demo/{source}"
        self.run(
            f"collect {source}: {n} episodes",
            *("latentsafe", "collect", f"--source={source}", f"--dataset.repo_id={repo}"),
            *(f"--dataset.root={root}", f"--dataset.num_episodes={n}", f"--seed={self.seed}"),
        )
        self.run(
            f"cache {source}",
            *("latentsafe", "cache", f"--dataset.repo_id={repo}", f"--dataset.root={root}"),
            f"--output_dir={root}_cache",
        )
        return f"{root}_cache"

    def train(self, what: str, config: str, source: str, root: str, *options: str, before: Sequence[str] = ()) -> str:
        """Train by lerobot-train, with something before the command; returns the last checkpoint's folder."""
        folder = self.out / f"train_{source}"
        self.run(
            f"train {what}",
            *(*before, "lerobot-train", f"--config_path=configs/{config}.yaml", f"--seed={self.seed}"),
            *(f"--dataset.repo_id=demo/{source}_cache", f"--dataset.root={root}", f"--output_dir={folder}", *options),
        )
        return str(folder / "checkpoints" / "last" / "pretrained_model")

    def filter(self) -> str:
        """Collect, cache, train the world model, the failure margin and the safety critic; returns its folder."""
        root, margin, critic = self.data("random", N_RANDOM), f"{self.out}/margin", f"{self.out}/critic"
        cached = "--dataset.repo_id=demo/random_cache", f"--dataset.root={root}"
        checkpoint = self.train(
            "world model", "dubins_rssm", "random", root, *world_model_options(root), before=in_16_bits()
        )
        self.run(  # anew, for that one tells a sure margin from a surer one, by which a fallback is chosen
            "fit the failure margin",
            *("latentsafe", "train-margin", f"--policy.path={checkpoint}", *cached),
            *(f"--output_dir={margin}", f"--seed={self.seed}"),
        )
        self.run(
            "reachability in imagination",
            *("latentsafe", "train-reachability", f"--policy.path={margin}", *cached),
            *(f"--output_dir={critic}", f"--steps={CRITIC_STEPS}", f"--seeds=[{self.seed}]"),
        )
        return critic

    def shield(self, critic: str, base: str, epsilon: float, n_episodes: int) -> None:
        """Wrap filter and policy, compare the filter with the exact safe set, and drive bare and shielded."""
        out = self.out
        self.run(
            "wrap",
            *("latentsafe", "wrap", f"--policy.path={critic}", f"--base_policy_path={base}"),
            *(f"--law.epsilon={epsilon}", f"--law.proposal_steps={PROPOSAL_STEPS}", f"--output_dir={out}/shielded"),
        )
        np.save(out / "states.npy", grid_states()[::91])  # enough for a demonstration's two digits
        self.run(
            "monitor against the exact safe set",
            *("latentsafe", "eval-monitor", f"--policy.path={out}/shielded", "--env.type=latentsafe_dubins"),
            *(f"--states={out}/states.npy", f"--json={out}/monitor.json", f"--figure={out}/value_slices.png"),
        )
        self.run(
            f"bare against shielded: {n_episodes} starts each",
            *("latentsafe", "eval-shield", f"--policy.path={out}/shielded", "--env.type=latentsafe_dubins"),
            *("--seed=500", f"--n_episodes={n_episodes}", f"--json={out}/shield.json"),
            *(f"--figure={out}/trajectories.png", f"--video={out}/videos", "--n_videos=3"),
        )

    def reckless(self) -> str:
        """Collect reckless demonstrations and train a diffusion policy on them; returns its folder."""
        root = self.data("reckless", N_RECKLESS)
        # LeRobot takes longer to read a frame than to learn from it, and actions are learned sooner than noise.
        how = "--steps=250", "--batch_size=16", "--policy.prediction_type=sample"
        return self.train("reckless diffusion policy", "dubins_diffusion", "reckless", root, *how)


def run_demo(out: Path, epsilon: float, n_episodes: int, seed: int = 0) -> None:
    """Make the filter and the policy, compare, and write report.html and metrics.json.

    Args:
        out: folder; what is there is deleted.
        epsilon: the filter acts where V <= epsilon.
        n_episodes: starts, bare and shielded.
        seed: of what is recorded and trained. The starts are always the same.
    """
    if out.exists():
        shutil.rmtree(out)
    demo = DubinsDemo(out, seed)
    # Two cores, two branches: the policy to be shielded is trained beside the filter.
    with ThreadPoolExecutor(1) as beside:
        base = beside.submit(demo.reckless)
        critic = demo.filter()
        demo.shield(critic, base.result(), epsilon, n_episodes)
    demo.finish()
    demo.say("write the report")
    report(out, seed, demo.seconds, demo.minutes)


HEADER = ["diffusion policy", "safe success", "violation", "stall"]
SCORES = {
    "F1, safe positive": "f1_safe",
    "F1, unsafe positive": "f1_unsafe",
    "balanced accuracy": "balanced_accuracy",
}


def report(out: Path, seed: int, seconds: float, minutes: dict[str, float]) -> None:
    """Print the table; write metrics.json and report.html."""
    shield, monitor = (json.loads((out / f"{name}.json").read_text()) for name in ("shield", "monitor"))
    rows = [
        [name, *(rate_in_words(shield[name][key]) for key in ("success", "violation", "stall"))]
        for name in ("bare", "shielded")
    ]
    metrics = {**provenance([seed]), **headline_numbers(shield, monitor), **durations(seconds, minutes)}
    write_json(out / "metrics.json", metrics)
    scores = [[name, f"{monitor[key]:.3f}"] for name, key in SCORES.items()]
    html.write_report(
        out / "report.html",
        "A latent safety filter shields a reckless diffusion policy",
        page(out, rows, scores, metrics),
    )
    print()
    for row in [HEADER, *rows]:
        print("".join(f"{cell:<30}" for cell in row))
    acted, p_value = metrics["overridden_share"], metrics["violation_p_value"]
    print(f"\nfilter acted in {acted:.1%} of steps; violations: p = {p_value:.1g}")
    print("monitor against the exact safe set:", ", ".join(f"{name} {value}" for name, value in scores))
    print(told(out, metrics))


def headline_numbers(shield: dict, monitor: dict) -> dict:
    """What metrics.json holds, of what eval-shield and eval-monitor wrote."""
    rates = {f"{name}_{key}": shield[name][key] for name in ("bare", "shielded") for key in ("violation", "success")}
    return {
        **rates,
        "violation_p_value": shield["violation_p_value"],
        "significant": bool(shield["violation_p_value"] < 0.05),
        "overridden_share": shield["shielded"]["overridden_share"],
        **{key: monitor[key] for key in ("f1_safe", "f1_unsafe", "balanced_accuracy", "safe_policy")},
    }


def page(out: Path, rows: list[list[str]], scores: list[list[str]], metrics: dict) -> list[str]:
    """The parts of report.html."""
    return [
        html.paragraph(
            "A car should drive to the right edge without entering the red disc. A diffusion policy has learnt "
            "it from demonstrations that cut through the disc. The filter has seen only random driving, through "
            "a camera; it lets the policy drive and takes over when nothing else would keep the car out."
        ),
        html.heading("Bare and shielded from the same starts"),
        html.table(HEADER, rows),
        html.paragraph(
            f"Shares with 95% Wilson intervals. The filter acted in {metrics['overridden_share']:.0%} of all steps. "
            f"Exact test of the paired difference in violations: p = {metrics['violation_p_value']:.1g}."
        ),
        *(html.video(path, SIDE_BY_SIDE) for path in sorted(out.glob("videos/*.mp4"))),
        html.picture(out / "trajectories.png", "All runs. Red: entered the disc. Orange: the filter acted."),
        html.heading("The safe set it learnt from images"),
        html.table(["against the exact solution", ""], scores),
        html.picture(out / "value_slices.png", "Learned boundary (solid) and the exact one (dashed)."),
        *where_the_minutes_went(metrics["cpu_minutes_of"]),
        html.paragraph(
            f"This is a small training for a demonstration; results/ holds the full one. {NO_GUARANTEE}", note=True
        ),
    ]


def pool_runs(folders: list[Path], path: Path) -> None:
    """Write what several demonstrations measured, as one table: rates of all their runs, and mean minutes.

    Args:
        folders: of demonstrations of different seeds that have run.
        path: of the table, .json.

    Raises:
        ValueError: two are of one seed, or of different commits.
    """
    found = [json.loads((folder / "metrics.json").read_text()) for folder in folders]
    seeds, commits = [run["seeds"][0] for run in found], sorted({run["commit"] for run in found})
    if len({*seeds}) < len(seeds) or len(commits) > 1:
        raise ValueError(f"seeds {seeds} of commits {', '.join(commits)}; expected each seed once, all of one commit")
    rates = ("bare_violation", "bare_success", "shielded_violation", "shielded_success")
    pooled = {name: wilson(*(sum(run[name][part] for run in found) for part in "kn")) for name in rates}
    minutes = [run["cpu_minutes"] for run in found]
    spent = {step: round(mean(run["cpu_minutes_of"][step] for run in found), 2) for step in found[0]["cpu_minutes_of"]}
    made = {**provenance(seeds, sum(minutes)), "commit": commits[0]}
    write_json(
        path,
        {**pooled, "mean_cpu_minutes": round(mean(minutes), 2), "mean_cpu_minutes_of": spent, **made, "runs": found},
    )
