#!/usr/bin/env python
"""The whole road in miniature: episodes -> world model -> reachability -> a shielded diffusion policy -> a report.

Runs the same commands a user would, small enough for two cores (about ten minutes), and writes
outputs/demo/report.html and outputs/demo/metrics.json. Numbers of full size are in results/.
"""

import argparse
import json
import shutil
import threading
from pathlib import Path

from lerobot_latentsafe.experiments.demo import Demo

CANDIDATES = "[[-1.25,1.0],[0.0,1.0],[1.25,1.0]]"


class DubinsDemo(Demo):
    """The car's road from episodes to a shielded policy."""

    def data(self, source: str, n: int) -> str:
        root, repo = self.out / source, f"demo/{source}"
        self.run(
            f"collect {source}: {n} episodes",
            *(
                "latentsafe",
                "collect",
                f"--source={source}",
                f"--repo_id={repo}",
                f"--root={root}",
                f"--n_episodes={n}",
            ),
        )
        self.run(
            f"cache {source}",
            *("latentsafe", "cache", f"--dataset.repo_id={repo}", f"--dataset.root={root}"),
            f"--output_dir={root}_cache",
        )
        return f"{root}_cache"

    def train(self, what: str, config: str, source: str, root: str, *options: str) -> str:
        folder = self.out / f"train_{source}"
        self.run(
            f"train {what}",
            *("lerobot-train", f"--config_path=configs/{config}.yaml", f"--dataset.repo_id=demo/{source}_cache"),
            *(f"--dataset.root={root}", f"--output_dir={folder}", *options),
        )
        return str(folder / "checkpoints" / "last" / "pretrained_model")

    def filter(self) -> str:
        """Collect, cache, train the world model and the safety critic, set epsilon."""
        root = self.data("random", 500)
        checkpoint = self.train(
            "world model and margin", "dubins_rssm", "random", root, f"--policy.frame_cache={root}",
            f"--policy.action_candidates={CANDIDATES}", "--steps=2000", "--policy.scheduler_steps=2000",
        )  # fmt: skip
        self.run(
            "reachability in imagination",
            *("latentsafe", "train-reachability", f"--policy.path={checkpoint}", f"--output_dir={self.out}/critic"),
            *("--dataset.repo_id=demo/random_cache", f"--dataset.root={root}", "--steps=4000"),
        )
        return f"{self.out}/critic"

    def reckless(self) -> str:
        """Collect reckless demonstrations and train a diffusion policy on them."""
        root = self.data("reckless", 60)
        return self.train("reckless diffusion policy", "dubins_diffusion", "reckless", root, "--steps=400")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/demo"))
    parser.add_argument("--epsilon", type=float, default=0.97, help="the filter acts where V <= epsilon")
    parser.add_argument("--n_episodes", type=int, default=60)
    arguments = parser.parse_args()
    out = arguments.out
    if out.exists():
        shutil.rmtree(out)
    demo = DubinsDemo(out)

    # Two cores, two branches: the policy to be shielded is trained beside the filter.
    found: dict[str, str] = {}
    branch = threading.Thread(target=lambda: found.update(base=demo.reckless()))
    branch.start()
    critic = demo.filter()
    branch.join()
    if "base" not in found:
        raise SystemExit("demo: the reckless policy could not be trained; see the message above")
    demo.run(
        "wrap",
        *("latentsafe", "wrap", f"--policy.path={critic}", f"--base_policy_path={found['base']}"),
        *(f"--epsilon={arguments.epsilon}", "--guard=6", f"--output_dir={out}/shielded"),
    )
    save_every_seventh_state(out / "states.npy")
    demo.run(
        "monitor against the exact safe set",
        *("latentsafe", "eval-monitor", f"--policy.path={out}/shielded", "--env.type=latentsafe_dubins"),
        *(f"--states={out}/states.npy", f"--json={out}/monitor.json", f"--figure={out}/value_slices.png"),
    )
    demo.run(
        f"bare against shielded: {arguments.n_episodes} starts each",
        *("latentsafe", "eval-shield", f"--policy.path={out}/shielded", "--env.type=latentsafe_dubins", "--seed=500"),
        *(f"--n_episodes={arguments.n_episodes}", f"--json={out}/shield.json", f"--figure={out}/trajectories.png"),
        *(f"--video={out}/videos", "--n_videos=3"),
    )
    report(out, demo.seconds)


