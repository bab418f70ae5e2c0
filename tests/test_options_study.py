"""The study of training options: what is trained, who is driven under what, and the table."""

import json

import pytest

from lerobot_latentsafe.experiments.assurance import laws
from lerobot_latentsafe.experiments.assurance import training_options as study_module
from lerobot_latentsafe.experiments.assurance.training_options import OPTIONS, jobs_of, study, train
from lerobot_latentsafe.modeling_latentsafe import load_filter


def test_a_filter_is_trained_by_its_options_and_keeps_its_law(tiny_world_model, cache_meta, tmp_path):
    train(tiny_world_model, cache_meta, {"gradient_penalty": 0.5}, 0, tmp_path / "made")
    made, base = load_filter(tmp_path / "made").config, load_filter(tiny_world_model).config
    assert made.margin.gradient_penalty == 0.5 and made.reachability.hinge == 0 and made.law == base.law


def test_a_hinge_needs_recordings_that_tell_what_succeeds(tiny_world_model, cache_meta, tmp_path):
    with pytest.raises(ValueError, match=r"has no column next\.success"):
        train(tiny_world_model, cache_meta, {"hinge": 1.0}, 0, tmp_path / "made")
    assert not (tmp_path / "made").exists()


def test_all_are_driven_bare_and_under_both_laws(tiny_filter):
    jobs = jobs_of({"hinge": tiny_filter}, ["closed_end"], None)
    assert [*jobs] == [("closed_end", "bare", "bare"), *(("closed_end", "hinge", law) for law in laws.LAWS)]
    assert [job["filter"] and job["filter"]["law"] for job in jobs.values()] == [None, *laws.LAWS]
    json.dumps([*jobs.values()])


def test_the_table_has_a_cell_for_each(monkeypatch, tiny_filter, tmp_path):
    row = {"violation": True, "success": False, "stall": False}
    monkeypatch.setattr(study_module, "load_metadata", lambda name, root: None)
    monkeypatch.setattr(study_module, "train", lambda path, meta, options, seed, folder: folder.symlink_to(tiny_filter))
    monkeypatch.setattr(study_module, "run", lambda job: row)
    output = tmp_path / "options.json"
    study("bag", tmp_path, ["hinge"], ["closed_end"], None, 2, 0, tmp_path, output)
    table = json.loads(output.read_text())
    cells = table["summary"]["closed_end"]
    assert {*cells} == {"bare", "hinge"} and {*cells["hinge"]} == {*laws.LAWS} and table["options"] == OPTIONS
    assert cells["bare"]["bare"]["violation"]["k"] == 2
