#!/usr/bin/env python
"""CPU time per frame of one world-model training step: ours against the authors' public code, in the same run.

Measured: everything a training step does with a batch that is already drawn as 8-bit frames - conversion to float,
encoder, filtering, decoders, KL, continuation and margin losses, backward pass, gradient clipping, Adam.

    authors  their `pretrain_model_only` with their world model, at the sizes of their configs.yaml
    paper    ours at the same sizes (configs/dubins_rssm_paper.yaml): what lerobot-train does in a step
    compact  the same with the default RSSMConfig; the frame cache has averaged the same frames to 32 x 32

Why it is fair: all train on the same clips of the same recorded episodes with batches of the same shape, each in a
process of its own as its user would run it, but in turn and never two at once, on the same number of threads, and
warmed up. CPU time is counted, user and system. Allocating large activations costs much system time, which environment
variables of glibc avoid; so `*_kept_memory` repeats authors and paper with these set.

The authors' code is not part of this package. Clone https://github.com/CMU-IntentLab/latent-safety yourself, add what
it imports (pip install gym ruamel.yaml tensorboard wandb), and run

    OMP_NUM_THREADS=1 python scripts/bench_rssm.py --authors=PATH --json=results/dubins/bench_rssm.json
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.evaluation.statistics import write_json
from lerobot_latentsafe.experiments.dubins.training_cost import TrainingCost, measure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--authors", type=Path, required=True, help="your clone of CMU-IntentLab/latent-safety")
    parser.add_argument("--batch", type=int, default=16, help="clips a batch, for all (default: the paper's 16)")
    parser.add_argument(
        "--clip",
        type=int,
        default=16,
        help="frames a clip, for all (default 16; the paper has 64, few random episodes last as long)",
    )
    parser.add_argument("--repeats", type=int, default=5, help="timed rounds after one to warm up (default 5)")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch, for all (default 1)")
    parser.add_argument("--seed", type=int, default=0, help="of recording and weights (default 0)")
    parser.add_argument("--json", type=Path, help="where to write the results")
    args = parser.parse_args()
    row = measure(TrainingCost(args.authors.resolve(), args.batch, args.clip, args.repeats, args.threads, args.seed))
    for name, values in row["ms_per_frame"].items():
        print(f"{name:36s} {values['median']:7.2f} ms a frame ({values['low']:.2f} to {values['high']:.2f})")
    for name in row:
        if "_over_" in name:
            print(f"{name:36s} {row[name]['median']:7.2f} ({row[name]['low']:.2f} to {row[name]['high']:.2f})")
    if args.json:
        write_json(args.json, row)


if __name__ == "__main__":
    main()