def save_every_seventh_state(file: Path) -> None:
    """A part of the paper's grid: enough for a demonstration's three digits."""
    import numpy as np

    from lerobot_latentsafe.dubins.ground_truth import grid_states

    np.save(file, grid_states()[::7])


def report(out: Path, seconds: float) -> None:
    """Print the table; write metrics.json and report.html."""
    from lerobot_latentsafe.reports import html as html

    shield, monitor = (json.loads((out / f"{name}.json").read_text()) for name in ("shield", "monitor"))
    videos = sorted(out.glob("videos/*.mp4"))
    header = ["diffusion policy", "safe success", "violation", "incompletion"]
    rows = [
        [name, *(html.share(shield[name][key]) for key in ("success", "violation", "incompletion"))]
        for name in ("bare", "shielded")
    ]
    rates = {f"{name}_{key}": shield[name][key] for name in ("bare", "shielded") for key in ("violation", "success")}
    metrics = {
        **rates,
        "violation_p_value": shield["violation_p_value"],
        "significant": bool(shield["violation_p_value"] < 0.05),
        "overridden_share": shield["shielded"]["overridden_share"],
        **{key: monitor[key] for key in ("f1_safe", "f1_unsafe", "balanced_accuracy", "safe_policy")},
        "minutes": round(seconds / 60, 1),
    }
    (out / "metrics.json").write_text(json.dumps(metrics, indent=2))
    scores = [["F1, safe positive", "f1_safe"], ["F1, unsafe positive", "f1_unsafe"]]
    scores = [[name, f"{monitor[key]:.3f}"] for name, key in [*scores, ["balanced accuracy", "balanced_accuracy"]]]
    html.write_report(
        out / "report.html",
        "A latent safety filter shields a reckless diffusion policy",
        [
            html.paragraph(
                "A car should drive to the right edge without entering the red disc. A diffusion policy has learnt "
                "it from demonstrations that cut through the disc. The filter has seen only random driving, through "
                "a camera; it lets the policy drive and takes over when nothing else would keep the car out."
            ),
            html.heading("Bare and shielded from the same starts"),
            html.table(header, rows),
            html.paragraph(
                f"Shares with 95% Wilson intervals. The filter acted in {metrics['overridden_share']:.0%} of all steps."
                " "
                f"Exact test of the paired difference in violations: p = {metrics['violation_p_value']:.1g}."
            ),
            *(html.video(path, "bare | shielded; orange: the filter acts") for path in videos),
            html.picture(out / "trajectories.png", "All runs. Red: entered the disc. Orange: the filter acted."),
            html.heading("The safe set it learnt from images"),
            html.table(["against the exact solution", ""], scores),
            html.picture(out / "value_slices.png", "Learned boundary (solid) and the exact one (dashed)."),
            html.paragraph(
                "This is a small training for a demonstration; results/ holds the full one. A learned filter is not a "
                "certified safety device: it carries no guarantee.",
                note=True,
            ),
        ],
    )
    print()
    for row in [header, *rows]:
        print("".join(f"{cell:<30}" for cell in row))
    acted, p_value = metrics["overridden_share"], metrics["violation_p_value"]
    print(f"\nfilter acted in {acted:.1%} of steps; violations: p = {p_value:.1g}")
    print("monitor against the exact safe set:", ", ".join(f"{name} {value}" for name, value in scores))
    print(f"{metrics['minutes']} minutes. Open {out / 'report.html'}; numbers in {out / 'metrics.json'}")


if __name__ == "__main__":
    main()
