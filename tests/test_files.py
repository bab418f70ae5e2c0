"""Files and folders that are there whole or not at all, whoever is killed and whatever is full."""

import errno
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from lerobot_latentsafe.runtime import files
from lerobot_latentsafe.runtime.files import (
    FolderInUseError,
    OtherRunError,
    allocate,
    claim,
    discard,
    keep_room,
    locked_folder,
    refuse_existing,
    replacing,
    replacing_folder,
    scratch_folder,
)


class Killed(BaseException):
    """What ends a block as a signal would, but for what is left behind."""


def names(folder):
    return sorted(p.name for p in folder.iterdir())


@pytest.fixture
def ended():
    """The number of a process that has ended."""
    process = subprocess.Popen(["true"])
    process.wait()
    return process.pid


def fill(folder, text="new"):
    folder.mkdir()
    (folder / "a").write_text(text)
    (folder / "sub").mkdir()
    (folder / "sub" / "b").write_text(text)


def test_a_file_is_replaced_when_the_block_ends(tmp_path):
    path = tmp_path / "new folder" / "page.html"
    with replacing(path) as partial:
        partial.write_text("one")
        assert not path.exists()
    assert path.read_text() == "one" and names(path.parent) == ["page.html"]


@pytest.mark.parametrize("failure", [Killed, OSError(errno.ENOSPC, "No space left on device")])
def test_what_breaks_off_leaves_the_old_file(tmp_path, failure):
    path = tmp_path / "page.html"
    path.write_text("old")
    with pytest.raises((Killed, OSError)), replacing(path) as partial:
        partial.write_text("hal")
        raise failure
    assert path.read_text() == "old" and names(tmp_path) == ["page.html"]


