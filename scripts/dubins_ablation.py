#!/usr/bin/env python
"""The ablation: a filter whose world model has seen only {straight, left} must fear states that need a right turn.

    scripts/dubins_ablation.py --filter outputs/dubins/filter_left_only --full outputs/dubins/filter_0

Both filters are compared with the exact solution *for the left-only action set*, and by the share of right-turn-only
states (safe with three actions, unsafe with two) that they call unsafe. The full filter is the control.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from lerobot_latentsafe.dubins.car import TURN_RATES
from lerobot_latentsafe.dubins.ground_truth import exact_value, grid_states
from lerobot_latentsafe.evaluation.statistics import confusion, provenance, wilson, write_json
from lerobot_latentsafe.experiments.dubins.figures import value_slices
from lerobot_latentsafe.experiments.dubins.monitor import LatentMonitor
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reports.figures import save


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--filter", required=True, help="trained on {0, a_max} only")
    parser.add_argument("--full", required=True, help="trained on all three actions: the control")
    parser.add_argument("--output_dir", type=Path, default=Path("results/dubins"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)

    states = grid_states()
    left_only, all_three = exact_value(states, tuple(TURN_RATES[1:])), exact_value(states)
    needs_right = (all_three > 0) & (left_only <= 0)
    rows, monitors = {}, {}
    for name, path in (("left_only", arguments.filter), ("full", arguments.full)):
        monitors[name] = LatentMonitor(LatentSafePolicy.from_pretrained(path))
        unsafe = monitors[name].value(states) <= 0
        rows[name] = {
            "against_left_only_truth": confusion(~unsafe, left_only > 0),
            "against_full_truth": confusion(~unsafe, all_three > 0),
            "right_turn_only_called_unsafe": wilson(np.sum(unsafe & needs_right), needs_right.sum()),
        }
        print(name, rows[name]["right_turn_only_called_unsafe"], rows[name]["against_left_only_truth"]["f1_unsafe"])
    write_json(arguments.output_dir / "ablation.json", {**provenance([0]), "rows": rows})
    figure = value_slices({"left only": monitors["left_only"]}, tuple(TURN_RATES[1:]))
    save(figure, arguments.output_dir / "ablation.png")


if __name__ == "__main__":
    main()
