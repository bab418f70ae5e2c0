"""What the script of kills types is understood, and what it compares tells runs apart."""

import shutil

import draccus
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.configs.train import TrainPipelineConfig

from lerobot_latentsafe.cli import VERBS as COMMANDS
from lerobot_latentsafe.cli import command_line
from lerobot_latentsafe.experiments import kills
from lerobot_latentsafe.experiments.kills import VERBS, differences, left_by


@pytest.mark.parametrize("name", VERBS)
def test_what_is_typed_is_understood(name, tmp_path):
    verb, *options = VERBS[name].typed.format(made=tmp_path / "made", out=tmp_path).split()
    if verb == "lerobot-train":
        assert draccus.parse(TrainPipelineConfig, args=options).save_freq == 1
        return
    entry = COMMANDS[verb]
    assert command_line.parsed(verb, getattr(__import__(entry.module, fromlist=[entry.name]), entry.name), options)


def test_runs_that_left_the_same_are_told_from_others(tmp_path):
    for name, value in (("one", 1), ("other", 1), ("third", 2)):
        folder = tmp_path / name / "labels"
        folder.mkdir(parents=True)
        pq.write_table(pa.table({"failure": [value], "labelled_at": [len(name)]}), folder / "x.parquet")
        (tmp_path / name / "log.jsonl").write_text(f'{{"step": 1, "cpu_s": {len(name)}}}\n')
    one, other, third = (left_by(tmp_path / name) for name in ("one", "other", "third"))
    assert differences(one, other) == [] and differences(one, third) == ["labels/x.parquet"]
    assert differences(one, {**other, "left.partial": b""}) == ["left.partial"]


def test_lerobots_training_goes_on_from_its_last_whole_checkpoint(tmp_path):
    checkpoints = tmp_path / "out" / "checkpoints"
    for step in ("000001", "000002", "000003"):
        (checkpoints / step / "pretrained_model").mkdir(parents=True)
        (checkpoints / step / "pretrained_model" / "train_config.json").touch()
    (checkpoints / "last").symlink_to("000002")
    assert "last/pretrained_model" in kills._resumed_training(tmp_path)[1]
    (checkpoints / "last").unlink()
    assert "000002/pretrained_model" in kills._resumed_training(tmp_path)[1]
    shutil.rmtree(checkpoints / "000001")
    shutil.rmtree(checkpoints / "000002")
    assert kills._resumed_training(tmp_path) == [] and not (tmp_path / "out").exists()
