"""What is said of a dataset or a file of it that cannot be used."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

DOWNLOAD_AGAIN = "download or copy the dataset again"
"""The remedy for what is not whole."""


class DatasetContractError(ValueError):
    """A dataset that cannot be used as it is: which file or feature, what was expected, and what to do."""


class BrokenFileError(DatasetContractError):
    """A file of a dataset that is missing, cut or damaged."""


@contextmanager
def reading(path: Path, remedy: str = DOWNLOAD_AGAIN) -> Iterator[None]:
    """Name the file, and what to do, whatever a library says of one that it cannot read.

    Raises:
        BrokenFileError: in place of the library's error.
    """
    try:
        yield
    except DatasetContractError:
        raise
    except Exception as e:  # of pyarrow, json, av, torch: each has classes of its own
        reason = " ".join(str(e).split()) or type(e).__name__
        raise BrokenFileError(
            f"{path} cannot be read: it is missing, cut or damaged ({reason[:200]}). Please {remedy}"
        ) from e


def some(numbers: list) -> str:
    """The first ten of a list, in words."""
    return ", ".join(str(n) for n in numbers[:10]) + (f" and {len(numbers) - 10} more" if len(numbers) > 10 else "")
