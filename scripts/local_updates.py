#!/usr/bin/env python
"""What is given up where two processes average their weights after every 8 updates, instead of their gradients at each.

    for seed in 0 1 2; do scripts/demo.py --seed=$seed --out=outputs/demo_$seed; done
    scripts/local_updates.py --demos outputs/demo_0 outputs/demo_1 outputs/demo_2

Trains critics of the car on the margins that the demonstrations left, by one process, by two, and by two that update
apart; and critics by one process on world models that two processes trained apart. Compares the sign of each one's V
with the exact safe set: of the critic alone, for a filter's look-ahead hides what a critic does not know. Writes
results/scale/local_updates.json: balanced accuracy of each variant.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from statistics import mean
from tempfile import TemporaryDirectory

import numpy as np
import torch

from lerobot_latentsafe.dubins.ground_truth import exact_value
from lerobot_latentsafe.evaluation.statistics import confusion, provenance, write_json
from lerobot_latentsafe.experiments.demo import ENVIRONMENT, in_16_bits
from lerobot_latentsafe.experiments.dubins.demo import WORLD_MODEL_STEPS, world_model_options
from lerobot_latentsafe.experiments.dubins.monitor import LatentMonitor
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.safety_model import SafetyModel

LOCAL_UPDATES = 8
OF_A_DEMO = ("metrics.json", "states.npy", "random_cache", "margin")
"""What is read of a folder of scripts/demo.py."""
CLI = ("-m", "lerobot_latentsafe.cli")
TWO = ("-m", "torch.distributed.run", "--standalone", "--local_addr=127.0.0.1", "--nproc_per_node=2")
VARIANTS = {"one": (CLI, 1), "two": ((*TWO, *CLI), 1), "two, apart": ((*TWO, *CLI), LOCAL_UPDATES)}
"""Of the critic -> how Python starts, and local updates."""
WORLD_MODEL = "world model by two, apart"
"""The variant in which a critic by one process learns on such a world model."""


def balanced_accuracy(demo: Path, margin: Path, variant: str, seed: int, steps: int) -> float:
    """Of a critic that is trained on a margin of a demonstration's recordings, over the car's states."""
    how, local_updates = VARIANTS[variant]
    with TemporaryDirectory() as folder:
        copy, critic = Path(folder) / "margin", Path(folder) / "critic"
        copy_with(margin, copy, local_updates)
        run(
            *how, "train-reachability", f"--policy.path={copy}", f"--output_dir={critic}", *recordings(demo),
            f"--steps={steps}", f"--seeds=[{seed}]",
        )  # fmt: skip
        return of_the_critic(load_filter(critic).model, np.load(demo / "states.npy"))


def world_model_apart(demo: Path, folder: Path) -> Path:
    """The margin on a world model that two processes train apart, by half batches, otherwise as the demonstration's."""
    (seed,) = json.loads((demo / "metrics.json").read_text())["seeds"]
    run(
        *TWO, "-m", "lerobot.scripts.lerobot_train", "--config_path=configs/dubins_rssm.yaml", *recordings(demo),
        *world_model_options(str(demo / "random_cache")), "--batch_size=8",
        f"--policy.local_updates={LOCAL_UPDATES}", f"--seed={seed}", f"--output_dir={folder / 'world_model'}",
        environment=dict(setting.split("=") for setting in in_16_bits()[1:]),
    )  # fmt: skip
    run(
        *CLI, "train-margin", f"--policy.path={folder}/world_model/checkpoints/last/pretrained_model",
        *recordings(demo), f"--output_dir={folder / 'margin'}", f"--seed={seed}",
    )  # fmt: skip
    return folder / "margin"


def recordings(demo: Path) -> tuple[str, str]:
    """Options that name the cached random episodes of a demonstration."""
    return "--dataset.repo_id=demo/random_cache", f"--dataset.root={demo / 'random_cache'}"


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


def run(*options: str, environment: Mapping[str, str] | None = None) -> None:
    """Python with such options, one thread a process.

    Raises:
        SystemExit: it failed; with the end of its output.
    """
    done = subprocess.run(
        [sys.executable, *options],
        env={**os.environ, **ENVIRONMENT, **(environment or {})},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(options)} failed:\n{done.stderr[-2000:]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demos", type=Path, nargs="+", required=True, help="folders that scripts/demo.py wrote")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--output", type=Path, default=Path("results/scale/local_updates.json"))
    given = parser.parse_args()
    for demo in given.demos:
        if missing := [name for name in OF_A_DEMO if not (demo / name).exists()]:
            parser.error(f"--demos has {demo}, which lacks {', '.join(missing)}; expected folders of scripts/demo.py")
    began = os.times()
    rows: dict[str, list[float]] = {variant: [] for variant in (*VARIANTS, WORLD_MODEL)}
    for demo in given.demos:
        with TemporaryDirectory() as folder:
            apart = world_model_apart(demo, Path(folder))
            for seed in given.seeds:
                for variant, found in rows.items():
                    margin, critic = (apart, "one") if variant == WORLD_MODEL else (demo / "margin", variant)
                    found.append(balanced_accuracy(demo, margin, critic, seed, given.steps))
                    print(f"{demo.name}, seed {seed}, {variant}: {found[-1]:.4f}", flush=True)
    now = os.times()
    spent = (now.children_user + now.children_system - began.children_user - began.children_system) / 60
    table = {"mean": {variant: mean(found) for variant, found in rows.items()}, "balanced_accuracy": rows}
    settings = {"local_updates": LOCAL_UPDATES, "world_model_steps": WORLD_MODEL_STEPS, "steps": given.steps}
    write_json(given.output, {**table, **settings, **provenance(given.seeds, spent)})


if __name__ == "__main__":
    main()
