import errno
import json
import shutil
import subprocess
import sys
import time

import numpy as np
import pyarrow.compute
import pyarrow.parquet as pq
import pytest
import tiny

from lerobot_latentsafe.datasets import labels as label_files
from lerobot_latentsafe.datasets.label_file import METADATA
from lerobot_latentsafe.datasets.labels import FailureLabels, LabelFileError, UnlabelledDatasetError
from lerobot_latentsafe.labeling.store import ConflictError, LabelStore, first_failing


@pytest.fixture
def root(dataset_root, tmp_path):
    return shutil.copytree(dataset_root, tmp_path / "car")


@pytest.fixture
def store(root):
    opened = LabelStore(root, tiny.REPO_ID, ["spilled", "failure"])
    yield opened
    opened.close()


def reopened(store):
    store.close()
    return LabelStore(store.root, tiny.REPO_ID, ["spilled", "failure"])


def test_labels_are_on_disk_at_once_and_training_reads_them(store, root):
    store.label("spilled", 3, 2, "ann")
    store.label("spilled", 4, int(store.length[4]), "bo")
    read = FailureLabels.load(root, "spilled")
    assert read.failure[read.episode == 3].tolist() == [0, 0] + [1] * (store.length[3] - 2)
    assert set(read.failure[read.episode == 4]) == {0} and set(read.failure[read.episode == 5]) == {-1}


def test_who_and_when_are_kept(store):
    said = store.label("spilled", 3, 2, "ann")
    again = reopened(store)
    assert again.verdict("spilled", 3) == said and said.by == "ann"
    assert abs(said.at / 1e6 - time.time()) < 60
    assert again.verdict("spilled", 4).by is None
    again.close()


def test_specifications_do_not_touch_each_other(store, root):
    before = store.verdict("failure", 3)
    store.label("spilled", 3, 0, "ann")
    assert store.verdict("failure", 3) == before and not (root / "labels" / "failure.parquet").exists()


def test_labels_of_a_column_are_where_labelling_starts(store, root):
    column = FailureLabels.load(root)
    assert np.array_equal(store.labels("failure", 5), column.failure[column.episode == 5])
    assert store.verdict("failure", 5).by == "column failure"
    store.label("failure", 5, 1, "ann")
    after = FailureLabels.load(root)
    assert np.array_equal(after.failure[after.episode != 5], column.failure[column.episode != 5])


def test_undo_goes_back_step_by_step_for_each_tab(store):
    store.label("spilled", 3, 2, "ann", tab="a")
    store.label("spilled", 3, 4, "ann", tab="a")
    store.label("spilled", 5, 0, "bo", tab="b")
    assert store.undo("spilled", "a")[0] == 3 and store.verdict("spilled", 3).first == 2
    assert store.undo("spilled", "a")[0] == 3 and store.verdict("spilled", 3).first is None
    assert store.undo("spilled", "a") is None
    assert store.verdict("spilled", 5).first == 0


def test_undo_never_takes_back_what_somebody_else_said(store):
    store.label("spilled", 3, 2, "ann", tab="a")
    store.label("spilled", 3, 4, "bo", tab="b")
    with pytest.raises(ConflictError, match="bo"):
        store.undo("spilled", "a")
    assert store.verdict("spilled", 3).first == 4


def test_change_made_on_an_old_state_is_refused(store):
    seen = store.verdict("spilled", 3).at
    store.label("spilled", 3, 2, "ann", seen)
    with pytest.raises(ConflictError, match="ann"):
        store.label("spilled", 3, 4, "bo", seen)
    assert store.verdict("spilled", 3).first == 2


def test_label_whose_answer_was_lost_may_be_sent_again(store):
    seen = store.verdict("spilled", 3).at
    said = store.label("spilled", 3, 2, "ann", seen)
    assert store.label("spilled", 3, 2, "ann", seen) == said


@pytest.mark.parametrize("first", [-1, 10**6])
def test_frame_outside_of_the_episode_is_refused(store, first):
    with pytest.raises(ValueError, match="expected 0 to"):
        store.label("spilled", 3, first, "ann")


