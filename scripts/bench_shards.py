#!/usr/bin/env python
"""A token cache in four shards: made by one process, and by two workers of this machine, in turn.

    wall            what the clock says of both, from the first copy of the dataset to the index
    cpu             the same by CPU time, which is what two cores without other work would show: what one process does
                    alone (copying numbers, writing the index), and the busiest worker
    cpu_with_start  also with the time in which a worker loads the package, once
    cpu_of_tasks    the tasks alone: decoding, encoding, writing, digests

Both write the same, which is checked. One thread a process. On a machine with other work the clock tells little; the
load average is noted.

    OMP_NUM_THREADS=1 python scripts/bench_shards.py --videos=data/held_lifts --basis_from=data/held_lifts_tokens \\
        --json=results/scale/shards.json
"""

import argparse
import json
import tempfile
from pathlib import Path

import torch

from lerobot_latentsafe.evaluation.statistics import write_json
from lerobot_latentsafe.experiments.shard_cost import compare


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--videos", type=Path, required=True, help="a dataset with videos")
    parser.add_argument("--basis_from", type=Path, required=True, help="a cache of whole tokens, for its components")
    parser.add_argument("--episodes", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        row = compare(given.videos, given.basis_from, Path(folder), given.episodes, given.rounds)
    print(json.dumps(row, indent=2))
    if given.json:
        write_json(given.json, row)


if __name__ == "__main__":
    main()
