import json
import random
from contextlib import suppress
from datetime import UTC, datetime

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_latentsafe.datasets.label_file import METADATA
from lerobot_latentsafe.datasets.label_places import LabelFileError
from lerobot_latentsafe.datasets.labels import (
    FAILING,
    SAFE,
    UNLABELLED,
    Content,
    FailureLabels,
    Sidecar,
    UnlabelledDatasetError,
)
from lerobot_latentsafe.datasets.reading import BrokenFileError
from lerobot_latentsafe.labeling.store import LabelStore

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


# -- label files that were damaged or made by other tools ---


def sidecar(root, metadata=None, entries=None, **columns):
    """A label file as `latentsafe label` writes it, with other metadata, entries of it or columns."""
    write_dataset(root, action=[[0.1 * i] for i in range(N)])
    path, content = root / "labels" / "failure.parquet", Content(root)
    path.parent.mkdir(exist_ok=True)
    labels = Sidecar.empty(N)
    labels.failure[:] = [0, 1] * 3
    labels.write(path, "me/car", content)
    table = pq.read_table(path)
    told = metadata
    if told is None:
        told = json.dumps(json.loads(table.schema.metadata[METADATA]) | (entries or {}))
    for name, values in columns.items():
        array = values if isinstance(values, pa.Array) else pa.array(list(values))
        table = table.set_column(table.schema.get_field_index(name), name, array)
    pq.write_table(table.replace_schema_metadata({METADATA: told}), path)
    return path


TIMES = pa.array([datetime(2024, 5, 6)] * N)
READ = {
    "as it was written": {},
    "names as plain text": {"labelled_by": ["ann"] * N},
    "nobody": {"labelled_by": pa.nulls(N)},
    "times of another precision": {"labelled_at": TIMES.cast(pa.timestamp("ns"))},
    "times as whole numbers": {"labelled_at": TIMES.cast(pa.timestamp("us")).cast(pa.int64())},
    "no times": {"labelled_at": pa.nulls(N)},
    "index of few bits": {"index": pa.array(range(N), pa.uint8())},
    "labels as fractions": {"failure": [0.0, 1.0] * 3},
    "labels as truths": {"failure": [False, True] * 3},
}


@pytest.mark.parametrize("changes", READ.values(), ids=READ)
def test_label_files_of_other_tools_are_read(tmp_path, changes):
    read = Sidecar.read(sidecar(tmp_path, **changes), Content(tmp_path))
    assert read.failure.tolist() == [0, 1] * 3
    if "labelled_at" in changes and changes["labelled_at"].null_count == 0:
        assert set(read.at) == {int(datetime(2024, 5, 6, tzinfo=UTC).timestamp() * 1e6)}