def test_full_disk_changes_nothing(store, root, monkeypatch):
    store.label("spilled", 3, 2, "ann")
    kept = (root / "labels" / "spilled.parquet").read_bytes()

    def full(table, file, **options):
        file.write_bytes(b"half a fi")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(label_files.pq, "write_table", full)
    with pytest.raises(OSError, match="No space left"):
        store.label("spilled", 3, 5, "ann")
    with pytest.raises(OSError, match="No space left"):
        store.undo("spilled")
    assert store.verdict("spilled", 3).first == 2
    monkeypatch.undo()
    assert (root / "labels" / "spilled.parquet").read_bytes() == kept
    assert sorted(p.name for p in (root / "labels").iterdir()) == [".lock", "spilled.parquet"]
    assert store.undo("spilled")[1].first is None


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_disk_that_fails_at_any_step_changes_nothing(store, root, monkeypatch, step):
    store.label("spilled", 3, 2, "ann")
    kept = (root / "labels" / "spilled.parquet").read_bytes()

    def full(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(f"lerobot_latentsafe.runtime.files.os.{step}", full)
    with pytest.raises(OSError, match="No space left"):
        store.label("spilled", 3, 5, "ann")
    monkeypatch.undo()
    assert store.verdict("spilled", 3).first == 2
    assert (root / "labels" / "spilled.parquet").read_bytes() == kept
    assert sorted(p.name for p in (root / "labels").iterdir()) == [".lock", "spilled.parquet"]


def test_second_process_is_kept_out(store, root):
    code = f"from lerobot_latentsafe.labeling.store import LabelStore; LabelStore({str(root)!r}, 'me/car', ['failure'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode and "another process is labelling" in done.stderr


def test_a_second_one_that_is_refused_does_not_break_a_save(store, root, monkeypatch):
    write, refused = label_files.pq.write_table, []

    def meanwhile(table, file, **options):
        write(table, file, **options)
        with pytest.raises(OSError, match="another process is labelling"):
            LabelStore(root, tiny.REPO_ID, ["failure"])
        refused.append(file)

    monkeypatch.setattr(label_files.pq, "write_table", meanwhile)
    store.label("spilled", 3, 2, "ann")
    assert refused and FailureLabels.load(root, "spilled").failure.max() == 1


@pytest.mark.fault("M29", "another process saves between reading and locking", "Its labels are read, none is lost")
def test_what_another_process_saved_last_is_read(store, root):
    """Files are read when the folder is this process's, not before."""
    store.label("spilled", 3, 2, "ann")
    with pytest.raises(OSError, match="another process"):
        LabelStore(root, tiny.REPO_ID, ["spilled"])
    store.label("spilled", 4, 1, "ann")
    again = reopened(store)
    assert [again.verdict("spilled", e).first for e in (3, 4)] == [2, 1]
    again.close()


@pytest.fixture
def intruder(store, root, tmp_path):
    """Labels an episode in a copy and puts its file in place of the store's: the lock does not hold on each disk."""

    def write(episode, first, by="bo"):
        copy = shutil.copytree(root, tmp_path / f"copy of {episode}", ignore=shutil.ignore_patterns(".lock"))
        other = LabelStore(copy, tiny.REPO_ID, ["spilled"])
        other.label("spilled", episode, first, by)
        other.close()
        shutil.copy(copy / "labels" / "spilled.parquet", root / "labels" / "spilled.parquet")

    return write


CHANGES = {
    "label": lambda store: store.label("spilled", 5, 1, "ann"),
    "label_frames": lambda store: store.label_frames("spilled", {5: np.r_[0, np.ones(store.length[5] - 1)]}, "auto"),
    "take": lambda store: store.take("spilled", store._files["failure"]),
    "undo": lambda store: store.undo("spilled"),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
@pytest.mark.fault("M29", "another program saves in spite of the lock", "Its labels are read, none is lost")
def test_what_another_program_saved_in_spite_of_the_lock_is_never_overwritten(store, intruder, change, caplog):
    store.label("spilled", 3, 2, "ann")
    store.label("spilled", 6, 0, "ann")
    intruder(4, 1)
    change(store)
    assert "another program wrote to" in caplog.text
    again = reopened(store)
    assert [again.verdict("spilled", e).first for e in (3, 4)] == [2, 1] and again.verdict("spilled", 4).by == "bo"
    again.close()


def test_an_episode_that_another_program_labelled_is_a_conflict(store, intruder):
    seen = store.verdict("spilled", 4).at
    intruder(4, 1)
    with pytest.raises(ConflictError, match="changed by bo"):
        store.label("spilled", 4, 0, "ann", seen)
    assert store.verdict("spilled", 4).first == 1


def test_a_file_that_another_program_broke_is_not_overwritten(store, root):
    store.label("spilled", 3, 2, "ann")
    (root / "labels" / "spilled.parquet").write_bytes(b"PAR1 torn")
    with pytest.raises(OSError, match=r"another program wrote to .*spilled.parquet meanwhile, and the label was not"):
        store.label("spilled", 4, 1, "ann")
    assert (root / "labels" / "spilled.parquet").read_bytes() == b"PAR1 torn"
    assert store.verdict("spilled", 4).first is None


def test_labels_whose_file_was_taken_away_are_written_again(store, root):
    store.label("spilled", 3, 2, "ann")
    (root / "labels" / "spilled.parquet").unlink()
    store.label("spilled", 4, 1, "ann")
    again = reopened(store)
    assert [again.verdict("spilled", e).first for e in (3, 4)] == [2, 1]
    again.close()


def test_a_store_that_cannot_be_opened_leaves_the_folder_free(store, root):
    store.close()
    (root / "labels" / "spilled.parquet").write_bytes(b"PAR1 torn")
    with pytest.raises(LabelFileError, match="not a readable parquet"):
        LabelStore(root, tiny.REPO_ID, ["failure"])
    (root / "labels" / "spilled.parquet").unlink()
    LabelStore(root, tiny.REPO_ID, ["failure"]).close()


def test_a_kill_loses_no_label_that_was_confirmed(root):
    code = f"""
from lerobot_latentsafe.labeling.store import LabelStore
store = LabelStore({str(root)!r}, 'me/car', ['spilled'])
while True:
    for episode in range(len(store)):
        print(episode, store.label('spilled', episode, episode % 3, 'ann').first, flush=True)
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    confirmed = dict(map(int, process.stdout.readline().split()) for _ in range(9))
    process.kill()
    process.wait()
    store = LabelStore(root, tiny.REPO_ID, ["spilled"])  # the lock went with the process
    assert {e: store.verdict("spilled", e).first for e in confirmed} == confirmed
    assert sorted(p.name for p in (root / "labels").iterdir()) == [".lock", "spilled.parquet"]
    store.close()


def test_folder_that_cannot_be_written_is_a_message(root, monkeypatch):
    def refuse(self, *args, **kwargs):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr("pathlib.Path.mkdir", refuse)
    with pytest.raises(OSError, match=r"cannot write labels to .*Read-only file system.*Nothing was changed"):
        LabelStore(root, tiny.REPO_ID, ["failure"])


def test_labels_of_another_dataset_are_refused_and_kept(store, root, tmp_path):
    from lerobot_latentsafe.collection.dubins import collect_dubins

    store.label("spilled", 3, 2, "ann")
    collect_dubins("random", "me/other", tmp_path / "other", n_episodes=14, seed=4)
    file = tmp_path / "other" / "labels" / "spilled.parquet"
    file.parent.mkdir()
    shutil.copy(root / "labels" / "spilled.parquet", file)
    kept = file.read_bytes()
    with pytest.raises(LabelFileError, match="another dataset"):
        LabelStore(tmp_path / "other", "me/other", ["failure"])
    with pytest.raises(UnlabelledDatasetError, match="another dataset"):
        FailureLabels.load(tmp_path / "other", "spilled")
    assert file.read_bytes() == kept


def test_labels_go_with_a_copy_without_cameras(store, root, cache_root, tmp_path):
    store.label("spilled", 3, 2, "ann")
    copy = shutil.copytree(cache_root, tmp_path / "cache")
    shutil.copytree(root / "labels", copy / "labels", ignore=shutil.ignore_patterns(".*"), dirs_exist_ok=True)
    assert np.array_equal(
        LabelStore(copy, "me/car_cache", ["spilled"]).labels("spilled", 3), store.labels("spilled", 3)
    )


def test_older_schema_is_refused_and_kept(store, root):
    store.label("spilled", 3, 2, "ann")
    store.close()
    file = root / "labels" / "spilled.parquet"
    table = pq.read_table(file)
    written = json.loads(table.schema.metadata[METADATA]) | {"schema": 0}
    pq.write_table(table.replace_schema_metadata({METADATA: json.dumps(written)}), file)
    kept = file.read_bytes()
    with pytest.raises(LabelFileError, match="has schema 0, this version reads 1 and 2"):
        LabelStore(root, tiny.REPO_ID, ["failure"])
    assert file.read_bytes() == kept


def test_torn_label_file_is_a_message(store, root):
    store.close()
    (root / "labels" / "spilled.parquet").write_bytes(b"PAR1 torn")
    with pytest.raises(LabelFileError, match="not a readable parquet"):
        LabelStore(root, tiny.REPO_ID, ["failure"])


def test_episodes_recorded_since_are_unlabelled(root, tmp_path):
    """Labels stay when a dataset grows: the file covers what was there."""
    store = LabelStore(root, tiny.REPO_ID, ["spilled"])
    store.label("spilled", 3, 2, "ann")
    store.close()
    file = next((root / "data").glob("*/*.parquet"))
    table = pq.read_table(file)
    new = table.slice(0, 5).to_pydict()
    new["index"] = [len(table) + i for i in range(5)]
    new["episode_index"] = [14] * 5
    pq.write_table(type(table).from_pydict(new, table.schema), file.with_name("file-001.parquet"))
    grown = LabelStore(root, tiny.REPO_ID, ["spilled"])
    assert grown.verdict("spilled", 3).first == 2 and grown.verdict("spilled", 14).first is None
    grown.close()


@pytest.mark.parametrize("name", ["../escape", "Failure", "action", "observation_x", "", "a" * 41, "a.b", "index"])
def test_unusable_specification_names_are_refused(root, name):
    with pytest.raises(LabelFileError, match="not usable"):
        LabelStore(root, tiny.REPO_ID, [name])


def test_unknown_specification_lists_the_label_files(store, root):
    store.label("spilled", 3, 2, "ann")
    with pytest.raises(UnlabelledDatasetError, match=r"'spilt'.*its label files spilled"):
        FailureLabels.load(root, "spilt")


def test_missing_episode_file_is_a_message(root):
    file = next((root / "data").glob("*/*.parquet"))
    table = pq.read_table(file)
    pq.write_table(table.filter(pyarrow.compute.field("episode_index") != 2), file)
    with pytest.raises(UnlabelledDatasetError, match="an episode file is missing"):
        LabelStore(root, tiny.REPO_ID, ["failure"])


@pytest.mark.parametrize(
    ("labels", "first"),
    [([0, 0, 1], 2), ([0, 0], 2), ([1, 1], 0), ([-1, -1], None), ([0, 1, 0], None), ([0, -1], None)],
)
def test_first_failing(labels, first):
    assert first_failing(np.array(labels)) == first


def test_a_frame_is_marked_alone_and_the_mark_taken_back(store):
    length = int(store.length[3])
    said = store.mark("spilled", 3, 2, "ann", seen=0)
    assert said.mixed and said.by == "ann"
    assert store.labels("spilled", 3).tolist() == [-1, -1, 1] + [-1] * (length - 3)
    store.mark("spilled", 3, 4, "ann", seen=said.at)
    with pytest.raises(ConflictError):
        store.mark("spilled", 3, 5, "bo", seen=said.at)
    store.undo("spilled")
    assert store.labels("spilled", 3).tolist() == [-1, -1, 1] + [-1] * (length - 3)
    assert store.mark("spilled", 3, 2, "ann").by is None and (store.labels("spilled", 3) == -1).all()
    with pytest.raises(ValueError, match=f"expected 0 to {length - 1}"):
        store.mark("spilled", 3, length, "ann")
