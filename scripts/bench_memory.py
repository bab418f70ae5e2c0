#!/usr/bin/env python
"""Memory that the labelling page and `latentsafe cache` take on episodes of 12 s and of 60 s, 720p at 30 Hz.

python scripts/bench_memory.py --root=outputs/long      films them there, if need be; writes results/labels/memory.json
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.labelling_memory import USES, film_one, grown


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--seconds", type=float, nargs=2, default=[12, 60])
    parser.add_argument("--height", type=int, default=720)
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--fps", type=int, default=30)
    parser.add_argument("--output", type=Path, default=Path("results/labels/memory.json"))
    arguments = parser.parse_args()
    rows: dict = {"episode_seconds": arguments.seconds, "size": [arguments.height, arguments.width]}
    roots = [arguments.root / f"{seconds:g}_s" for seconds in arguments.seconds]
    for root, seconds in zip(roots, arguments.seconds):
        if not root.exists():
            film_one(root, seconds, arguments.height, arguments.width, arguments.fps)
    for use in USES:
        short, long = (grown(use, root) for root in roots)
        rows[use] = {"short": short, "long": long, "long_by_short": round(long["mb"] / short["mb"], 2)}
        print(use, rows[use], flush=True)
    write_json(arguments.output, rows | provenance(seeds=[0]))


if __name__ == "__main__":
    main()
