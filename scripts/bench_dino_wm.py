#!/usr/bin/env python
"""CPU time of one step of DINO-WM's predictor, ours against the authors' public code, and of imagination in batches.

Paper's size (256 patches, 788 numbers a token, 3 frames, depth 6, 16 heads), batch 1, one step ahead:

    authors           their ViTPredictor as their planner runs it: the whole window at every step, in training mode
                      (their plan.py loads a model and never calls eval()) and with gradients (its default planner)
    authors_no_grad   the same in evaluation mode without gradients
    window            our transformer on the whole window
    step              our transformer on the last frame, keys and values of the frames before kept: what the shield runs

The same weights, copied in memory: their learned embeddings of the three frames are added to our input, and our keys
are not turned by their age, as theirs are not. In evaluation mode outputs are compared first, and must agree to 1e-5.

Compact size (the default DinoWMConfig without its encoder), `--episodes` imagined at once, per episode and step:

    batch             all episodes in one batch, keys and values kept
    one               one episode after the other, keys and values kept
    one_window        the same, but each step passes over the whole window: what a model without kept keys must do
    authors_compact   their predictor, of the same width and depth, one episode after the other, as their planner does

All in one process, in turn, on one thread, the first round thrown away; CPU time, user and system. Much of the time of
large activations is page faults, which a setting of glibc's malloc avoids (`runtime/malloc.py`). The authors do not
make it, so the paper's size is timed without it, and then again with it for all (`*_kept_memory`); the compact size is
timed with it for all. The authors' code is not part of this package. Clone https://github.com/gaoyuezhou/dino_wm
yourself, pip install einops, and run

    OMP_NUM_THREADS=1 python scripts/bench_dino_wm.py --authors=PATH --json=results/bag/bench_dino_wm.json
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.evaluation.statistics import write_json
from lerobot_latentsafe.experiments.bag.predictor_cost import measure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--authors", type=Path, required=True, help="your clone of gaoyuezhou/dino_wm")
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    row = measure(args.authors, args.rounds, args.episodes)
    for name, value in row.items():
        if "_over_" in name:
            print(f"{name:34s} {value['median']:6.2f} ({value['low']:.2f} to {value['high']:.2f})")
    if args.json:
        write_json(args.json, row)


if __name__ == "__main__":
    main()
