"""The study of constraints: what is marked in recordings, the driver, and the whole run of small filters."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lerobot_latentsafe.collection.dubins import collect_dubins
from lerobot_latentsafe.constraints import LikenessConfig
from lerobot_latentsafe.datasets.build_cache import build_frame_cache
from lerobot_latentsafe.datasets.folder import open_dataset
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.experiments.assurance import constraints as study_module
from lerobot_latentsafe.experiments.assurance.constraints import (
    ALIKE,
    CASES,
    METHODS,
    RECORDINGS,
    Truth,
    drive,
    mark,
    reckless,
    recordings,
    study,
)


@pytest.fixture
def small(monkeypatch):
    for name, size in {"GRID": 15, "HEADINGS": 8, "N_STATES": 20, "N_RUNS": 3, "RUN": 3, "HORIZON": 2}.items():
        monkeypatch.setattr(study_module, name, size)


class SeesAll:
    """A monitor of a filter that knows where the car is."""

    model = SimpleNamespace(
        config=SimpleNamespace(likeness=LikenessConfig(ALIKE)),
        world_model=SimpleNamespace(features=lambda latent: latent["state"]),
        likeness=lambda features: features[..., :2] / 0.25,
    )

    def latent(self, states):
        return {"state": torch.from_numpy(states)}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("pictures", [True, False])
def test_what_is_marked_lies_in_what_is_forbidden(name, pictures):
    case = CASES[name]
    found = mark(SeesAll(), case, recordings(400, RECORDINGS), pictures)
    assert [*found] == [*case.zones] and all(1 <= len(of) <= 5 for of in found.values())
    for constraint, prototypes in found.items():
        for prototype in prototypes:
            state = [[prototype[number][0] if number in prototype else 0.0 for number in ALIKE] + [0.0]]
            assert case.zones[constraint](np.array(state))[0] < 0


def test_reckless_drivers_turn_to_the_nearest_place():
    states = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert reckless(states, np.array([[0.5, 0.5], [-3.0, -3.0]])).tolist() == [car.MAX_TURN_RATE] * 2


def test_truth_knows_what_is_lost(small):
    truth = Truth(CASES["two discs"])
    assert (truth.value <= CASES["two discs"].margin(truth.states) + 1e-9).all()
    states, value = truth.sample(5, 0)
    assert states.shape == (5, 3) and value.shape == (5,)


def test_a_bare_driver_gets_there(small, monkeypatch):
    monkeypatch.setattr(study_module, "RUN", 60)
    ran = drive(None, CASES["a disc elsewhere"], np.array([[-0.6, 0.35, 0.0]]))
    assert ran["failed"].all() and ran["changed"].tolist() == [0.0]


def test_the_study_runs(small, monkeypatch, tiny_filter, tmp_path):
    root = tmp_path / "located"
    collect_dubins("random_located", "latentsafe/car_located", root, n_episodes=14, seed=3)
    build_frame_cache(open_dataset("latentsafe/car_located", root), tmp_path / "cache", 32)
    prototypes = {"zone": [{"x.pos": [0.4, 0.3], "y.pos": [0.3, 0.3]}]}
    monkeypatch.setattr(study_module, "ALIKE", {"x.pos": 8.0, "y.pos": 8.0})  # the least world model tells that
    monkeypatch.setattr(study_module, "mark", lambda *given: prototypes)
    monkeypatch.setattr(study_module, "smaller", lambda policy: policy.config.change(frame_cache=None))
    output = tmp_path / "constraints.json"
    study(str(tiny_filter), tmp_path / "cache", tmp_path / "filters", ["a disc elsewhere"], [0], 5, output)
    found = json.loads(output.read_text())["summary"]
    assert {*found["balanced_accuracy"]} == {*METHODS} and found["points_from_dedicated"]["dedicated"] == 0
    assert found["violation"]["conditioned"]["n"] == 3 and output.with_suffix(".png").exists()
