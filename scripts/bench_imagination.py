#!/usr/bin/env python
"""Imagined environment steps per CPU second: ours against the authors' public code, in one process.

Reachability learns from imagined transitions: a latent, an action, the next latent, its features, margin and whether
the episode has ended. Measured is how many of these each side makes per CPU second, untrained, at these sizes:

    authors  their gymnasium environment `dubins-wm` with its limit of 16 steps an episode: one latent and one action a
             call, reset by encoding two frames of a recorded episode; world model at the sizes of their configs.yaml
    paper    `LatentReachability.imagine` at the same sizes (configs/dubins_rssm_paper.yaml)
    compact  the same with the default RSSMConfig

Why it is fair: both sides step all that their reachability training steps, on the same recorded episodes, in turn, on
the same number of threads, warmed up; resets count on both sides. Ours encodes up to 100,000 frames once and then
draws its starts from them, so `with_resets` divides the transitions of one training run of the default length by the
time they take plus the time of that encoding; `imagine` leaves the encoding out. We imagine the successor of every
candidate action and count each (`imagined`); `along_trajectories` counts only those that a trajectory goes on from.
In favour of the authors: their policy, vector environment, replay buffer and checking wrappers are left out, and their
continuation head is biased to never end an episode before its limit. Untrained it ends every episode after one step;
`authors_reset_each_step` shows that, too. A trained one is in between.

The authors' code is not part of this package. Clone https://github.com/CMU-IntentLab/latent-safety yourself, add what
it imports (pip install gym ruamel.yaml tensorboard wandb), and run

    OMP_NUM_THREADS=1 python scripts/bench_imagination.py --authors=PATH --json=results/dubins/bench_imagination.json
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.evaluation.statistics import write_json
from lerobot_latentsafe.experiments.dubins.imagination_cost import ImaginationCost, measure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--authors", type=Path, required=True, help="your clone of CMU-IntentLab/latent-safety")
    parser.add_argument("--episodes", type=int, default=60, help="recorded episodes that both reset from (default 60)")
    parser.add_argument("--steps", type=int, default=320, help="the authors' steps a round (default 320)")
    parser.add_argument("--repeats", type=int, default=5, help="timed rounds after one to warm up (default 5)")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch, for all (default 1)")
    parser.add_argument("--seed", type=int, default=0, help="of recording, weights and starts (default 0)")
    parser.add_argument("--json", type=Path, help="where to write the results")
    given = vars(parser.parse_args())
    output = given.pop("json")
    row = measure(ImaginationCost(**{**given, "authors": given["authors"].resolve()}))
    for name, values in row["steps_per_cpu_second"].items():
        over = row["over_authors"][name]
        print(f"{name:40s} {values['median']:9.0f} a CPU second, {over['median']:7.2f} times the authors'", end=" ")
        print(f"({over['low']:.2f} to {over['high']:.2f})")
    if output:
        write_json(output, row)


if __name__ == "__main__":
    main()
