"""Where labels lie and whose they are: nothing is lost at a new commit, and none goes to an episode of another's."""

import os
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_latentsafe.datasets import label_places
from lerobot_latentsafe.datasets.label_places import label_folders, sidecar_path, specifications_of
from lerobot_latentsafe.datasets.labels import Content, FailureLabels, LabelFileError, Sidecar, UnlabelledDatasetError
from lerobot_latentsafe.labeling.store import LabelStore

LENGTHS = (4, 3, 4, 5)


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """A home of LeRobot's for each test."""
    monkeypatch.setattr(label_places.constants, "HF_LEROBOT_HOME", tmp_path / "home")
    return tmp_path / "home"


def table(lengths=LENGTHS, seed=0, state=True, action=True, **more):
    """Frames of a dataset; episode e of a seed has the same numbers wherever it stands."""
    rows = {"index": np.arange(sum(lengths)), "episode_index": np.repeat(np.arange(len(lengths)), lengths)}
    rows["timestamp"] = np.concatenate([np.arange(n) / 10 for n in lengths]).astype("f4")
    draws = [np.random.default_rng([seed, e]).normal(size=(n, 4)).astype("f4") for e, n in enumerate(lengths)]
    numbers = np.concatenate(draws)
    if action:
        rows["action"] = list(numbers[:, :2])
    if state:
        rows["observation.state"] = list(numbers[:, 2:])
    return pa.table({**rows, **more})


def write(root, frames, keep=None, others=None):
    """A dataset's folder; of some episodes only, or with those of others behind them."""
    parts = [frames] if keep is None else [frames.filter(pa.array(np.equal(frames["episode_index"], e))) for e in keep]
    whole = pa.concat_tables([*parts, *([others] if others is not None else [])])
    episode = np.asarray(whole["episode_index"])
    starts = np.r_[True, (np.diff(episode) != 0)]
    new = {"index": np.arange(len(whole)), "episode_index": np.cumsum(starts) - 1}
    for name, values in new.items():
        whole = whole.set_column(whole.schema.get_field_index(name), name, pa.array(values))
    path = root / "data" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True)
    pq.write_table(whole, path)
    return root


def label(root, repo_id="me/bag", verdicts=((0, 1), (1, 3), (2, 2))):
    """Say of some episodes where they fail."""
    store = LabelStore(root, repo_id, ["failure"])
    for episode, first in verdicts:
        store.label("failure", episode, first, "ann")
    store.close()


def found(root, repo_id="me/bag"):
    """First failing frame of each episode, as a store has them."""
    store = LabelStore(root, repo_id, ["failure"])
    verdicts = [store.verdict("failure", e).first for e in range(len(store))]
    store.close()
    return verdicts


def snapshot(tmp_path, commit, frames=None):
    root = tmp_path / "home" / "hub" / "datasets--me--bag" / "snapshots" / commit
    return write(root, table() if frames is None else frames)


# -- where ---


def test_labels_of_a_snapshot_outlive_it(tmp_path, home):
    first = snapshot(tmp_path, "aaa")
    label(first)
    assert not (first / "labels").exists() and (home / "labels/me/bag/failure.parquet").exists()
    second = snapshot(tmp_path, "bbb")
    shutil.rmtree(first)
    assert found(second) == [1, 3, 2, None]
    assert FailureLabels.load(second).failure.tolist()[:4] == [0, 1, 1, 1]
    assert specifications_of(second) == ["failure"]


def test_labels_in_an_old_snapshot_are_carried_over_and_said_once(tmp_path, home, caplog):
    first, second = snapshot(tmp_path, "aaa"), snapshot(tmp_path, "bbb")
    (first / "labels").mkdir()
    beside = write(tmp_path / "elsewhere", table())
    label(beside)
    shutil.copy(beside / "labels/failure.parquet", first / "labels/failure.parquet")
    assert FailureLabels.load(second).failure.tolist()[:4] == [0, 1, 1, 1]  # training finds them where they are
    assert found(second) == [1, 3, 2, None] and "carried over to" in caplog.text
    assert (home / "labels/me/bag/failure.parquet").exists()
    caplog.clear()
    assert found(second) == [1, 3, 2, None] and "carried over" not in caplog.text


