"""Teach the committed filters, which are of versions before 0.3, what a guard knows of recordings of their tasks.

Their limits of states and commands and the looks of their cameras go into config.json, which is sealed again; their
weights stay as they are. `latentsafe guard --policy.path=...` does the same for a filter and one dataset; the blocks'
recordings open the gripper further than that filter's own data, so here ranges of actions are not compared.

    .venv/bin/python scripts/committed_guards.py --data=data
"""

import argparse
import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from lerobot.datasets.dataset_tools import merge_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.datasets.adoption import with_limits
from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.live_cameras import looks_of
from lerobot_latentsafe.runtime.checkpoint import read_config, seal_again
from lerobot_latentsafe.runtime.locations import CONFIG, PRETRAINED

RECORDINGS = {
    "dubins": ["car", "car_more"],
    "bag": [
        "bag_mix", "bag_branches", "bag_climbs", "bag_clumsy", "bag_strong", "bag_retreats", "bag_lifts", "bag_between",
        "bag_weak", "bag_middle", "bag_dither",
    ],
    "blocks": ["blocks_random", "blocks_demos"],
}  # fmt: skip
"""Filter -> folders of `latentsafe collect`: of the sources of these names; those of the car are `random`."""


def learn(name: str, data: Path) -> None:
    """Change one committed filter."""
    folder, merged = PRETRAINED / name, data / f"all_{name}"
    if not merged.exists():
        merge_datasets(
            [LeRobotDataset(f"faults/{part}", root=data / part) for part in RECORDINGS[name]],
            output_repo_id=f"faults/{name}",
            output_dir=merged,
        )
    meta = LeRobotDataset(f"faults/{name}", root=merged).meta
    contract = Contract.read(meta)
    known = with_limits(read_config(folder).trained_on, contract)
    known.looks = looks_of(meta, contract, known)
    config = json.loads((folder / CONFIG).read_text())
    for field in ("state_low", "state_high", "state_step", "action_step", "action_jerk", "unanswered", "looks"):
        value = asdict(known)[field]
        config["trained_on"][field] = value if field == "looks" else np.round(value, 5).tolist()
    (folder / CONFIG).write_text(json.dumps(config, indent=1) + "\n")
    seal_again(folder)
    print(f"{name}: {len(contract.episode)} frames of {len(contract.lengths)} episodes")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the recordings")
    data = parser.parse_args().data
    for name in RECORDINGS:
        learn(name, data)


if __name__ == "__main__":
    main()
