"""Where a checkpoint is that a user names, or that the files of another name.

What files name is somebody's data: it is looked for where `named_by` says, and never fetched.
"""

from pathlib import Path
from typing import Any

from huggingface_hub import constants, snapshot_download

PRETRAINED = Path(__file__).parents[1] / "pretrained"
CONFIG = "config.json"


class CheckpointError(ValueError):
    """A checkpoint that is missing, truncated, edited or of another type."""


def committed_names() -> list[str]:
    """Names of the checkpoints that come with the package."""
    return sorted(p.parent.name for p in PRETRAINED.glob(f"*/{CONFIG}"))


def resolve_checkpoint(path: str | Path, revision: str | None = None, **hub: Any) -> Path:
    """A local folder for what a user names: a folder, the name of a committed checkpoint, or a Hub id.

    Raises:
        CheckpointError: none of the three.
    """
    folder = Path(path)
    if folder.is_dir():
        return folder
    if str(path) in committed_names():
        return PRETRAINED / str(path)
    if str(path).count("/") != 1 or str(path).startswith((".", "/")):
        raise CheckpointError(
            f"no checkpoint at {path!s}: expected a folder, one of {', '.join(committed_names()) or '(none)'}, "
            "or a Hub id such as me/filter"
        )
    try:
        return Path(snapshot_download(str(path), revision=revision, **hub))
    except Exception as e:
        raise CheckpointError(
            f"could not get {path!s} from the Hub ({type(e).__name__}: {e}). Check the id and the connection, "
            "or give a local folder"
        ) from e


def is_downloaded(folder: Path) -> bool:
    """Whether a folder lies in the Hub's cache, or was written by `hf download`."""
    in_cache = folder.resolve().is_relative_to(Path(constants.HF_HUB_CACHE).resolve())
    return in_cache or (folder / ".cache" / "huggingface").exists()


def inside(folder: Path, name: str) -> Path | None:
    """A folder of this name directly in another; None if there is none, or if it is a link to elsewhere."""
    found = folder / name
    return found if found.is_dir() and found.resolve() == folder.resolve() / name else None


def named_by(folder: Path, name: str, remedy: str, revision: str | None = None) -> Path:
    """A local folder for what a file of a checkpoint names, which is somebody's data and not the user's wish.

    That is a folder directly inside the checkpoint's, a committed checkpoint, or what the user has on this machine
    already: a Hub id in the cache, or, for a checkpoint that was not downloaded itself, any folder. Nothing is fetched.

    Args:
        remedy: how the user says it himself.

    Raises:
        CheckpointError: none of them.
    """
    found, cause = inside(folder, name) if Path(name).name == name else None, None
    if found is not None:
        return found
    if name in committed_names():
        return PRETRAINED / name
    if not Path(name).is_dir():
        try:
            return resolve_checkpoint(name, revision, local_files_only=True)
        except CheckpointError as e:
            cause = e
    elif not is_downloaded(folder):
        return Path(name)
    raise CheckpointError(
        f"{folder} names {name}, and there is no checkpoint at {name} that it may name: one in its own folder, or in "
        f"the Hub's cache. Nothing is fetched because a file says so. {remedy}"
    ) from cause