def test_a_folder_that_cannot_be_written_has_its_labels_at_home(tmp_path, home, monkeypatch):
    root = write(tmp_path / "bag", table())
    label(root, verdicts=[(0, 1)])
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: "home" in str(path) and access(path, mode))
    label(root, verdicts=[(1, 0)])
    assert found(root) == [1, 0, None, None] and (home / "labels/me/bag/failure.parquet").exists()
    monkeypatch.undo()
    monkeypatch.setattr(label_places.constants, "HF_LEROBOT_HOME", home)
    assert found(root) == [1, 0, None, None]  # the later verdict counts, wherever it lies


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("data/bag", ["data/bag/labels", "home/labels/me/bag"]),
        ("home/me/bag", ["home/me/bag/labels", "home/labels/me/bag"]),
        ("x/datasets--you--cup/snapshots/abc", ["home/labels/you/cup", "x/datasets--you--cup/snapshots/abc/labels"]),
        ("x/datasets--cup/snapshots/abc", ["home/labels/cup", "x/datasets--cup/snapshots/abc/labels"]),
        ("x/models--you--cup/snapshots/abc", ["x/models--you--cup/snapshots/abc/labels", "home/labels/me/bag"]),
    ],
)
def test_places(tmp_path, path, expected):
    (tmp_path / path).mkdir(parents=True)
    assert label_folders(tmp_path / path, "me/bag") == [tmp_path / place for place in expected]


def test_without_an_id_a_folder_is_its_own_place(tmp_path):
    assert sidecar_path(tmp_path, "failure") == tmp_path / "labels" / "failure.parquet"


# -- whose ---

SAME = {
    "as it was": (table(), None),
    "recorded on": (table((*LENGTHS, 6)), None),
    "a column added": (table(reward=np.ones(sum(LENGTHS))), None),
    "actions in double precision": (
        table().set_column(3, "action", pa.array([a.astype(float) for a in table()["action"].to_numpy()])), None,
    ),
    "an episode deleted": (table(), [0, 2, 3]),
    "in another order": (table(), [2, 1, 0, 3]),
}  # fmt: skip


@pytest.mark.parametrize("kind", SAME)
def test_an_episode_is_known_by_its_content(tmp_path, kind):
    frames, keep = SAME[kind]
    label(write(tmp_path / "bag", table()))
    other = write(tmp_path / "other", frames, keep)
    shutil.copytree(tmp_path / "bag" / "labels", other / "labels")
    expected = {0: 1, 1: 3, 2: 2}
    order = keep if keep is not None else range(len(found(other)))
    assert found(other) == [expected.get(e) for e in order]


OTHER = {
    "other actions and states": table(seed=1),
    "other states, equal actions": table(seed=1).set_column(3, "action", table()["action"]),
    "no actions": table(seed=1, action=False),
    "no states": table(seed=1, state=False),
    "fewer numbers": table(action=False, state=False),
    "other lengths": table((3, 4, 4, 5)).drop(["action", "observation.state"]),
}


@pytest.mark.parametrize("kind", OTHER)
def test_labels_of_another_dataset_of_the_same_length_are_refused(tmp_path, kind):
    label(write(tmp_path / "bag", table()))
    other = write(tmp_path / "other", OTHER[kind])
    shutil.copytree(tmp_path / "bag" / "labels", other / "labels")
    kept = (other / "labels/failure.parquet").read_bytes()
    for use in (found, FailureLabels.load):
        with pytest.raises(LabelFileError, match=r"another dataset.*Nothing was overwritten"):
            use(other)
    assert (other / "labels/failure.parquet").read_bytes() == kept


@pytest.mark.parametrize("columns", [{"state": False}, {"action": False}], ids=["no states", "no actions"])
def test_datasets_with_one_kind_of_numbers_are_told_apart(tmp_path, columns):
    label(write(tmp_path / "bag", table(**columns)))
    assert found(tmp_path / "bag") == [1, 3, 2, None]
    other = write(tmp_path / "other", table(seed=1, **columns))
    shutil.copytree(tmp_path / "bag" / "labels", other / "labels")
    with pytest.raises(LabelFileError, match="another dataset"):
        found(other)


def test_columns_of_other_names_tell_episodes_apart(tmp_path):
    """As in datasets whose features are `actions` and `state`."""
    names = {"action": "actions", "observation.state": "state"}
    mine, theirs = (t.rename_columns([names.get(c, c) for c in t.column_names]) for t in (table(), table(seed=1)))
    label(write(tmp_path / "bag", mine))
    other = write(tmp_path / "other", theirs)
    shutil.copytree(tmp_path / "bag" / "labels", other / "labels")
    with pytest.raises(LabelFileError, match="another dataset"):
        found(other)


