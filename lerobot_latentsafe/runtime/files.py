"""Files and folders: nothing is overwritten unasked, what is written is there whole or not at all, and it stays.

Something is written under a name of its process, `.<name>.<process>.partial`, is put on disk, and then takes its name
at once. What a killed process leaves behind is cleared away by the next one that writes the same.
"""

import errno
import glob
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from filelock import FileLock, Timeout

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""What a system says of a disk that is full, or of a share of it that is used up."""


class FolderInUseError(OSError):
    """Another process writes into an output folder."""


class OtherRunError(ValueError):
    """An output folder is of a run with other options than those that are given."""


def refuse_existing(path: str | Path, option: str = "--output_dir") -> None:
    """Raise FileExistsError if something would be overwritten; called before any work is done."""
    if Path(path).exists():
        raise FileExistsError(f"{path} exists already; choose another {option} or move it away")


def refuse_filled(path: str | Path, option: str = "--output_dir") -> None:
    """Raise FileExistsError if a folder could not be written: it is there, and not empty, or it is the present one."""
    if not _is_empty(Path(path)) or Path(path) == Path.cwd():
        refuse_existing(path, option)


# -- whole or not at all ---


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A file to write to, that takes the place of `path` at once when the block ends, and is on disk then.

    Whatever happens, the old or the new file is there, whole.
    """
    path = Path(os.path.abspath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    _clear_partial(path)
    partial = _partial(path)
    try:
        yield partial
        _sync(partial)
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    _sync(path.parent)


@contextmanager
def replacing_folder(path: str | Path, option: str = "--output_dir") -> Iterator[Path]:
    """A folder to make and to fill, that becomes `path` at once when the block ends, and is on disk then.

    What is yielded is not there yet: LeRobot makes the folders of its datasets itself. Until the block ends no other
    process can write `path`.

    Args:
        option: that names the folder, for the error.

    Raises:
        FileExistsError: something is there already, other than an empty folder.
        FolderInUseError: another process writes it.
    """
    path = Path(os.path.abspath(path))
    with locked_folder(path):
        refuse_filled(path, option)
        partial = _partial(path)
        try:
            yield partial
            _sync_tree(partial)
            if path.exists():
                path.rmdir()  # empty, and Windows renames onto nothing
            os.replace(partial, path)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise
        _sync(path.parent)


@contextmanager
def scratch_folder(path: str | Path) -> Iterator[Path]:
    """An empty folder on the disk of `path` for what that is made of; gone when the block ends.

    After a kill it goes when `path` is written again.
    """
    path = Path(os.path.abspath(path))
    folder = _partial(path.with_name(f"{path.name}.scratch"))
    folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def locked_folder(path: str | Path) -> Iterator[None]:
    """Keep other processes from an output folder, which need not be there yet. The lock ends with its process.

    The same thread may take it again.

    Raises:
        FolderInUseError: another process has it, naming both.
    """
    path = Path(os.path.abspath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path.with_name(f".{path.name}.lock"), is_singleton=True)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise FolderInUseError(
            f"{_owner(Path(lock.lock_file))} is writing {path} already; wait until it ends, or choose another folder"
        ) from None
    try:
        _sign(Path(lock.lock_file))
        _clear_partial(path)
        yield
    finally:
        if lock.lock_counter == 1:
            with suppress(OSError):  # Windows removes no open file
                os.unlink(lock.lock_file)
        lock.release()


def discard(folder: Path) -> None:
    """Remove a folder; one that is removed in part does not keep its name."""
    gone = _partial(folder)
    shutil.rmtree(gone, ignore_errors=True)
    with suppress(FileNotFoundError):
        os.replace(folder, gone)
        shutil.rmtree(gone)


def _sign(lock: Path) -> None:
    """Say in a lock whose it is, unless it says so already, or cannot (Windows lets nobody write it)."""
    with suppress(OSError):
        if "\n" not in lock.read_text():
            lock.write_text(str(os.getpid()))


def _owner(lock: Path) -> str:
    """Who has a lock, as far as that can be told."""
    try:
        return f"process {int(lock.read_text().split()[0])}"
    except (OSError, ValueError, IndexError):
        return "another process"


def _is_empty(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())


def _partial(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.partial")


def _clear_partial(path: Path) -> None:
    """Remove what processes that have ended, or this one, have left half-written."""
    for partial in path.parent.glob(f".{glob.escape(path.name)}.*.partial"):
        process = partial.name.split(".")[-2]
        if process.isdigit() and (int(process) == os.getpid() or not psutil.pid_exists(int(process))):
            shutil.rmtree(partial) if partial.is_dir() else partial.unlink(missing_ok=True)


# -- on disk ---


def allocate(file: Path, dtype: Any, shape: tuple[int, ...]) -> None:
    """Make an array of zeros, .npy, whose room on the disk is kept for it.

    Raises:
        OSError: the disk is too full, with how much is missing.
    """
    with replacing(file) as partial:
        np.lib.format.open_memmap(partial, mode="w+", dtype=dtype, shape=shape)
        keep_room(partial, file.parent)


def keep_room(file: Path, folder: Path | None = None) -> None:
    """Have the disk keep room for all of a file: where there is none, writing to its memory map kills the process.

    Args:
        folder: that the error names; by default the file's.

    Raises:
        OSError: the disk is too full.
    """
    size = file.stat().st_size
    try:
        with file.open("rb+") as stream:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(stream.fileno(), 0, size)
    except OSError as e:
        if e.errno not in FULL:
            return  # a file system that keeps no room
        free = shutil.disk_usage(file.parent).free
        raise OSError(
            e.errno,
            f"{e.strerror}: {folder or file.parent} needs {size / 1e9:.3g} GB for one array, and {free / 1e9:.3g} GB "
            "are free. Make room and start again",
        ) from e


def _sync_tree(folder: Path) -> None:
    for path in (*folder.rglob("*"), folder):
        if not path.is_symlink():
            _sync(path)


def _sync(path: Path) -> None:
    """Have a file, or the names in a folder, survive a power cut, where the system knows how."""
    posix = hasattr(os, "O_DIRECTORY")
    if path.is_dir() and not posix:
        return
    descriptor = os.open(path, os.O_RDONLY if posix else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# -- one run a folder ---


def claim(note: Path, options: dict, remedy: str = "choose another folder") -> None:
    """Note what a folder's run is, once; whoever goes on with it must want the same.

    Args:
        note: a file in that folder.
        options: JSON-able.
        remedy: for whoever wants other options.

    Raises:
        OtherRunError: it is of a run with other options, which are named, or the note cannot be read.
    """
    options = json.loads(json.dumps(options))
    if not note.exists():
        with replacing(note) as partial:
            partial.write_text(json.dumps(options, indent=2))
        return
    names = differing(note, options)
    if names:
        raise OtherRunError(
            f"{note.parent} holds a run with other options ({', '.join(names)}), which a resumed one would mix; give "
            f"the same options to go on with it, or {remedy}"
        )


def differing(note: Path, options: dict) -> list[str]:
    """Names and noted values of the options that differ from a note.

    Raises:
        OtherRunError: the note cannot be read.
    """
    options = json.loads(json.dumps(options))
    try:
        known = dict(json.loads(note.read_text()))
    except (OSError, ValueError, TypeError) as e:
        raise OtherRunError(
            f"{note} says what the run in its folder is of, and is not readable ({e}). If it is of the same options, "
            "remove this one file and start again: all else is kept"
        ) from e
    return [_difference(name, known) for name in sorted({*known, *options}) if known.get(name) != options.get(name)]


def _difference(name: str, known: dict) -> str:
    value = json.dumps(known.get(name))
    return f"{name} = {value}" if len(value) < 60 else name
