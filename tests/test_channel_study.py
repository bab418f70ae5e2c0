"""The study of the critic: the channel, its exact value, and the whole run of a small filter."""

import json

import numpy as np

from lerobot_latentsafe.collection.dubins import collect_dubins
from lerobot_latentsafe.datasets.build_cache import build_frame_cache
from lerobot_latentsafe.datasets.folder import open_dataset
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.experiments.assurance import channel, constraints
from lerobot_latentsafe.experiments.assurance.channel import BEND, CHANNEL, LAWS, WAVES, middle, study


def test_the_car_can_follow_the_channel():
    assert BEND * WAVES**2 <= car.MAX_TURN_RATE / car.SPEED


def test_walls_are_forbidden_and_the_middle_is_not():
    x = np.linspace(-1, 1, 9)
    on = np.stack([x, middle(x), 0 * x], -1)
    assert (CHANNEL.margin(on) > 0).all()
    assert (CHANNEL.margin(np.concatenate([CHANNEL.aims, 0 * CHANNEL.aims[:, :1]], -1)) < 0).all()


def test_no_held_action_saves_where_the_channel_bends():
    """From its middle, along it: exact value iteration finds a way, and holding an action does not."""
    truth = constraints.Truth(CHANNEL)
    start = np.array([-0.8, middle(-0.8), np.arctan(BEND * WAVES * np.cos(WAVES * -0.8))])
    nearest = np.linalg.norm((truth.states - start) / [1, 1, 3], axis=-1).argmin()
    assert truth.value[nearest] > 0
    for rate in car.TURN_RATES:
        states, worst = start[None], np.inf
        for _ in range(44):
            states = car.step(states, rate)
            worst = min(worst, CHANNEL.margin(states)[0] if car.in_view(states)[0] else np.inf)
        assert worst < 0


def test_the_study_runs(monkeypatch, tiny_filter, tmp_path):
    for name, size in {"N_STATES": 20, "N_RUNS": 3, "RUN": 3}.items():
        monkeypatch.setattr(channel, name, size)
    for module in (channel, constraints):
        monkeypatch.setattr(module, "GRID", 21)
    monkeypatch.setattr(constraints, "RUN", 3)
    monkeypatch.setattr(constraints, "HEADINGS", 8)
    monkeypatch.setattr(constraints, "smaller", lambda policy: policy.config.change(frame_cache=None))
    root = tmp_path / "located"
    collect_dubins("random_located", "latentsafe/car_located", root, n_episodes=14, seed=3)
    build_frame_cache(open_dataset("latentsafe/car_located", root), tmp_path / "cache", 32)
    output = tmp_path / "critic.json"
    study(str(tiny_filter), tmp_path / "cache", tmp_path / "filters", [0], 2, output)
    summary = json.loads(output.read_text())["summary"]
    assert {*summary} == {"bare", *LAWS} and output.with_suffix(".png").exists()
    assert summary["plan"]["verdicts"]["seeds"]["balanced_accuracy"] and summary["plan"]["fallback"]["n"] == 3
