"""The table of the bag's world models from end to end, on a few small recordings and two barely trained models."""

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.collection import franka
from lerobot_latentsafe.collection.franka import Source, collect_franka
from lerobot_latentsafe.datasets.build_cache import build_frame_cache
from lerobot_latentsafe.datasets.labels import read_frames
from lerobot_latentsafe.experiments.bag import world_models

CLOSED_END = (1, 0, 0, 0, 0, 0, 0)
SOURCES = {
    "tiny_branches": Source("bag", {"branch": 2, "rise": 1}, branches=3, grasps=CLOSED_END, seconds=4.6),
    "tiny_lifts": Source("bag", {"rise": 1}, branches=1, grasps=CLOSED_END, seconds=4.6),
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Folder of the recordings and their token caches; meanwhile pictures of the bag are small."""
    folder, basis = tmp_path_factory.mktemp("data"), {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(franka.SCENES, "bag", replace(franka.SCENES["bag"], image_size=32))
        patch.setattr(world_models, "HELD", {name: (f"tiny_{name}", 0) for name in ("branches", "lifts")})
        for source, what in SOURCES.items():
            patch.setitem(franka.SOURCES, source, what)
            root = folder / source.replace("tiny", "held")
            collect_franka(source, f"latentsafe/{root.name}", root, None, seed=0)
            dataset, tokens = LeRobotDataset(f"latentsafe/{root.name}", root=root), folder / f"{root.name}_tokens"
            build_frame_cache(dataset, tokens, tiny.TOKEN_SIZE, tiny.tokens(**basis))
            if not basis:  # one recording that is played again is enough
                np.save(folder / f"{root.name}_outside.npy", 2 * read_frames(root, ["failure"])["failure"].reshape(-1))
            basis = {"basis_from": folder / "held_branches_tokens"}
        yield folder


@pytest.fixture(scope="module")
def models(data, tmp_path_factory):
    meta, folder = (
        tiny.metadata(data / "held_branches_tokens", "latentsafe/held_branches_cache"),
        tmp_path_factory.mktemp("f"),
    )
    kinds = {"gru_a": tiny.gru_config(), "blind": tiny.gru_config(blind=True)}
    options = dict(fallback_action_candidates=None, trained_on_meanings={"gripper.pos": "other"})
    return {
        name: tiny.train_stage_one(meta, folder / name, 1, world_model=kind, **options) for name, kind in kinds.items()
    }


def run(monkeypatch, *options):
    path = Path(__file__).parents[1] / "scripts" / "bag_world_models.py"
    spec = importlib.util.spec_from_file_location("bag_world_models", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(sys, "argv", ["bag_world_models.py", *options])
    module.main()


def test_the_table_and_the_picture_are_made_of_recordings_played_again(data, models, tmp_path, monkeypatch):
    output, cost = tmp_path / "world_models.json", tmp_path / "cost.csv"
    cost.write_text("step,user_s,system_s\nworld_model_gru_a,59,1\n")
    pairs = [f"{name}={path}" for name, path in models.items()]
    run(monkeypatch, "--models", *pairs, f"--data={data}", f"--cost={cost}", f"--output={output}")
    table = json.loads(output.read_text())
    assert list(table["summary"]) == [*models, "gru_a, deaf", "copy of the last frame", "mean of the data"]
    row = table["summary"]["gru_a"]
    assert row["cpu_minutes"] == 1.0 and table["summary"]["blind"]["cpu_minutes"] is None
    assert row["fails_holding"]["n"] == sum(
        table[name]["gru_a"]["verdicts"]["hold_false_alarms"]["n"] for name in ("branches", "lifts")
    )
    assert table["branches"]["gru_a"]["counterfactual"] and table["lifts"]["gru_a"]["counterfactual"] is None
    outside = [np.load(data / f"held_{name}_outside.npy") for name in ("branches", "lifts")]
    few = sum(int(((n > 0) & (n <= 2)).sum()) for n in outside)
    assert (row["few_missed"] or {"n": 0})["n"] == few and output.with_suffix(".png").exists()


def test_another_recording_than_was_played_again_is_named(data):
    kept = data / "held_lifts_outside.npy"
    world_models.candies_outside("tiny_lifts", 0, data / "held_lifts")
    np.save(kept, 24 - np.load(kept))
    with pytest.raises(ValueError, match=r"held_lifts does not fail where episodes of tiny_lifts with seed 0 fail"):
        world_models.candies_outside("tiny_lifts", 0, data / "held_lifts")
    kept.unlink()


def test_a_model_without_a_name_is_refused(monkeypatch, capsys):
    with pytest.raises(SystemExit):
        run(monkeypatch, "--models", "outputs/final_0")
    assert "expected NAME=PATH of each" in capsys.readouterr().err
