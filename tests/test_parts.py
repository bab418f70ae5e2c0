"""Recording in parts, killed at every step, with other workers, by two at once and on a full disk."""

import errno
import json
import os
import threading
from functools import partial
from multiprocessing.pool import ThreadPool
from queue import SimpleQueue
from types import SimpleNamespace

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.collection import parts as collection
from lerobot_latentsafe.collection.parts import record_in_parts
from lerobot_latentsafe.runtime.files import FolderInUseError, OtherRunError, locked_folder

REPO_ID, N = "me/counting", 7
OPTIONS = {"source": "counting", "seed": 0}
FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
    "action": {"dtype": "float32", "shape": (1,), "names": ["a"]},
}


class Killed(BaseException):
    pass


THREADS = SimpleNamespace(Pool=ThreadPool, SimpleQueue=SimpleQueue)
ALONE = threading.RLock()
"""Threads stand in for processes here, and imports that fail, as LeRobot's of torchcodec may, are theirs in common."""


def write(episodes, folder, recorded=None):
    """Episode i has i % 3 + 2 frames that hold its number."""
    with ALONE:
        yield from _write(episodes, folder, recorded)


def _write(episodes, folder, recorded):
    dataset = LeRobotDataset.create(REPO_ID, 10, FEATURES, root=folder, use_videos=False)
    for i in episodes:
        for t in range(i % 3 + 2):
            frame = {"observation.state": np.float32([i, t]), "action": np.float32([i + 0.5])}
            dataset.add_frame({**frame, "task": "count"})
        dataset.save_episode()
        if recorded is not None:
            recorded.append(i)
        yield
    dataset.finalize()


def record(root, n=N, record=write, options=OPTIONS, at_once=2, **more):
    return record_in_parts(REPO_ID, root, options, n, record, at_once, **more)


def content(dataset):
    columns = {name: np.array(dataset.hf_dataset[name]) for name in (*FEATURES, "episode_index", "index", "timestamp")}
    lengths = {f"ends {name}": dataset.meta.episodes[name] for name in ("dataset_from_index", "dataset_to_index")}
    statistics = {f"{k} {name}": v for k, s in dataset.meta.stats.items() for name, v in s.items()}
    return {name: np.asarray(value) for name, value in {**columns, **lengths, **statistics}.items()}


def same(one, other):
    one, other = content(one), content(other)
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    return record(tmp_path_factory.mktemp("data") / "whole")


def left(folder):
    return sorted(p.name for p in folder.iterdir())


def test_episodes_are_in_their_order(undisturbed):
    assert undisturbed.num_episodes == N and left(undisturbed.root.parent) == ["whole"]
    expected = [i for i in range(N) for _ in range(i % 3 + 2)]
    assert content(undisturbed)["observation.state"][:, 0].tolist() == expected


def killed_at(monkeypatch, module, name, which):
    """From now on the call with this number kills; later ones do not."""
    calls, real = iter(range(10**6)), getattr(module, name)

    def call(*given, **options):
        if next(calls) == which:
            raise Killed
        return real(*given, **options)

    monkeypatch.setattr(module, name, call)


KILLS = {
    "before the first part": ("claim", 0),
    "in the first part": ("_record_part", 0),
    "in the last part": ("_record_part", 3),
    "before they are put together": ("_put_together", 0),
    "before the parts are removed": ("discard", 0),
    "while it is read": ("LeRobotDataset", 0),
}


@pytest.mark.parametrize("kill", KILLS)
@pytest.mark.fault("K03", "collect is killed", "The same command goes on, and ends the same")
@pytest.mark.fault("K24", "collect (Franka) is killed while parts are put together", "The same command ends it")
def test_a_killed_recording_ends_as_one_that_was_not(undisturbed, tmp_path, monkeypatch, kill):
    name, which = KILLS[kill]
    with monkeypatch.context() as patch, pytest.raises(Killed):
        killed_at(patch, collection, name, which)
        record(tmp_path / "cut")
    recorded = []
    if kill == "while it is read":  # all is done
        with pytest.raises(FileExistsError, match=r"another --dataset\.root"):
            record(tmp_path / "cut")
        resumed = LeRobotDataset(REPO_ID, root=tmp_path / "cut")
    else:
        resumed = record(tmp_path / "cut", record=partial(write, recorded=recorded))
        finished = {"in the last part": 6, "before they are put together": 7, "before the parts are removed": 7}
        assert recorded == list(range(finished.get(kill, 0), N))  # finished parts are kept
    assert same(resumed, undisturbed) and left(tmp_path) == ["cut"]