BROKEN = {
    "metadata no JSON": ({"metadata": b"{schema: 2"}, "does not tell its dataset in JSON"),
    "metadata no text": ({"metadata": b"\xff\xfe\x00"}, "does not tell its dataset in JSON"),
    "metadata nested": ({"metadata": b"[" * 100_000}, "does not tell its dataset in JSON"),
    "metadata a list": ({"metadata": b"[]"}, "expected a JSON object"),
    "metadata null": ({"metadata": b"null"}, "expected a JSON object"),
    "no schema": ({"entries": {"schema": None}}, "has schema None, this version reads 1 and 2"),
    "schema to come": ({"entries": {"schema": 3}}, "has schema 3, this version reads 1 and 2"),
    "no frames": ({"entries": {"frames": None}}, "tells frames None of its dataset; expected a whole number"),
    "frames in words": ({"entries": {"frames": "many"}}, "tells frames 'many' of its dataset; expected a whole number"),
    "frames negative": ({"entries": {"frames": -1}}, "tells frames -1"),
    "frames a fraction": ({"entries": {"frames": 6.0}}, r"tells frames 6\.0"),
    "too many frames": ({"entries": {"frames": 10**15}}, "expected the same numbers"),
    "identity a number": ({"entries": {"identity": 5}}, "tells identity 5 of its dataset; expected a text"),
    "repo_id a list": ({"entries": {"repo_id": ["me"]}}, r"tells repo_id \['me'\]"),
    "columns a text": ({"entries": {"columns": "action"}}, "expected a list of texts"),
    "lengths of texts": ({"entries": {"lengths": ["3", "3"]}}, "expected a list of whole numbers"),
    "lengths missing": ({"entries": {"lengths": None}}, "tells lengths None"),
    "lengths negative": ({"entries": {"lengths": [-3, 9]}}, "expected a list of whole numbers"),
    "one length too few": ({"entries": {"lengths": [6]}}, "tells 1 lengths of 2 episodes"),
    "episodes of numbers": ({"entries": {"episodes": [1, 2]}}, "expected a list of texts"),
    "index a fraction": ({"index": [float(i) for i in range(N)]}, "holds double in its column 'index'; expected whole"),
    "index with a hole": ({"index": [0, 1, 2, None, 4, 5]}, "column 'index'; expected whole numbers, none missing"),
    "index in words": ({"index": list("012345")}, "holds string in its column 'index'"),
    "index of lists": ({"index": [[i] for i in range(N)]}, "in its column 'index'"),
    "labels of lists": ({"failure": [[0], [0, 1], [], [1], [0], [1]]}, "expected 1, 0 or -1"),
    "labels in words": ({"failure": ["safe"] * N}, "holds safe; expected 1, 0 or -1"),
    "labels as times": ({"failure": pa.array([1, 0] * 3, pa.timestamp("ns"))}, "expected 1, 0 or -1"),
    "labels as records": ({"failure": [{"label": 1}] * N}, "expected 1, 0 or -1"),
    "names of lists": ({"labelled_by": [["ann"]] * N}, "in its column 'labelled_by'; expected names"),
    "names of numbers": ({"labelled_by": [1] * N}, "holds int64 in its column 'labelled_by'; expected names"),
    "times in words": ({"labelled_at": ["today"] * N}, "holds string in its column 'labelled_at'; expected times"),
    "times of lists": ({"labelled_at": [[1]] * N}, "in its column 'labelled_at'; expected times"),
    "times negative": ({"labelled_at": [-1] * N}, "tells times from -1 to -1"),
    "times past any clock": ({"labelled_at": [2**62] * N}, "expected microseconds since 1970"),
}


@pytest.mark.parametrize(("changes", "message"), BROKEN.values(), ids=BROKEN)
@pytest.mark.fault("M03", "a label file whose metadata are no JSON", "Refused (`LabelFileError`), and kept")
@pytest.mark.fault("M05", "a label file that lacks its frames", "Refused (`LabelFileError`), and kept")
@pytest.mark.fault("M06", "a label file of 'many' frames", "Refused (`LabelFileError`), and kept")
@pytest.mark.fault("M16", "a label file whose index is of fractions", "Refused (`LabelFileError`), and kept")
@pytest.mark.fault("M20", "a label file whose names are lists", "Refused (`LabelFileError`), and kept")
@pytest.mark.fault("M21", "a label file whose times are words", "Refused (`LabelFileError`), and kept")
def test_a_broken_label_file_says_what_is_wrong_and_stays(tmp_path, changes, message):
    path = sidecar(tmp_path, **changes)
    kept = path.read_bytes()
    for use in (lambda: FailureLabels.load(tmp_path), lambda: LabelStore(tmp_path, "me/car", ["failure"])):
        with pytest.raises(LabelFileError, match=message) as refused:
            use()
        assert str(path) in str(refused.value)
    assert path.read_bytes() == kept


def test_no_byte_that_changed_changes_a_label(tmp_path):
    """As a bad disk does: the file is refused, says what it said, or is no longer known to be of an episode."""
    path, rng = sidecar(tmp_path), random.Random(0)
    content = Content(tmp_path)
    Sidecar.read(path, content).write(path, "me/car", content)
    whole = path.read_bytes()
    for _ in range(300):
        broken = bytearray(whole)
        broken[rng.randrange(len(broken))] ^= 1 << rng.randrange(8)
        path.write_bytes(broken[: rng.choice([len(broken), rng.randrange(len(broken))])])
        with suppress(LabelFileError):
            read = Sidecar.read(path, content).failure.tolist()
            assert all(label in (said, UNLABELLED) for label, said in zip(read, [0, 1] * 3, strict=True))


def test_a_column_twice_is_refused(tmp_path):
    path = sidecar(tmp_path)
    table = pq.read_table(path)
    pq.write_table(table.append_column("index", table["index"]), path)
    with pytest.raises(LabelFileError, match="has 2 columns 'index'; expected one"):
        FailureLabels.load(tmp_path)