def test_episodes_that_look_alike_are_labelled_only_where_their_labels_agree(tmp_path):
    alike = table((4, 4, 4, 4)).slice(0, 4)
    root = write(tmp_path / "bag", table((4,)), None, pa.concat_tables([table((4, 4, 4)).slice(4)]))
    twin = write(tmp_path / "twin", alike, [0], pa.concat_tables([table((4, 4)).slice(4), alike]))
    label(twin, verdicts=[(0, 1), (1, 2), (2, 3)])  # episodes 0 and 2 are the same frames, labelled differently
    shutil.copytree(twin / "labels", root / "labels")
    assert found(root) == [None, 2, None]
    assert len(list((root / "labels").glob("failure.*.parquet"))) == 1  # what could not be told is kept


def test_labels_of_episodes_that_are_gone_are_kept_aside(tmp_path, caplog):
    """A dataset on the Hub whose second revision lacks an episode, and whose third has it again."""
    label(snapshot(tmp_path, "aaa"))
    cut = snapshot(tmp_path, "bbb", table().filter(pa.array(np.asarray(table()["episode_index"]) < 1)))
    assert found(cut) == [1] and "are kept in" in caplog.text
    label(cut, verdicts=[(0, 2)])
    assert found(snapshot(tmp_path, "ccc")) == [2, 3, 2, None]


def test_a_folder_of_lengths_alone_trusts_its_own_file_only(tmp_path, home):
    """Of a dataset without numbers nothing but lengths is known: no file from elsewhere is taken for its."""
    bare = table(state=False, action=False)
    label(write(tmp_path / "bag", bare), "me/bag")
    assert found(tmp_path / "bag") == [1, 3, 2, None]
    (home / "labels/me").mkdir(parents=True)
    shutil.copytree(tmp_path / "bag" / "labels", home / "labels/me/bag")
    assert found(write(tmp_path / "other", bare)) == [None] * 4
    cut = write(tmp_path / "cut", bare, [0, 2, 3])
    shutil.copytree(tmp_path / "bag" / "labels", cut / "labels")
    with pytest.raises(LabelFileError, match="another dataset"):
        found(cut)


def old_file(root, action=True):
    """A file as versions before schema 2 wrote it."""
    import hashlib
    import json

    frames = pq.read_table(root / "data/chunk-000/file-000.parquet")
    digest = hashlib.sha256(np.asarray(frames["episode_index"]).astype("<i8").tobytes())
    if action:
        digest.update(np.stack(frames["action"].to_numpy()).astype("<f4").tobytes())
    described = {"schema": 1, "frames": len(frames), "identity": digest.hexdigest()[:16], "repo_id": "me/bag"}
    rows = {"index": np.arange(len(frames)), "failure": np.arange(len(frames)) % 2}
    (root / "labels").mkdir()
    labels = pa.table(rows).replace_schema_metadata({"latentsafe_labels": json.dumps(described)})
    pq.write_table(labels, root / "labels/failure.parquet")
    return root


def test_files_of_schema_1_are_read_and_become_schema_2(tmp_path):
    root = old_file(write(tmp_path / "bag", table()))
    assert FailureLabels.load(root).failure.tolist() == [i % 2 for i in range(sum(LENGTHS))]
    label(root, verdicts=[(0, 1)])
    assert FailureLabels.load(root).failure.tolist()[:6] == [0, 1, 1, 1, 0, 1]
    assert Sidecar.read(root / "labels/failure.parquet", Content(root)).left == 0


@pytest.mark.parametrize(("repo_id", "taken"), [("me/bag", True), ("me/bag_cache", True), ("me/other", False)])
def test_a_file_of_schema_1_without_actions_goes_by_name(tmp_path, repo_id, taken):
    root = old_file(write(tmp_path / "bag", table(action=False)), action=False)
    if taken:
        assert FailureLabels.load(root, "failure", repo_id).failure.tolist()[:2] == [0, 1]
    else:
        with pytest.raises(LabelFileError, match="another dataset"):
            FailureLabels.load(root, "failure", repo_id)


def test_a_dataset_that_was_joined_names_where_its_labels_are(tmp_path):
    label(write(tmp_path / "bag", table()))
    joined = write(tmp_path / "joined", table(seed=1), None, table())
    with pytest.raises(UnlabelledDatasetError, match=r"labelled in .*bag/labels; .*carry-labels --sources='\[.*bag"):
        FailureLabels.load(joined)
