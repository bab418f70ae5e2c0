"""`latentsafe bench`: what each part of a tick takes, with each engine."""

import json

import numpy as np
import pytest
import tiny

from lerobot_latentsafe.cli.bench import Bench
from lerobot_latentsafe.cli.places import PolicySource
from lerobot_latentsafe.evaluation.tick_time import TickTimes


def test_bench_prints_and_writes_every_part_of_each_engine(tmp_path, capsys):
    pytest.importorskip("onnxruntime")
    tiny.save_arm_filter(tmp_path / "filter")
    Bench(PolicySource(str(tmp_path / "filter")), fps=1000.0, n_ticks=10, json=tmp_path / "bench.json").run()
    engines = json.loads((tmp_path / "bench.json").read_text())["engines"]
    printed = capsys.readouterr().out
    for engine in ("torch", "onnx"):
        parts = engines[engine]["parts"]
        assert {"encode", "imagine", "nearest action", "all"} <= parts.keys()
        assert 0 < parts["imagine"]["median_ms"] <= parts["all"]["p99_ms"] and 0 <= engines[engine]["late"] <= 1
        assert f"law.engine={engine}" in printed


def test_without_onnx_runtime_torch_alone_is_measured(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    tiny.save_arm_filter(tmp_path / "filter")
    Bench(PolicySource(str(tmp_path / "filter")), fps=1000.0, n_ticks=10, json=tmp_path / "bench.json").run()
    assert json.loads((tmp_path / "bench.json").read_text())["engines"].keys() == {"torch"}


def test_slow_ticks_are_taken_apart():
    encode = np.full(200, 0.01)
    encode[7] = 0.08
    times = TickTimes(1 / 15, {"encode": encode, "all": encode + 0.005})
    assert times.late == 1 / 200
    slow = times.summary()["encode"]
    assert slow["median_ms"] == pytest.approx(10) and slow["in_the_slowest_ms"] == pytest.approx(45)


@pytest.mark.parametrize("changes", [{"n_ticks": 3}, {"fps": 0.0}, {"fps": float("nan")}, {"base_ahead": -1}])
def test_what_cannot_be_measured_is_refused(changes):
    with pytest.raises(ValueError, match="expected"):
        Bench(PolicySource("bag"), **changes)