def test_a_disk_that_is_full_when_all_is_written_leaves_the_old_file(tmp_path, monkeypatch):
    (tmp_path / "page.html").write_text("old")

    def full(descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(OSError, match="No space left"), replacing(tmp_path / "page.html") as partial:
        partial.write_text("new")
    assert (tmp_path / "page.html").read_text() == "old" and names(tmp_path) == ["page.html"]


def test_what_killed_processes_left_is_cleared_and_what_others_write_stays(tmp_path, ended):
    living = tmp_path / f".page.html.{os.getppid()}.partial"
    other = tmp_path / f".other.html.{ended}.partial"
    gone = tmp_path / f".page.html.{ended}.partial"
    for file in (living, other, gone):
        file.write_text("half")
    with replacing(tmp_path / "page.html") as partial:
        partial.write_text("whole")
    assert names(tmp_path) == sorted([living.name, other.name, "page.html"])


@pytest.mark.parametrize("empty", [False, True])
def test_a_folder_appears_whole(tmp_path, empty):
    path = tmp_path / "deep" / "out"
    if empty:
        path.mkdir(parents=True)
    with replacing_folder(path) as folder:
        fill(folder)
        assert not any(path.iterdir()) if empty else not path.exists()
    assert names(path.parent) == ["out"] and (path / "sub" / "b").read_text() == "new"


def test_a_folder_that_breaks_off_is_not_there(tmp_path):
    with pytest.raises(Killed), replacing_folder(tmp_path / "out") as folder:
        fill(folder)
        raise Killed
    assert names(tmp_path) == []


def test_what_a_killed_process_left_of_a_folder_is_cleared(tmp_path, ended):
    fill(tmp_path / f".out.{ended}.partial", "half")
    with replacing_folder(tmp_path / "out") as folder:
        fill(folder)
    assert names(tmp_path) == ["out"] and (tmp_path / "out" / "a").read_text() == "new"


def test_a_scratch_folder_goes_with_its_block_or_with_the_next_that_writes_the_same(tmp_path, ended):
    (tmp_path / f".out.scratch.{ended}.partial").mkdir()
    with replacing_folder(tmp_path / "out") as folder:
        assert names(tmp_path) == [".out.lock"]
        with scratch_folder(tmp_path / "out") as scratch:
            fill(scratch / "part")
            (scratch / "part").rename(folder)
        assert names(tmp_path) == [folder.name, ".out.lock"]
    assert names(tmp_path) == ["out"]


def test_a_folder_that_holds_something_is_left_alone(tmp_path):
    fill(tmp_path / "out", "precious")
    with pytest.raises(FileExistsError, match=r"out exists already; choose another --root"):  # noqa: SIM117
        with replacing_folder(tmp_path / "out", "--root"):
            raise AssertionError("nothing begins")
    assert (tmp_path / "out" / "a").read_text() == "precious"


def test_all_of_a_folder_is_put_on_disk(tmp_path, monkeypatch):
    synced, sync = [], files._sync
    monkeypatch.setattr(files, "_sync", lambda path: (synced.append(path.name), sync(path)))
    with replacing_folder(tmp_path / "out") as folder:
        fill(folder)
        (folder / "last").symlink_to("nowhere")
    assert {"a", "b", "sub", folder.name, tmp_path.name} == set(synced)


HOLDS = """
import os, sys
from pathlib import Path
from filelock import FileLock
with FileLock(sys.argv[1]):
    Path(sys.argv[1]).write_text(str(os.getpid()))
    print("locked", flush=True)
    sys.stdin.read()
"""  # as `locked_folder` does it, without a second's imports


def test_two_at_once_are_told_apart_and_a_killed_one_holds_nothing(tmp_path):
    out = tmp_path / "out"
    other = subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(tmp_path / ".out.lock")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert other.stdout.readline() == "locked\n"
    with pytest.raises(FolderInUseError, match=rf"process {other.pid} is writing {out} already"):  # noqa: SIM117
        with replacing_folder(out):
            raise AssertionError("nothing begins")
    other.kill()
    other.wait()
    assert names(tmp_path) == [".out.lock"]
    with locked_folder(out), replacing_folder(out) as folder:  # one thread may take it twice
        fill(folder)
    assert names(tmp_path) == ["out"]


def test_a_folder_is_removed_under_another_name(tmp_path, monkeypatch, ended):
    def killed(folder, **options):
        raise Killed

    fill(tmp_path / "parts")
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(
            files.shutil, "rmtree", lambda folder, ignore_errors=False: None if ignore_errors else killed(folder)
        )
        discard(tmp_path / "parts")
    assert names(tmp_path) == [f".parts.{os.getpid()}.partial"]
    discard(tmp_path / "parts")
    assert names(tmp_path) == []


def test_existing_things_are_refused(tmp_path):
    refuse_existing(tmp_path / "new")
    with pytest.raises(FileExistsError, match=r"exists already; choose another --output_dir or move it away"):
        refuse_existing(tmp_path)


def test_an_array_has_its_room_on_the_disk(tmp_path):
    file = tmp_path / "x.npy"
    allocate(file, np.float32, (1000, 10))
    array = np.load(file, mmap_mode="r+")
    assert array.shape == (1000, 10) and not array.any()
    if hasattr(os, "posix_fallocate"):
        assert file.stat().st_blocks * 512 >= 40_000  # no holes
    array[5] = 1
    keep_room(file)
    np.testing.assert_array_equal(np.load(file)[5], np.ones(10))


def test_a_full_disk_is_an_error_and_not_a_signal(tmp_path, monkeypatch):
    def full(descriptor, offset, size):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(files.os, "posix_fallocate", full, raising=False)
    with pytest.raises(OSError, match=r"No space left on device: .* needs .* GB for one array, and .* are free"):
        allocate(tmp_path / "x.npy", np.uint8, (10,))
    assert names(tmp_path) == []


def test_a_file_system_that_keeps_no_room_is_used_as_it_is(tmp_path, monkeypatch):
    def unknown(descriptor, offset, size):
        raise OSError(errno.EOPNOTSUPP, "Operation not supported")

    monkeypatch.setattr(files.os, "posix_fallocate", unknown, raising=False)
    allocate(tmp_path / "x.npy", np.uint8, (10,))
    assert np.load(tmp_path / "x.npy").shape == (10,)


def test_a_run_goes_on_with_its_options_alone(tmp_path):
    note = tmp_path / "run" / "options.json"
    claim(note, {"seed": 0, "sizes": (1, 2)})
    written = note.stat().st_mtime_ns
    claim(note, {"seed": 0, "sizes": [1, 2]})
    assert note.stat().st_mtime_ns == written  # once
    with pytest.raises(OtherRunError, match=r"run with other options \(new = null, seed = 0\).*the same options"):
        claim(note, {"seed": 1, "sizes": [1, 2], "new": 3})
    assert json.loads(note.read_text()) == {"seed": 0, "sizes": [1, 2]}


@pytest.mark.parametrize("content", ["", '{"se', "[1]", "3"])
def test_a_note_that_was_torn_is_told_with_what_to_do(tmp_path, content):
    note = tmp_path / "options.json"
    note.write_text(content)
    with pytest.raises(OtherRunError, match=r"options\.json .* not readable .*remove this one file.*all else is kept"):
        claim(note, {"seed": 0})
