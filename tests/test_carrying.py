"""Labels of datasets that LeRobot joined or cut: each episode keeps its own, and no other's."""

import shutil

import numpy as np
import pytest
import tiny
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.cli import main
from lerobot_latentsafe.datasets.labels import FailureLabels, LabelFileError, UnlabelledDatasetError
from lerobot_latentsafe.labeling.carrying import carry_labels, specifications_in
from lerobot_latentsafe.labeling.store import LabelStore


@pytest.fixture(scope="module")
def cut(dataset_root, tmp_path_factory):
    """The car's episodes in two datasets, both labelled, and folders for what is made of them."""
    folder = tmp_path_factory.mktemp("cut")
    whole = LeRobotDataset(tiny.REPO_ID, root=shutil.copytree(dataset_root, folder / "whole"))
    gone = {"first": range(3, 14), "second": [0, 1, 2, *range(6, 14)]}
    parts = [delete_episodes(whole, [*e], folder / name, f"me/{name}") for name, e in gone.items()]
    for part, firsts in zip(parts, [(2, 1, 3), (4, 0, 2)]):
        store = LabelStore(part.root, part.repo_id, ["spilled"])
        for episode, first in enumerate(firsts):
            store.label("spilled", episode, first, "ann")
        store.close()
    return folder, parts


def found(root, repo_id="me/joined"):
    store = LabelStore(root, repo_id, ["spilled"])
    verdicts = [store.verdict("spilled", e).first for e in range(len(store))]
    store.close()
    return verdicts


def test_labels_follow_a_merge_in_any_order(cut, tmp_path, capsys):
    _, (first, second) = cut
    merge_datasets([second, first], "me/joined", tmp_path / "joined")
    assert not (tmp_path / "joined" / "labels").exists()
    main(["carry-labels", f"--sources=[{first.root},{second.root}]", "--dataset.repo_id=me/joined",
          f"--dataset.root={tmp_path / 'joined'}"])  # fmt: skip
    assert "spilled: 6 episodes have new labels; 6 of 6 are labelled" in capsys.readouterr().out
    assert found(tmp_path / "joined") == [4, 0, 2, 2, 1, 3]
    main(["carry-labels", f"--sources=[{first.root}/labels]", "--dataset.repo_id=me/joined",
          f"--dataset.root={tmp_path / 'joined'}"])  # fmt: skip
    assert "0 episodes have new labels" in capsys.readouterr().out


def test_a_merge_without_labels_says_where_they_are(cut):
    folder, (first, second) = cut
    merge_datasets([first, second], "me/joined", folder / "joined")
    with pytest.raises(UnlabelledDatasetError, match=r"first/labels, .*second/labels; carry the labels over"):
        FailureLabels.load(folder / "joined", "spilled")


def test_labels_follow_a_deletion(cut, tmp_path):
    _, (first, _) = cut
    delete_episodes(first, [1], tmp_path / "less", "me/less")
    shutil.copytree(first.root / "labels", tmp_path / "less" / "labels")
    assert found(tmp_path / "less", "me/less") == [2, 3]
    (aside,) = (tmp_path / "less" / "labels").glob("spilled.*.parquet")
    assert np.array_equal(aside.read_bytes(), (first.root / "labels/spilled.parquet").read_bytes())


def test_the_later_verdict_counts(cut, tmp_path):
    _, (first, _) = cut
    copy = shutil.copytree(first.root, tmp_path / "copy", ignore=shutil.ignore_patterns(".lock"))
    store = LabelStore(copy, "me/copy", ["spilled"])
    store.label("spilled", 0, 4, "bo")
    assert carry_labels(store, [first.root]) == {"spilled": 0} and store.verdict("spilled", 0).by == "bo"
    store.close()


def test_a_source_of_other_episodes_is_a_message(cut, tmp_path):
    _, (first, second) = cut
    store = LabelStore(shutil.copytree(second.root, tmp_path / "copy"), "me/copy", ["spilled"])
    with pytest.raises(LabelFileError, match=r"no episode of .* nothing was carried over"):
        carry_labels(store, [first.root])
    store.close()


def test_a_source_without_labels_is_a_message(dataset_root):
    with pytest.raises(LabelFileError, match="has no label files; expected the folder of a labelled dataset"):
        specifications_in([dataset_root])
