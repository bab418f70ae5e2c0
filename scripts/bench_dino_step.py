#!/usr/bin/env python
"""A training step of the compact DINO-WM of version 0.3, by its code and by this one: how many times as fast?

    git worktree add --detach outputs/old v0.3 && OMP_NUM_THREADS=1 scripts/bench_dino_step.py --old=outputs/old

Two processes, one with each code, take steps in turn: the same shapes, 36 patches of two cameras, 16 clips of 9 frames.
Writes results/bag/bench_dino_step.json: CPU milliseconds a step of both, and their ratio round by round.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path

from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.timing import ratio, spread

SIZES = dict(clip_length=9, dim=96, depth=3, heads=3, head_dim=32, mlp=384, history=3, observed=3, change_weight=0.7)
NEW = dict(frame_skip=1, merge_patches=1, frame_token=False, token_weight=1.0)
"""What a world model of today is told to be the same."""
WORKER = """
import sys, time, torch
from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.world_models.dino_wm import DinoWM, DinoWMConfig

torch.set_num_threads(1)
torch.manual_seed(0)
batch, length, patches, dim, states, actions = 16, 9, 36, 224, 14, 5
model = DinoWM(DinoWMConfig(**eval(sys.argv[1])), ["a", "b"], states, actions, patches, dim).train()
optimizer = torch.optim.AdamW(model.parameters(), 1e-4)
first = torch.zeros(batch, length, dtype=torch.bool)
first[:, 0] = True
unknown = torch.full((batch, length), -1)
tokens, state = torch.randn(batch, length, patches, dim), torch.randn(batch, length, states)
action, valid = torch.rand(batch, length, actions), torch.ones_like(first)
clip = Clip({"tokens": tokens}, state, action, first, valid, unknown, unknown)
for line in sys.stdin:
    began = time.process_time()
    for _ in range(int(line)):
        optimizer.zero_grad()
        model.loss(clip)[0].backward()
        optimizer.step()
    print(time.process_time() - began, flush=True)
"""


class Worker:
    """A process that takes training steps with the code of a checkout."""

    def __init__(self, checkout: Path, sizes: dict):
        environment = {**os.environ, "PYTHONPATH": str(checkout.resolve())}
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", WORKER, repr(sizes)], env=environment, text=True, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, 
        )  # fmt: skip

    def milliseconds(self, steps: int) -> float:
        """CPU time of a step, over so many."""
        print(steps, file=self.process.stdin, flush=True)
        return 1e3 * float(self.process.stdout.readline()) / steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--old", type=Path, required=True, help="a checkout of the code to compare with")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--steps", type=int, default=5, help="of each in a round")
    parser.add_argument("--output", type=Path, default=Path("results/bag/bench_dino_step.json"))
    given = parser.parse_args()
    workers = {"old": Worker(given.old, SIZES), "new": Worker(Path(__file__).parents[1], {**SIZES, **NEW})}
    took: dict[str, list[float]] = {name: [] for name in workers}
    for _ in range(1 + given.rounds):
        for name, worker in workers.items():
            took[name].append(worker.milliseconds(given.steps))
    took = {name: times[1:] for name, times in took.items()}  # the first warms up
    row = {
        "new / old": ratio(took["new"], took["old"]),
        **{f"{name}_ms": spread(times) for name, times in took.items()},
    }
    print(row)
    write_json(given.output, {**row, **provenance(seeds=[0])})


if __name__ == "__main__":
    main()
