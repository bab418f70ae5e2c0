#!/usr/bin/env python
"""What labelling costs, on a filmed dataset as large as the paper's: 1,300 episodes of two 256-pixel cameras at 15 Hz.

python scripts/bench_labeling.py film --root=outputs/filmed        makes the dataset (a cup pushed along a table)
python scripts/bench_labeling.py latency|hand|kills --root=...     writes results/labels/<name>.json
Needs Chromium, and playwright from the dev extra.
"""

import argparse
import json
from pathlib import Path

from lerobot_latentsafe.experiments.labelling_cost import MEASURES, film, measure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("film", *MEASURES))
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--n_episodes", type=int, default=1300)
    parser.add_argument("--policy", help="hand: with the suggestions of this filter")
    arguments = parser.parse_args()
    if arguments.what == "film":
        first = film(arguments.root, arguments.n_episodes)
        (arguments.root / "truth.json").write_text(json.dumps(first))
    else:
        measure(arguments.what, arguments.root, arguments.policy)


if __name__ == "__main__":
    main()