@pytest.mark.parametrize("n, workers", [(5, 1), (9, 1), (7, 4)], ids=["fewer", "more", "other workers"])
def test_finished_parts_serve_another_number_of_episodes_or_workers(tmp_path, monkeypatch, n, workers):
    with monkeypatch.context() as patch, pytest.raises(Killed):
        killed_at(patch, collection, "_record_part", 2)  # 0 to 3 are there
        record(tmp_path / "cut")
    recorded = []
    monkeypatch.setattr(collection, "get_context", lambda method: THREADS)
    resumed = record(tmp_path / "cut", n, partial(write, recorded=recorded), workers=workers)
    assert sorted(recorded) == list(range(4, n)) and resumed.num_episodes == n
    assert content(resumed)["observation.state"][:, 0].tolist() == [i for i in range(n) for _ in range(i % 3 + 2)]


@pytest.mark.fault(
    "K21", "the note of a collection is torn by a kill", "That one file is to be removed; all parts are kept"
)
def test_an_unfinished_recording_of_something_else_is_left_alone(tmp_path, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(Killed):
        killed_at(patch, collection, "_record_part", 1)
        record(tmp_path / "cut")
    with pytest.raises(OtherRunError, match=r"cut\.parts holds a run with other options \(seed = 0\)"):
        record(tmp_path / "cut", options={**OPTIONS, "seed": 1})
    note = tmp_path / "cut.parts" / "options.json"
    note.write_text("")
    with pytest.raises(OtherRunError, match="remove this one file and start again: all else is kept"):
        record(tmp_path / "cut")
    note.unlink()
    recorded = []
    record(tmp_path / "cut", record=partial(write, recorded=recorded))
    assert recorded == list(range(2, N))


def test_a_finished_dataset_of_another_size_is_not_taken_for_this_one(tmp_path, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(Killed):
        killed_at(patch, collection, "discard", 0)
        record(tmp_path / "cut")
    with pytest.raises(FileExistsError, match=r"another --dataset\.root"):
        record(tmp_path / "cut", N + 1)
    assert record(tmp_path / "cut").num_episodes == N


@pytest.mark.parametrize("broken", [OSError(errno.ENOSPC, "No space left"), FileNotFoundError("frame-000001.png")])
@pytest.mark.fault(
    "D02",
    "the disk is full while car episodes are collected",
    "A message; finished parts are kept, and the same command goes on",
)
def test_a_full_disk_is_told_and_finished_parts_are_kept(tmp_path, monkeypatch, broken):
    """LeRobot logs that a picture cannot be written, and then misses it."""

    def full(episodes, folder):
        if episodes.start == 2:
            raise broken
        yield from write(episodes, folder)

    with monkeypatch.context() as patch, pytest.raises(OSError, match=r"parts is full; finished parts are kept"):
        patch.setattr(collection.shutil, "disk_usage", lambda folder: SimpleNamespace(free=0))
        record(tmp_path / "full", record=full)
    recorded = []
    record(tmp_path / "full", record=partial(write, recorded=recorded))
    assert recorded == list(range(2, N))


@pytest.mark.fault("K22", "two collect into one folder", "The second is refused (`FolderInUseError`)")
def test_two_at_once_are_told_apart(tmp_path):
    def other():
        with locked_folder(tmp_path / "one.parts"):
            locked.set()
            done.wait()

    locked, done = threading.Event(), threading.Event()
    thread = threading.Thread(target=other)
    thread.start()
    locked.wait()
    with pytest.raises(FolderInUseError, match=rf"process {os.getpid()} is writing .*one\.parts already"):
        record(tmp_path / "one")
    done.set()
    thread.join()


@pytest.mark.parametrize("options, message", [({"n": 0}, "num_episodes is 0"), ({"workers": -1}, "--workers is -1")])
@pytest.mark.fault("N08", "collect of no episodes", "Refused, with what was expected")
def test_nonsense_is_refused_before_anything_is_written(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        record(tmp_path / "x", **options)
    assert left(tmp_path) == []


def test_the_note_says_what_the_parts_are_of(tmp_path, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(Killed):
        killed_at(patch, collection, "_put_together", 0)
        record(tmp_path / "cut")
    assert json.loads((tmp_path / "cut.parts" / "options.json").read_text()) == OPTIONS


class Steps:
    """In place of tqdm: what the bar is told."""

    def __init__(self, total, **_):
        self.total, self.steps = total, []

    def __enter__(self):
        bars.append(self)
        return self

    def __exit__(self, *_):
        pass

    def update(self, n=1):
        self.steps.append(n)


bars: list[Steps] = []


@pytest.mark.parametrize("workers", [1, 2])
def test_the_bar_takes_a_step_an_episode(tmp_path, monkeypatch, workers):
    monkeypatch.setattr(collection, "tqdm", Steps)
    monkeypatch.setattr(collection, "get_context", lambda method: THREADS)
    record(tmp_path / "whole", workers=workers)
    assert (bars[-1].total, bars[-1].steps) == (N, [1] * N)


def test_an_error_of_a_worker_is_raised(tmp_path, monkeypatch):
    def broken(episodes, folder):
        yield from write(episodes, folder)
        raise ValueError("the arm came off")

    monkeypatch.setattr(collection, "get_context", lambda method: THREADS)
    with pytest.raises(ValueError, match="the arm came off"):
        record(tmp_path / "whole", record=broken, workers=2)
