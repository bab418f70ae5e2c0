import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_latentsafe.datasets.labels import FAILING, SAFE, UNLABELLED, FailureLabels, UnlabelledDatasetError
from lerobot_latentsafe.datasets.reading import BrokenFileError

N = 6


def write_dataset(root, **columns):
    """A dataset's tables: two episodes of three frames."""
    table = {"index": range(N), "episode_index": [0] * 3 + [1] * 3, **columns}
    write_parquet(root / "data" / "chunk-000" / "file-000.parquet", **table)
    return root


def write_sidecar(root, specification="failure", **columns):
    write_parquet(root / "labels" / f"{specification}.parquet", **columns)


def write_parquet(path, **columns):
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table({name: pa.array(list(values)) for name, values in columns.items()}), path)


def test_column_is_read(tmp_path):
    done = [False, False, True, False, False, False]
    labels = FailureLabels.load(write_dataset(tmp_path, failure=[0, 1, 1, 0, -1, 0], **{"next.done": done}))
    assert labels.failure.tolist() == [SAFE, FAILING, FAILING, SAFE, UNLABELLED, SAFE]
    assert labels.terminal.tolist() == [0, 0, 1, 0, 0, 0]
    assert labels.episode.tolist() == [0, 0, 0, 1, 1, 1]
    assert labels.balance == pytest.approx(2 / 5)


def test_frames_are_keyed_by_index_whatever_their_order_on_disk(tmp_path):
    write_parquet(
        tmp_path / "data/chunk-000/file-000.parquet", index=[3, 5, 4], episode_index=[1] * 3, failure=[0, 1, 0]
    )
    write_parquet(
        tmp_path / "data/chunk-000/file-001.parquet", index=[2, 0, 1], episode_index=[0] * 3, failure=[1, 0, 0]
    )
    assert FailureLabels.load(tmp_path).failure.tolist() == [0, 0, 1, 0, 0, 1]


def test_ends_are_unknown_without_a_done_column(tmp_path):
    labels = FailureLabels.load(write_dataset(tmp_path, failure=[0, 1] * 3))
    assert set(labels.terminal) == {UNLABELLED}


def test_sidecar_wins_over_the_column(tmp_path):
    write_dataset(tmp_path, failure=[0, 1] * 3)
    write_sidecar(tmp_path, index=[5, 4, 3, 2, 1, 0], failure=[1, 1, 1, 0, 0, 0])
    assert FailureLabels.load(tmp_path).failure.tolist() == [0, 0, 0, 1, 1, 1]


def test_several_specifications_share_a_dataset(tmp_path):
    write_dataset(tmp_path, failure=[0, 1] * 3)
    write_sidecar(tmp_path, "spilled", index=range(N), failure=[1, 0, 0, 0, 0, 0])
    assert FailureLabels.load(tmp_path, "spilled").failure.tolist() == [1, 0, 0, 0, 0, 0]
    assert FailureLabels.load(tmp_path).failure.tolist() == [0, 1] * 3


def test_unlabelled_dataset_names_column_and_sidecar(tmp_path):
    write_dataset(tmp_path, reward=[0.0] * N)
    with pytest.raises(UnlabelledDatasetError, match=r"column 'failure'.*labels/failure.parquet.*reward"):
        FailureLabels.load(tmp_path)


def test_folder_that_is_no_dataset(tmp_path):
    with pytest.raises(BrokenFileError, match="where the frames of a LeRobotDataset"):
        FailureLabels.load(tmp_path)


@pytest.mark.parametrize(("present", "missing"), [(SAFE, "failing"), (FAILING, "safe"), (UNLABELLED, "failing")])
def test_one_class_alone_is_refused(tmp_path, present, missing):
    write_dataset(tmp_path, failure=[present] * N)
    with pytest.raises(UnlabelledDatasetError, match=f"no {missing} frame"):
        FailureLabels.load(tmp_path)


@pytest.mark.parametrize("unknown", [2, -2, 256, 257], ids=str)
def test_unknown_values_are_refused(tmp_path, unknown):
    write_dataset(tmp_path, failure=[0, 1, 0, 1, 0, unknown])
    with pytest.raises(UnlabelledDatasetError, match="expected 1, 0 or -1"):
        FailureLabels.load(tmp_path)


@pytest.mark.parametrize("unknown", [0.7, float("nan"), None], ids=str)
@pytest.mark.parametrize("where", ["column", "sidecar"])
def test_what_is_no_label_never_counts_as_safe(tmp_path, where, unknown):
    values = [0.0, 1.0, 0.0, 1.0, 0.0, unknown]
    if where == "column":
        write_dataset(tmp_path, failure=values)
    else:
        write_dataset(tmp_path)
        write_sidecar(tmp_path, index=range(N), failure=values)
    with pytest.raises(UnlabelledDatasetError, match="expected 1, 0 or -1"):
        FailureLabels.load(tmp_path)


def test_column_with_several_labels_a_frame_is_refused(tmp_path):
    write_dataset(tmp_path, failure=[[0, 1]] * N)
    with pytest.raises(UnlabelledDatasetError, match="failure"):
        FailureLabels.load(tmp_path)


@pytest.mark.parametrize(
    "index",
    [range(N - 1), range(N + 1), [0, 0, 1, 2, 3, 4], range(1, N + 1)],
    ids=["too short", "too long", "a frame twice", "of another dataset"],
)
def test_sidecar_that_does_not_match_the_frames_is_refused(tmp_path, index):
    write_dataset(tmp_path)
    write_sidecar(tmp_path, index=index, failure=[i % 2 for i in range(len(index))])
    with pytest.raises(UnlabelledDatasetError, match=r"expected each index 0..5 once"):
        FailureLabels.load(tmp_path)


def test_sidecar_without_its_columns_is_refused(tmp_path):
    write_dataset(tmp_path)
    write_sidecar(tmp_path, frame=range(N), failed=[0, 1] * 3)
    with pytest.raises(UnlabelledDatasetError, match=r"lacks the columns \['failure', 'index'\]"):
        FailureLabels.load(tmp_path)


def test_metadata_of_another_length_is_refused(cache_root, cache_meta, monkeypatch):
    import tiny

    monkeypatch.setattr(cache_meta.info, "total_frames", cache_meta.total_frames + 1)
    with pytest.raises(ValueError, match="frames on disk"):
        tiny.new_policy(cache_meta)
