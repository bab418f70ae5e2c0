#!/usr/bin/env python
"""What the token cache costs and saves: bytes, rounding errors, speed against decoding video, memory at 10x and 100x.

    size      bytes a frame of two cameras: the videos, tokens in 16 and in 8 bits, and principal components
    error     of tokens in 8 bits, relative to their norm: overall, and of the worst token
    speed     frames (of both cameras) that a CPU second brings as training windows: by LeRobotDataset, decoding video
              and resizing as training would; and from the cache, where LeRobotDataset brings the frame's index and
              numbers and the cache a window of tokens in 16 bits, in 8 bits, or of principal components
    memory    of `lerobot-train` on the cache, and on datasets that hold it ten and a hundred times: peak, anonymous
              memory, and pages of mapped files, which the system takes back when it needs them

Speeds are taken in turn, on one thread, the first round thrown away; CPU time, user and system. Encoding, which the
cache saves as well, is not counted. The 8-bit copy is made of the 16-bit tokens by the same function as `latentsafe
cache --dtype=int8` uses.

With --memory_only the memory alone is measured; then --videos may be left out.

    OMP_NUM_THREADS=1 python scripts/bench_cache.py --videos=data/held_branches --cache=data/held_branches_tokens \\
        --json=results/bag/bench_cache.json
"""

import argparse
import json
from pathlib import Path

from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.bag.cache_cost import CacheCost, measure, measure_memory


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--videos", type=Path, help="a dataset with videos")
    parser.add_argument("--cache", type=Path, required=True, help="its token cache, in 16 bits")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--length", type=int, default=24, help="frames of a window")
    parser.add_argument("--windows", type=int, default=6, help="decoded a round; of a cache 20 times as many")
    parser.add_argument("--steps", type=int, default=100, help="of training, for its memory")
    parser.add_argument("--most", type=int, default=100, help="times the cache, for training's memory: 1, 10 or 100")
    parser.add_argument("--scratch", type=Path, help="folder for the datasets that hold it many times")
    parser.add_argument("--memory_only", action="store_true")
    parser.add_argument("--json", type=Path)
    given = vars(parser.parse_args())
    output, memory_only = given.pop("json"), given.pop("memory_only")
    if not (given["videos"] or memory_only):
        parser.error("give --videos, or --memory_only")
    options = CacheCost(**given)
    row = {**measure_memory(options), **provenance([0])} if memory_only else measure(options)
    print(json.dumps(row, indent=2))
    if output:
        write_json(output, row)


if __name__ == "__main__":
    main()
