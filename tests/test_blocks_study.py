"""The privileged bound, lead times, and the table."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch

from lerobot_latentsafe.experiments.blocks import study, table2
from lerobot_latentsafe.experiments.blocks.simulator_lookahead import SimulatorLookahead
from lerobot_latentsafe.experiments.blocks.study import lead
from lerobot_latentsafe.experiments.blocks.warning import warnings_of, watch
from lerobot_latentsafe.franka.behaviors import CLOSED, begin, reach, up
from lerobot_latentsafe.franka.scenes import make_scene

SCRIPT = Path(__file__).parents[1] / "scripts" / "blocks_table2.py"
STILL = np.zeros(7)


@pytest.fixture(scope="module")
def scene():
    scene = make_scene("blocks", image_size=32)
    yield scene
    scene.close()


def steps(scene, n, filter=None, behavior="pluck_careless", seed=4):
    """States along an episode of a scripted operator, and how often it was overridden."""
    scene.reset(seed)
    actions, states, overridden = begin(behavior, scene, None, np.random.default_rng([0, seed])), [], 0
    action = STILL
    for _ in range(n):
        action = executed = next(actions, np.append(np.zeros(6), action[6]))
        if filter is not None:
            executed, retreated = filter(action)
            overridden += retreated
        scene.step(executed)
        states.append(scene.get_state().physics)
    return np.array(states), overridden


def test_looking_ahead_leaves_no_trace(scene):
    alone, _ = steps(scene, 12)
    filtered, overridden = steps(scene, 12, SimulatorLookahead(scene, horizon=3))
    assert overridden == 0
    np.testing.assert_array_equal(filtered, alone)


class Plucking:
    """In a policy's place, an operator who plucks the block, and puts it back if `back`."""

    def __init__(self, back):
        self.scene, self.back = study.blocks_env().scene, back

    def reset(self):
        self.actions = self.pluck()

    def pluck(self):
        for action in begin("pluck_careful", self.scene, 0.25, np.random.default_rng(0)):
            if self.back and self.scene.block_position("green")[2] > 0.21:
                break
            yield action
        yield from reach(self.scene, self.scene.controller.position - up(0.06), 0.25, CLOSED)
        while True:
            yield np.array([0, 0, 0, 0, 0, 0, CLOSED])

    def propose(self, batch):
        return torch.from_numpy(next(self.actions))[None]


@pytest.mark.parametrize("back", [False, True])
def test_success_is_that_the_block_was_picked_up_and_whether_it_still_is_stands_beside_it(back, monkeypatch):
    monkeypatch.setattr(study, "load", lambda *names: Plucking(back))
    row = study.run({"dreamer": "", "filter": None, "mode": "bare", "epsilon": None, "seed": 0})
    assert row["success"] and not row["violation"] and row["held"] != back and not row["leaning"]


def test_harmless_actions_pass(scene):
    scene.reset(0)
    action = np.array([0.0, 0, 0.005, 0, 0, 0, 1.0])
    executed, retreated = SimulatorLookahead(scene, horizon=3)(action)
    assert not retreated and executed is action


def test_doomed_actions_are_replaced_by_the_best_retreat(scene, monkeypatch):
    scene.reset(0)
    filter = SimulatorLookahead(scene, horizon=3)
    monkeypatch.setattr(filter, "_margin", lambda: -1.0)
    monkeypatch.setattr(filter, "_outcome", lambda state, action: float(action[2]))  # up is best
    executed, retreated = filter(STILL)
    assert retreated and executed[2] > 0


def test_a_block_that_is_bound_to_fall_is_foreseen(scene):
    scene.reset(0)
    at = scene.block_qpos[1]
    scene.data.qpos[at : at + 3] = [0.48, 0.25, 0.11]
    scene.data.qpos[at + 3 : at + 7] = [np.cos(0.2), np.sin(0.2), 0, 0]  # tilted by 0.4: it falls
    assert SimulatorLookahead(scene, horizon=40)._outcome(scene.get_state(), STILL) < 0


