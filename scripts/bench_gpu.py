#!/usr/bin/env python
"""All that matters on a GPU, in ten minutes and without a dataset: random clips at the papers' sizes, random weights.

    train_rssm      frames a second of training the RSSM of configs/dubins_rssm_paper.yaml: single precision, TF32,
                    bfloat16, and bfloat16 with its cell compiled; and the lines at which a step waits for the GPU
    train_dino_wm   the same of configs/bag_dino_wm_paper.yaml, on tokens of two cameras
    reachability    imagined transitions, and updates of critic and actor, a second
    encode          frames of two cameras a second through a transformer of DINOv2's size (ViT-S/14, 224 pixels)
    tick            milliseconds of a whole tick with two cameras; and of its tensors alone, with and without a graph

    python scripts/bench_gpu.py --json=results/gpu.json
    python scripts/bench_gpu.py --authors=PATH      also training by CMU-IntentLab/latent-safety, in single precision
    python scripts/bench_gpu.py --device=cpu --toy  tries it

lerobot-train trains in single precision, whatever it is told: what bfloat16 gains is measured, not promised.
"""

import argparse
import json
from pathlib import Path

import torch

from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.gpu_speed import PAPER, PARTS, TOY, authors_on, measure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--parts", nargs="+", choices=PARTS, help="by default all")
    parser.add_argument("--toy", action="store_true", help="tiny sizes, to see that it works")
    parser.add_argument("--authors", type=Path, help="your clone of CMU-IntentLab/latent-safety")
    parser.add_argument("--json", type=Path, help="where to write the results")
    given = parser.parse_args()
    if given.device == "cuda" and not torch.cuda.is_available():
        parser.error("torch sees no GPU; give --device=cpu --toy to try it")
    row = measure(given.device, TOY if given.toy else PAPER, given.parts)
    if given.authors:
        row["authors"] = authors_on(given.device, given.authors)
        print("authors", row["authors"])
    if given.json:
        write_json(given.json, {**row, **provenance(seeds=[0])})
    else:
        print(json.dumps(row, indent=2))


if __name__ == "__main__":
    main()
