"""What the script of kills types is understood, what it compares tells runs apart, and what is lost it finds."""

import json
import shutil
import sys
import time
from pathlib import Path

import draccus
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.configs.train import TrainPipelineConfig

from lerobot_latentsafe.cli import command_line, main
from lerobot_latentsafe.collection.whole_episodes import COMPLETE
from lerobot_latentsafe.datasets.layout import INFO
from lerobot_latentsafe.experiments.kills.courses import Course, Labelling, LeRobotTraining, Pushing, Recording
from lerobot_latentsafe.experiments.kills.files import differences, left_by
from lerobot_latentsafe.experiments.kills.measurement import kills, with_rows
from lerobot_latentsafe.experiments.kills.verbs import DEMONSTRATIONS, VERBS, Verb
from lerobot_latentsafe.labeling.store import LabelStore

forks = pytest.mark.skipif(sys.platform == "win32", reason="needs fork")


@pytest.mark.parametrize("name", VERBS)
def test_what_is_typed_is_understood(name, tmp_path):
    verb, *options = VERBS[name].words(tmp_path / "made", tmp_path)
    if verb == "lerobot-train":
        assert draccus.parse(TrainPipelineConfig, args=options).save_freq == 1
        return
    assert command_line.parsed(verb, options)


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
    training = LeRobotTraining(tmp_path)
    assert "last/pretrained_model" in training.again([])[1]
    (checkpoints / "last").unlink()
    assert "000002/pretrained_model" in training.again([])[1]
    shutil.rmtree(checkpoints / "000001")
    shutil.rmtree(checkpoints / "000002")
    assert training.again(["typed"]) == ["typed"] and not (tmp_path / "out").exists()


def test_statistics_may_round_otherwise_and_nothing_else():
    one, other = {"a": {"std": [0.1]}}, {"a": {"std": [0.1 + 1e-9]}}
    assert differences({"meta/stats.json": one}, {"meta/stats.json": other}) == []
    for name, third in (("data.json", other), ("meta/stats.json", {"a": {"std": [0.2]}}), ("meta/stats.json", None)):
        assert differences({name: one}, {name: third}) == [name]


def say(root, episodes):
    (root / INFO).parent.mkdir(parents=True)
    (root / INFO).write_text(json.dumps({"total_episodes": episodes}))


def test_a_recording_goes_on_with_the_episodes_that_are_missing(tmp_path):
    typed, recording = ["record", "--dataset.num_episodes=5", "--x=1"], Recording(tmp_path)
    assert recording.again(typed) == typed
    for root, saved in ((tmp_path / "out", 2), (tmp_path / "out" / COMPLETE, 3)):
        say(root, saved)
        assert recording.again(typed)[1:] == ["--x=1", f"--dataset.num_episodes={5 - saved}", "--resume=true"]


def test_a_saved_episode_that_is_gone_or_not_the_same_is_lost(tmp_path):
    say(tmp_path / "out", 2)
    whole = {f"data/file-00{episode}.json": [episode] for episode in range(3)}
    for name, said in whole.items():
        (tmp_path / "out" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "out" / name).write_text(json.dumps(said))
    (tmp_path / "out" / "data/file-002.json").unlink()
    assert Recording(tmp_path).lost(whole) == []
    (tmp_path / "out" / "data/file-000.json").unlink()
    (tmp_path / "out" / "data/file-001.json").write_text("[7]")
    assert Recording(tmp_path).lost(whole) == ["data/file-000.json", "data/file-001.json"]


def test_an_answer_that_was_confirmed_and_is_not_there_is_lost(tmp_path, dataset_root):
    shutil.copytree(dataset_root, tmp_path / "out")
    labelling = Labelling(tmp_path)
    assert labelling.lost({}) == []
    store = LabelStore(tmp_path / "out", Labelling.REPO, [Labelling.SPECIFICATION])
    for episode, first in labelling.answers[:4]:
        store.label(Labelling.SPECIFICATION, episode, first, "somebody")
    for labelling.confirmed in (3, 4):  # the fourth was saved, confirmed or not
        assert labelling.lost({}) == []
    store.label(Labelling.SPECIFICATION, 1, None, "somebody")
    store.close()
    assert labelling.lost({}) == ["the answer on episode 1"]


def test_a_push_is_there_whole_or_not_at_all(tmp_path):
    with Pushing(tmp_path) as pushing:
        whole = {"me/filter/README.md": b"card", "me/filter/weights": b"1"}
        assert pushing.lost(whole) == []
        pushing.hub.repos["me/filter"] = {"README.md": b"card"}
        assert pushing.lost(whole) == ["me/filter/weights"]
        pushing.hub.repos["me/filter"]["weights"] = b"1"
        assert pushing.lost(whole) == []
    assert left_by(tmp_path / "out") == whole


def test_rows_of_verbs_that_are_not_measured_stay_with_their_commit():
    known = {
        "verbs": {"push": {"equal": 1}, "cache": {"equal": 2}, "record": {"equal": 3, "commit": "b"}},
        "commit": "a",
    }
    table = with_rows(known, {"cache": {"equal": 20, "commit": "c"}})
    assert list(table) == ["record", "cache", "push"]
    assert {name: (row["equal"], row["commit"]) for name, row in table.items()} == {
        "record": (3, "b"), "cache": (20, "c"), "push": (1, "a"),
    }  # fmt: skip
    assert with_rows({}, {}) == {}


def write(words):
    """A verb that is quickly done."""
    time.sleep(0.1)
    Path(words[1], "out").mkdir(exist_ok=True)
    Path(words[1], "out", "a").write_text("done")


class Losing(Course):
    def lost(self, whole):
        return ["everything"]


@forks
def test_runs_are_killed_started_again_and_compared(tmp_path):
    for course, equal in ((Course, 2), (Losing, 0)):
        verb, folder = Verb("write {out}", course=course), tmp_path / course.__name__
        row = kills(verb, tmp_path, folder, 2, np.random.default_rng(0), write)
        assert (row["kills"], row["equal"], len(row["wrong"])) == (2, equal, 2 - equal)
        assert all(wrong["lost"] == ["everything"] and wrong["differs"] == [] for wrong in row["wrong"])


@forks
def test_a_killed_labelling_page_has_what_it_confirmed(tmp_path, dataset_root, capfd):
    shutil.copytree(dataset_root, tmp_path / "made" / DEMONSTRATIONS)
    with capfd.disabled():  # the address is read where it is printed
        row = kills(VERBS["label"], tmp_path / "made", tmp_path / "work", 1, np.random.default_rng(0), main)
    assert row["equal"] == 1, row["wrong"]
