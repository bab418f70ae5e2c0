"""Files: nothing is overwritten unasked, and what is written is there whole or not at all."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def refuse_existing(path: str | Path, option: str = "--output_dir") -> None:
    """Raise FileExistsError if something would be overwritten; called before any work is done."""
    if Path(path).exists():
        raise FileExistsError(f"{path} exists already; choose another {option} or delete it")


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A file to write to, that takes the place of `path` at once when the block ends, and is on disk then.

    Whatever happens, the old or the new file is there, whole.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


@contextmanager
def replacing_folder(path: str | Path) -> Iterator[Path]:
    """A new folder beside `path` to write to, that becomes `path` at once when the block ends, and is on disk then.

    Whatever happens, `path` holds all that was written or is as it was.

    Raises:
        FileExistsError: `path` is a folder that holds something, or a file.
    """
    path = Path(path)
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise FileExistsError(f"{path} exists already; choose another folder or delete it")
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True)
        yield partial
        for file in (f for f in partial.rglob("*") if f.is_file()):
            with file.open("rb+") as written:
                os.fsync(written.fileno())
        os.replace(partial, path)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Make a rename survive a power cut, where the system knows how."""
    if hasattr(os, "O_DIRECTORY"):
        descriptor = os.open(folder, os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
