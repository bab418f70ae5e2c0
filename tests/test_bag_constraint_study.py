"""The study of a new constraint on the bag: the places, what is marked, one short run, and the table."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lerobot_latentsafe.constraints import ConstraintError, LikenessConfig
from lerobot_latentsafe.experiments.assurance import bag_constraint as study_module
from lerobot_latentsafe.experiments.assurance.bag_constraint import CASES, PLACES, mark, run, study
from lerobot_latentsafe.franka.actions import STATE_NAMES

ALIKE = {number: 0.05 for place in PLACES.values() for number in place.between}
((NUMBER, (LINE, _)),) = PLACES["zone"].between.items()


def states(x):
    found = np.zeros((len(x), len(STATE_NAMES)), np.float32)
    found[:, STATE_NAMES.index(NUMBER)] = x
    return found


def test_the_zone_is_far_from_the_foot():
    assert PLACES["zone"].holds(states([LINE + 0.01, LINE - 0.01])).tolist() == [True, False]


def test_only_what_is_held_can_be_too_high():
    hand = np.zeros((3, len(STATE_NAMES)))
    hand[:, [STATE_NAMES.index("ee_z.pos"), STATE_NAMES.index("gripper.pos")]] = [0.25, 0.6], [0.25, 0.85], [0.15, 0.6]
    assert PLACES["too high"].holds(hand).tolist() == [True, False, False]


def test_what_is_marked_lies_in_the_zone(monkeypatch, tmp_path):
    """Of recordings that begin in the zone, or hardly enter it, nothing is marked."""
    ways = (0.46, 0.66), (0.66, 0.46), (0.46, 0.561), (0.48, 0.61)
    paths = [np.linspace(*way, 20) for way in ways]
    whole, episode = states(np.concatenate(paths)), np.repeat(np.arange(4), 20)
    columns = {"observation.state": whole, "episode_index": episode}
    monkeypatch.setattr(study_module, "load_metadata", lambda name, root: None)
    monkeypatch.setattr(study_module, "DatasetFrames", lambda meta: SimpleNamespace(episodes=[0, 1, 2, 3]))
    monkeypatch.setattr(study_module, "read_frames", lambda root, names: columns)

    def encoded(model, frames, some):
        return torch.from_numpy(np.stack([states(paths[i]) for i in some])), [20] * len(some)

    monkeypatch.setattr(study_module, "encode_episodes", encoded)
    model = SimpleNamespace(
        world_model=SimpleNamespace(features=lambda latents: latents),
        likeness=lambda features: features[..., [STATE_NAMES.index(NUMBER)]] / 0.05,
    )
    policy = SimpleNamespace(model=model, config=SimpleNamespace(likeness=LikenessConfig({NUMBER: 0.05})))
    (prototype,) = mark(policy, tmp_path, PLACES["zone"])
    where, reach = prototype[NUMBER]
    assert where - reach == pytest.approx(LINE, abs=0.02) and where + reach > 0.61


@pytest.mark.parametrize("alike", [{}, {"x.pos": 0.25}])
def test_a_filter_that_does_not_say_where_the_hand_is_is_refused(alike, monkeypatch, tmp_path):
    loaded = SimpleNamespace(config=SimpleNamespace(likeness=LikenessConfig(alike)))
    monkeypatch.setattr(study_module, "loaded", lambda path: loaded)
    with pytest.raises(ConstraintError, match=r"--filter mine says nothing of .*ee_z\.pos.* --alike"):
        study("mine", tmp_path, 1, tmp_path / "table.json")


def test_recordings_that_never_go_there_are_refused(monkeypatch, tmp_path):
    columns = {"observation.state": states(np.full(20, LINE - 0.1)), "episode_index": np.zeros(20, int)}
    monkeypatch.setattr(study_module, "load_metadata", lambda name, root: None)
    monkeypatch.setattr(study_module, "DatasetFrames", lambda meta: SimpleNamespace(episodes=[0]))
    monkeypatch.setattr(study_module, "read_frames", lambda root, names: columns)
    with pytest.raises(ConstraintError, match=r"no episode of .* begins elsewhere and goes where"):
        mark(SimpleNamespace(), tmp_path, PLACES["zone"])


@pytest.mark.parametrize("place", PLACES)
def test_a_bare_run_tells_what_became_of_it(place, monkeypatch):
    monkeypatch.setattr(study_module, "STEPS", 2)
    ran = run({"place": place, "constraints": None, "seed": 0})
    assert ran == {"entered": False, "lost": 0, "success": False, "changed": 0}


def test_the_table_has_all_cases(monkeypatch, tmp_path):
    loaded = SimpleNamespace(
        config=SimpleNamespace(law=SimpleNamespace(name="reachability"), likeness=LikenessConfig(ALIKE))
    )
    monkeypatch.setattr(study_module, "loaded", lambda path: loaded)
    monkeypatch.setattr(study_module, "mark", lambda policy, root, place: [])
    row = {"entered": True, "lost": 1, "success": False, "changed": 9}
    monkeypatch.setattr(study_module, "run", lambda job: row)
    output = tmp_path / "constraints_bag.json"
    study("filter", tmp_path, 2, output)
    summary = json.loads(output.read_text())["summary"]
    assert {*summary} == {*PLACES}
    for of in summary.values():
        assert {*of} == {*CASES} and of["bare"]["entered"]["k"] == 2
        assert of["with it"]["changed_share"] == pytest.approx(0.1)
