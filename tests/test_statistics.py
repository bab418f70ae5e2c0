"""Experiments that go on where they were killed, and how their numbers are kept."""

import json
from multiprocessing.pool import ThreadPool
from types import SimpleNamespace

import numpy as np
import pytest

from lerobot_latentsafe.evaluation import statistics
from lerobot_latentsafe.evaluation.statistics import paired_p_value, run_resumable, write_json

JOBS = [{"seed": seed, "filter": None} for seed in (3, 1, 2)]


def square(job):
    return {"lost": job["seed"] ** 2}


def lost(rows):
    return [row["lost"] for row in rows]


def test_a_killed_experiment_goes_on(tmp_path):
    path, ran = tmp_path / "new" / "runs.jsonl", []

    def killed(job):
        ran.append(job["seed"])
        if len(ran) == 3:
            raise KeyboardInterrupt
        return square(job)

    with pytest.raises(KeyboardInterrupt):
        run_resumable(path, JOBS, killed)
    with path.open("a") as stream:
        stream.write('{"job": {"seed": 2, "fil')  # the power went while this was written
    assert lost(run_resumable(path, JOBS, killed)) == [9, 1, 4] and ran == [3, 1, 2, 2]
    assert lost(run_resumable(path, JOBS, killed)) == [9, 1, 4] and len(ran) == 4
    assert [json.loads(line)["job"]["seed"] for line in path.read_text().splitlines()] == [3, 1, 2]


def test_a_run_of_other_weights_is_not_taken_for_its_own(tmp_path):
    path = tmp_path / "runs.jsonl"
    run_resumable(path, JOBS, square)
    retrained = [{**job, "filter": {"fingerprint": "b"}} for job in JOBS]
    assert lost(run_resumable(path, retrained, lambda job: {"lost": 0})) == [0, 0, 0]


def test_workers_share_the_runs(tmp_path, monkeypatch):
    """Threads here: starting processes takes longer than all other tests of this file."""
    monkeypatch.setattr(statistics, "get_context", lambda method: SimpleNamespace(Pool=ThreadPool))
    rows = run_resumable(tmp_path / "runs.jsonl", JOBS, square, workers=2)
    assert lost(rows) == [9, 1, 4] and all(row["cpu_s"] >= 0 for row in rows)


def test_pairs_that_agree_say_nothing():
    first, second = np.array([1, 1, 1, 1, 1, 1, 0]), np.array([0, 0, 0, 0, 0, 0, 0])
    assert paired_p_value(first, second) == pytest.approx(2 / 2**6)
    assert paired_p_value(first, first) == 1.0


def test_lists_of_numbers_take_one_line(tmp_path):
    content = {
        "lost": [1, 2, 3],
        "value": [0.5, -0.25, float("inf")],
        "nested": {"names": ["a [1]", "b"], "rows": [{}]},
    }
    write_json(tmp_path / "row.json", content)
    text = (tmp_path / "row.json").read_text()
    assert json.loads(text) == content and '"lost": [1, 2, 3]' in text
    write_json(tmp_path / "row.json", {"verdicts": float("nan")})
    assert json.loads((tmp_path / "row.json").read_text()) == {"verdicts": None}
