import json
import os

import pytest
import torch

from lerobot_latentsafe.evaluation.statistics import wilson
from lerobot_latentsafe.experiments import demo as steps
from lerobot_latentsafe.experiments.dubins import demo


def metrics(seed, violations, commit="abc"):
    rates = {name: wilson(k, 10) for name, k in (("bare_violation", 9), ("bare_success", 1), ("shielded_success", 8))}
    spent = {"cpu_minutes": 2.0 + seed, "cpu_minutes_of": {"wrap": 0.1 * seed}}
    return {**rates, "shielded_violation": wilson(violations, 10), "seeds": [seed], "commit": commit, **spent}


@pytest.fixture
def ran(tmp_path):
    def write(*rows):
        folders = [tmp_path / str(i) for i in range(len(rows))]
        for folder, row in zip(folders, rows):
            folder.mkdir()
            (folder / "metrics.json").write_text(json.dumps(row))
        return folders

    return write


def test_demonstrations_are_pooled(ran, tmp_path):
    demo.pool_runs(ran(metrics(0, 0), metrics(2, 1)), tmp_path / "demo.json")
    table = json.loads((tmp_path / "demo.json").read_text())
    assert table["shielded_violation"] == wilson(1, 20) and table["bare_violation"]["k"] == 18
    assert table["cpu_minutes"] == 6.0 and table["mean_cpu_minutes"] == 3.0
    assert table["mean_cpu_minutes_of"] == {"wrap": 0.1}
    assert table["seeds"] == [0, 2] and table["commit"] == "abc" and len(table["runs"]) == 2


@pytest.mark.parametrize("rows", [(metrics(0, 0), metrics(0, 1)), (metrics(0, 0), metrics(1, 1, commit="def"))])
def test_what_does_not_belong_together_is_not_pooled(ran, tmp_path, rows):
    with pytest.raises(ValueError, match="expected each seed once, all of one commit"):
        demo.pool_runs(ran(*rows), tmp_path / "demo.json")
    assert not (tmp_path / "demo.json").exists()


def test_the_bar_knows_all_steps(tmp_path, monkeypatch):
    """Each step is run by its seed, and stands in the table of usual minutes."""
    ran = {}
    monkeypatch.setattr(demo.DubinsDemo, "run", lambda self, what, *command: ran.update({what.split(":")[0]: command}))
    shown = demo.DubinsDemo(tmp_path / "demo", seed=7)
    shown.shield(shown.filter(), shown.reckless(), 0.5, 60)
    assert set(ran) == set(demo.USUAL_MINUTES)
    seeded = {step for step, command in ran.items() if {"--seed=7", "--seeds=[7]"} & set(command)}
    assert {step for step in ran if step.split()[0] in ("collect", "train", "fit", "reachability")} == seeded


def test_a_command_may_have_a_variable_of_its_environment_before_it(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("import os; print('precision is', os.environ['ACCELERATE_MIXED_PRECISION'])")
    shown = steps.Demo(tmp_path / "demo")
    shown.run("train", *steps.MIXED_PRECISION, "python", str(script))
    assert "precision is bf16" in (tmp_path / "demo/logs/train.log").read_text()
    assert "ACCELERATE_MIXED_PRECISION" not in os.environ


@pytest.mark.parametrize("able", [{}, {"avx512_bf16": True}, {"amx_bf16": True}])
def test_16_bits_are_for_processors_that_are_quick_at_them(able, monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: able)
    assert steps.in_16_bits() == (steps.MIXED_PRECISION if able else ())