@pytest.mark.parametrize(
    "margin, value, expected",
    [
        ([1, 1, 1, -1], [1, 0.3, -1, -1], 2),
        ([1, 1, -1, -1], [1, 1, 1, 0.1], -1),  # V warns late
        ([1, 1, -1, -1], [1, 1, 1, 1], -2),  # V never warns
        ([1, 1, 1, 1], [1, 0, 0, 0], None),  # l never sees it
    ],
)
def test_lead_counts_from_warning_to_failure(margin, value, expected):
    assert lead(np.array(margin), np.array(value), epsilon=0.3) == expected


@pytest.fixture
def trained(tiny_dreamer, tmp_path):
    """Filters of both kinds for a task policy, of untold quality."""
    from lerobot_latentsafe.training import train_reachability

    with tiny.short_blocks():
        episodes = tiny.metadata(tiny_dreamer / "episodes", "local/blocks_dreamer")
        for target in ("reachability", "risk"):
            train_reachability(tiny_dreamer / "policy/world_model", episodes, tmp_path / target, target=target)
        yield tmp_path


def test_the_table_is_written_and_goes_on_where_it_stopped(trained, tiny_dreamer, monkeypatch):
    cells, results = trained / "cells.jsonl", trained / "results"
    arguments = [
        str(SCRIPT), f"--dreamer={tiny_dreamer / 'policy'}", "--filters", str(trained / "reachability"), "--risks",
        str(trained / "risk"), "--n=2", "--n_curve=1", f"--cells={cells}", f"--output_dir={results}",
    ]  # fmt: skip
    monkeypatch.setattr(sys, "argv", arguments)
    monkeypatch.setattr(SimulatorLookahead.__init__, "__defaults__", (2,))  # its horizon
    monkeypatch.setattr(table2, "EPSILONS", (0.4,))
    monkeypatch.setattr(table2, "RISK_CURVE", (0.1,))
    spec = importlib.util.spec_from_file_location("blocks_table2", SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.main()
    table = json.loads((results / "table2.json").read_text())
    assert set(table["methods"]) == {"dreamer", "sqrl_0.1", "sqrl_0.05", "latentsafe", "lookahead"}
    for row in table["methods"].values():
        counts = [row[name] for name in ("success", "violation", "incompletion")]
        assert all(set(c) == {"k", "n", "low", "high"} and c["n"] == 2 for c in counts)
        assert row["stall"] == row["incompletion"]
        assert sum(c["k"] for c in counts) == 2 and len(row["per_seed"]) == 1
    assert (results / "trade_off.png").exists() and len(table["curves"]) == 3
    made = cells.read_text()
    script.main()
    assert made == cells.read_text()


def test_warnings_are_counted_where_it_fails_and_where_nothing_does():
    row = lambda failed, *value: {"violation": failed, "margin": [1, 1, 1, -failed], "value": value}  # noqa: E731
    rows = [row(True, 1, 0.3, -1, -1), row(True, 0.3, -1, -1, -1), row(False, 1, 1, 1, 1), row(False, 1, 0.1, 1, 1)]
    found = warnings_of(rows, "value", 0.3)
    assert (found["n"], found["median"], found["share_of_3_or_more"]) == (2, 2.5, 0.5)
    assert (found["false_alarms"]["k"], found["false_alarms"]["n"]) == (1, 2)
    assert "median" not in warnings_of(rows[2:], "value", 0.3)


def test_a_filter_that_looks_on_says_how_early_it_warns(trained, tiny_dreamer, tmp_path):
    watch(str(tiny_dreamer / "policy"), str(trained / "reachability"), 2, tmp_path / "warning.json")
    table = json.loads((tmp_path / "warning.json").read_text())
    rows = [json.loads(line)["row"] for line in (tmp_path / "warning.jsonl").read_text().splitlines()]
    for column in ("value", "foreseen"):
        assert list(table[column]["warnings"]) == ["0", "0.2", "0.4", "0.6"]
        assert all(len(row[column]) == len(row["margin"]) == row["steps"] for row in rows)
    assert all(row["value"] != row["foreseen"] for row in rows)
