"""The ablation: a filter whose world model has seen only {straight, left} must fear states that need a right turn."""

from pathlib import Path

import torch

from lerobot_latentsafe.dubins.car import TURN_RATES
from lerobot_latentsafe.dubins.ground_truth import exact_value, grid_states
from lerobot_latentsafe.evaluation.statistics import confusion, provenance, wilson, write_json
from lerobot_latentsafe.experiments.dubins.figures import value_slices
from lerobot_latentsafe.experiments.dubins.monitor import LatentMonitor
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.reports.figures import save


def write_ablation(left_only: str, full: str, folder: Path) -> None:
    """Write ablation.json and ablation.png to a folder.

    Args:
        left_only: path of a filter that was trained on {0, a_max} alone.
        full: path of one that was trained on all three actions: the control.
    """
    torch.set_num_threads(1)
    states = grid_states()
    two, three = exact_value(states, tuple(TURN_RATES[1:])), exact_value(states)
    needs_right = (three > 0) & (two <= 0)
    rows, monitors = {}, {}
    for name, path in (("left_only", left_only), ("full", full)):
        monitors[name] = LatentMonitor(load_filter(path).model)
        unsafe = monitors[name].value(states) <= 0
        rows[name] = {
            "against_left_only_truth": confusion(~unsafe, two > 0),
            "against_full_truth": confusion(~unsafe, three > 0),
            "right_turn_only_called_unsafe": wilson(int((unsafe & needs_right).sum()), int(needs_right.sum())),
        }
        print(name, rows[name]["right_turn_only_called_unsafe"], rows[name]["against_left_only_truth"]["f1_unsafe"])
    write_json(folder / "ablation.json", {**provenance([0]), "rows": rows})
    save(value_slices({"left only": monitors["left_only"]}, tuple(TURN_RATES[1:])), folder / "ablation.png")
