"""The study of training options: what is trained, who is driven under what, and the table."""

import json

import pytest

from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.experiments.assurance import laws
from lerobot_latentsafe.experiments.assurance import training_options as study_module
from lerobot_latentsafe.experiments.assurance.training_options import OPTIONS, Drivers, jobs_of, study, train
from lerobot_latentsafe.experiments.filter_settings import FilterSetting
from lerobot_latentsafe.modeling_latentsafe import load_filter


def test_a_filter_is_trained_by_its_options_and_keeps_its_law(tiny_world_model, cache_meta, tmp_path):
    train(tiny_world_model, cache_meta, {"gradient_penalty": 0.5}, 0, tmp_path / "made")
    made, base = load_filter(tmp_path / "made").config, load_filter(tiny_world_model).config
    assert made.margin.gradient_penalty == 0.5 and made.reachability.hinge == 0 and made.law == base.law


def test_a_hinge_needs_recordings_that_tell_what_succeeds(tiny_world_model, cache_meta, tmp_path):
    with pytest.raises(ValueError, match=r"has no column next\.success"):
        train(tiny_world_model, cache_meta, {"hinge": 1.0}, 0, tmp_path / "made")
    assert not (tmp_path / "made").exists()


def test_all_are_driven_bare_and_under_a_filter(tiny_filter):
    setting = FilterSetting.of(str(tiny_filter), LawOptions(name="nearest"))
    bag = jobs_of([None, setting], Drivers("bag", ["closed_end"], {"mixed": str(tiny_filter)}), 2)
    assert {who: len(jobs) for who, jobs in bag.items()} == {"closed_end": 4, "mixed": 4}
    car = jobs_of([None, setting], Drivers("car", [], {"reckless": str(tiny_filter)}), 2)
    assert [(job["filter"] and job["filter"]["law"], job["n"]) for job in car["reckless"]] == [
        (None, 2),
        ("nearest", 2),
    ]
    json.dumps([bag, car])


def test_the_table_has_a_cell_for_each_and_keeps_other_rows(monkeypatch, tiny_filter, tmp_path):
    row = {"violation": True, "success": False, "stall": False}
    monkeypatch.setattr(study_module, "load_metadata", lambda name, root: None)
    monkeypatch.setattr(study_module, "train", lambda path, meta, options, seed, folder: folder.symlink_to(tiny_filter))
    monkeypatch.setattr(study_module, "run", lambda job: {"episodes": [row] * job.get("n", 1)})
    output = tmp_path / "options.json"
    for drivers, seeds in ((Drivers("bag", ["closed_end"], {}), [0]), (Drivers("car", [], {"fast": "bag"}), [0, 1])):
        study("bag", tmp_path, ["hinge"], drivers, 2, seeds, tmp_path, output)
    table = json.loads(output.read_text())
    assert {*table["summary"]} == {"closed_end", "fast"} and table["options"] == OPTIONS
    assert table["runs"]["closed_end"]["seeds"] == [0] and table["runs"]["fast"]["seeds"] == [0, 1]
    cells = table["summary"]["fast"]
    assert {*cells} == {"bare", "hinge"} and {*cells["hinge"]} == {*laws.LAWS}
    assert cells["bare"]["bare"]["violation"]["n"] == 2 and cells["hinge"]["nearest"]["violation"]["n"] == 4
