#!/usr/bin/env python
"""Does the monitor of the unknown tell before harm? Bags, scenes and cameras that it never saw, and healthy episodes.

    latentsafe monitor --policy.path=bag --dataset.root=data/held_healthy --reference.root=data/bag \\
        --output_dir=outputs/bag_monitored
    latentsafe guard --dataset.root=data/so101_careful --output_dir=outputs/so101_guard
    latentsafe monitor --policy.path=outputs/so101_guard --dataset.root=data/so101_careful \\
        --output_dir=outputs/so101_monitored
    scripts/unknown_study.py --policy=outputs/bag_monitored --so101=outputs/so101_monitored

Writes results/assurance/unknown.json: of each kind the episodes that alarm, those told before candies fly, and by how
many ticks; of faults of cameras those told within five ticks; false alarms; and what a tick costs. The same of the car
with another obstacle, speed or turn rate, and of an SO-101 with another cube, table, light or camera. Recordings of the
bag and each score are kept: a killed study goes on.
"""

import argparse
from pathlib import Path

from lerobot_latentsafe.experiments.assurance.unknown_car import study_car
from lerobot_latentsafe.experiments.assurance.unknown_so101 import study_so101
from lerobot_latentsafe.experiments.assurance.unknown_study import study


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", required=True, help="a filter of the bag with a monitor")
    parser.add_argument("--so101", required=True, help="a guard or filter of the SO-101 with a monitor")
    parser.add_argument("--recordings", type=Path, default=Path("outputs/unknown_recordings"))
    parser.add_argument("--n", type=int, default=14, help="episodes of each kind")
    parser.add_argument("--healthy", type=int, default=60, help="episodes of the bag that is known")
    parser.add_argument("--output", type=Path, default=Path("results/assurance/unknown.json"))
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    study(
        arguments.policy, arguments.recordings, arguments.n, arguments.healthy, arguments.output, arguments.workers,
        {"car": study_car(), "so101": study_so101(arguments.so101, arguments.n, arguments.healthy)},
    )  # fmt: skip


if __name__ == "__main__":
    main()
