#!/usr/bin/env python
"""Kills each long verb at random moments, starts it again, and compares with a run that was never killed.

    scripts/kill_verbs.py --n=20

Writes results/reliability/kills.json: for each verb how many kills there were, how many came before the run had ended,
and how many runs then ended as the undisturbed one, to the last bit, with nothing lost in between that was said to be
saved. Rows of verbs that are not measured stay, each with the commit that made it.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["HF_HUB_OFFLINE"] = "1"

import argparse
import json
import tempfile
from pathlib import Path

from lerobot_latentsafe.cli import deploy, evaluate, label, record, train  # noqa: F401  (before any fork)
from lerobot_latentsafe.cli import main as latentsafe
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.kills.measurement import kill_verbs, with_rows
from lerobot_latentsafe.experiments.kills.verbs import VERBS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=20, help="kills of each verb")
    parser.add_argument("--verbs", nargs="+", default=list(VERBS), help=f"some of {', '.join(VERBS)}")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--work", type=Path, help="folder to work in, from which a killed run goes on")
    parser.add_argument("--output", type=Path, default=Path("results/reliability/kills.json"))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = kill_verbs(arguments.work or Path(folder), arguments.verbs, arguments.n, arguments.seed, latentsafe)
    known = json.loads(arguments.output.read_text()) if arguments.output.exists() else {}
    write_json(arguments.output, {"verbs": with_rows(known, rows), **provenance(seeds=[arguments.seed])})


if __name__ == "__main__":
    main()
