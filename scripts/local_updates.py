#!/usr/bin/env python
"""What is given up where two processes average their weights after every 8 updates of reachability, instead of summing
their gradients at each.

    scripts/local_updates.py --demos outputs/demo_0 outputs/demo_1 outputs/demo_2

Trains critics of the car on the margins that `make demo` left, by one process, by two, and by two that update apart,
and compares the sign of each one's V with the exact safe set: of the critic alone, for a filter's look-ahead hides what
a critic does not know. Writes results/scale/local_updates.json: balanced accuracy of each variant.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory

import numpy as np
import torch

from lerobot_latentsafe.dubins.ground_truth import exact_value
from lerobot_latentsafe.evaluation.statistics import confusion, provenance, write_json
from lerobot_latentsafe.experiments.dubins.monitor import LatentMonitor
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.safety_model import SafetyModel

CLI = ("-m", "lerobot_latentsafe.cli")
TWO = ("-m", "torch.distributed.run", "--standalone", "--local_addr=127.0.0.1", "--nproc_per_node=2", *CLI)
VARIANTS = {"one": (CLI, 1), "two": (TWO, 1), "two, apart": (TWO, 8)}
"""Variant -> how Python starts, and local updates."""


def balanced_accuracy(demo: Path, variant: str, seed: int, steps: int) -> float:
    """Of a critic that is trained on a demonstration's margin, over the car's states."""
    how, local_updates = VARIANTS[variant]
    with TemporaryDirectory() as folder:
        margin, critic = Path(folder) / "margin", Path(folder) / "critic"
        copy_with(demo / "margin", margin, local_updates)
        run(
            *how, "train-reachability", f"--policy.path={margin}", f"--output_dir={critic}",
            "--dataset.repo_id=demo/random_cache", f"--dataset.root={demo / 'random_cache'}",
            f"--steps={steps}", f"--seeds=[{seed}]",
        )  # fmt: skip
        return of_the_critic(load_filter(critic).model, np.load(demo / "states.npy"))


@torch.no_grad()
def of_the_critic(model: SafetyModel, states: np.ndarray) -> float:
    """Balanced accuracy of the sign of V = min(l, max Q), without look-ahead, at states of the car (N, 3)."""
    latents, imagination = LatentMonitor(model).latents(states), model.imagination
    parts = [model.critic.value(imagination.features(z), imagination.margin(z)) for z in latents]
    return confusion(torch.cat(parts).numpy() > 0, exact_value(states) > 0)["balanced_accuracy"]


def copy_with(margin: Path, copy: Path, local_updates: int) -> None:
    """A filter whose reachability is learned with so many local updates."""
    copy.mkdir()
    for file in margin.iterdir():
        if file.name != "config.json":
            (copy / file.name).symlink_to(file.absolute())
    config = json.loads((margin / "config.json").read_text())
    config["reachability"]["local_updates"] = local_updates
    (copy / "config.json").write_text(json.dumps(config))


def run(*options: str) -> None:
    """Python with such options, one thread a process.

    Raises:
        SystemExit: it failed; with the end of its output.
    """
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1", "TQDM_DISABLE": "1"}
    done = subprocess.run([sys.executable, *options], env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(options)} failed:\n{done.stderr[-2000:]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demos", type=Path, nargs="+", required=True, help="folders that `make demo` wrote")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--output", type=Path, default=Path("results/scale/local_updates.json"))
    given = parser.parse_args()
    began = os.times()
    rows: dict[str, list[float]] = {variant: [] for variant in VARIANTS}
    for demo in given.demos:
        for seed in given.seeds:
            for variant, found in rows.items():
                found.append(balanced_accuracy(demo, variant, seed, given.steps))
                print(f"{demo.name}, seed {seed}, {variant}: {found[-1]:.4f}", flush=True)
    now = os.times()
    spent = (now.children_user + now.children_system - began.children_user - began.children_system) / 60
    table = {"mean": {variant: mean(found) for variant, found in rows.items()}, "balanced_accuracy": rows}
    settings = {"local_updates": {variant: n for variant, (_, n) in VARIANTS.items()}, "steps": given.steps}
    write_json(given.output, {**table, **settings, **provenance(given.seeds, spent)})


if __name__ == "__main__":
    main()
