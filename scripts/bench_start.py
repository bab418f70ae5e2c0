#!/usr/bin/env python
"""What a person waits for first: CPU seconds of help and of what is mistyped, beside `import torch` and lerobot-train.

All commands run in turn, several times, each in a process of its own; the first round, which may compile byte code, is
not counted. Writes results/start.json.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from lerobot_latentsafe.evaluation.statistics import provenance, write_json

BIN = Path(sys.executable).parent
COMMANDS = {
    "import torch": (sys.executable, "-c", "import torch"),
    "lerobot-train --help": (BIN / "lerobot-train", "--help"),
    "import lerobot_latentsafe": (sys.executable, "-c", "import lerobot_latentsafe"),
    "latentsafe --help": (BIN / "latentsafe", "--help"),
    "latentsafe eval-shield --help": (BIN / "latentsafe", "eval-shield", "--help"),
    "latentsafe record --help": (BIN / "latentsafe", "record", "--help"),
    "a mistyped option": (BIN / "latentsafe", "eval-shield", "--polcy.path=x"),
    "latentsafe path": (BIN / "latentsafe", "path", "--name=bag"),
    "the page's refusal": (BIN / "latentsafe", "label", "--dataset.root=nowhere"),
    "completion": (BIN / "latentsafe", "completion"),
}
TORCH, TRAIN = list(COMMANDS)[:2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--output", type=Path, default=Path("results/start.json"))
    arguments = parser.parse_args()
    rounds = [{name: cpu_seconds(name) for name in COMMANDS} for _ in range(arguments.rounds + 1)][1:]
    median = {name: float(np.median([took[name] for took in rounds])) for name in COMMANDS}
    rows = {
        name: {"cpu_s": round(took, 3), "over_torch": took / median[TORCH], "over_lerobot_train": took / median[TRAIN]}
        for name, took in median.items()
    }
    for name, row in rows.items():
        print(f"{name:30s} {row['cpu_s']:6.2f} s, {row['over_torch']:.3f} x torch")
    minutes = sum(sum(took.values()) for took in rounds) / 60
    write_json(
        arguments.output, {"rows": rows, "rounds": arguments.rounds, **provenance(seeds=[], cpu_minutes=minutes)}
    )


def cpu_seconds(name: str) -> float:
    """CPU time of a command in a process of its own."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    before = os.times()
    line = {"COMP_LINE": "latentsafe eval-shield --env.type=latentsafe_d"} if name == "completion" else {}
    subprocess.run(COMMANDS[name], capture_output=True, env={**environment, "HF_HUB_OFFLINE": "1", **line})
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


if __name__ == "__main__":
    main()
