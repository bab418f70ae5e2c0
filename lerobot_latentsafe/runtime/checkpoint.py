"""Where checkpoints come from and whether they are whole: nothing that was cut, edited or mistyped is ever run."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import draccus
from huggingface_hub import snapshot_download
from lerobot.configs.policies import PreTrainedConfig

PRETRAINED = Path(__file__).parents[1] / "pretrained"
CONFIG, WEIGHTS, INTEGRITY = "config.json", "model.safetensors", "integrity.json"


class CheckpointError(ValueError):
    """A checkpoint that is missing, truncated, edited or of another type."""


class OldLayoutError(RuntimeError):
    """A configuration of an earlier version, with the command that migrates it.

    No ValueError: of those draccus, which reads configurations for LeRobot, drops the message.
    """


def committed_names() -> list[str]:
    """Names of the checkpoints that come with the package."""
    return sorted(p.parent.name for p in PRETRAINED.glob(f"*/{CONFIG}"))


def resolve_checkpoint(path: str | Path, revision: str | None = None, **hub: Any) -> Path:
    """A local folder for a folder, the name of a committed checkpoint, or a Hub id.

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


def read_config(folder: Path, device: str | None = None) -> PreTrainedConfig:
    """A checkpoint's configuration.

    Args:
        device: to run on; None takes the checkpoint's.

    Raises:
        CheckpointError: config.json is missing, not readable or of an old layout.
    """
    try:
        config = PreTrainedConfig.from_pretrained(folder)
    except (OSError, ValueError, draccus.utils.DecodingError) as e:
        if isinstance(e.__cause__, OldLayoutError):
            raise CheckpointError(f"{folder}: {e.__cause__}") from e
        raise CheckpointError(f"{folder / CONFIG} is missing or not readable ({e})") from e
    if device is not None:
        config.device = device
    return config


@contextmanager
def fitting_weights(folder: Path) -> Iterator[None]:
    """Name the checkpoint whose weights do not fit its configuration, where they are loaded.

    Raises:
        CheckpointError: naming the folder.
    """
    try:
        yield
    except RuntimeError as e:
        raise CheckpointError(f"weights of {folder} do not fit its {CONFIG}: {e}") from e


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _config_digest(folder: Path, entries: Sequence[str]) -> str:
    config = json.loads((folder / CONFIG).read_text())
    sealed = {name: config[name] for name in entries if name in config}
    return hashlib.sha256(json.dumps(sealed, sort_keys=True).encode()).hexdigest()


def seal(folder: Path, entries: Sequence[str]) -> None:
    """Record the hash and size of the weights, and the hash of the configuration's entries that belong to them."""
    file = folder / WEIGHTS
    record = {
        "sha256": _digest(file),
        "bytes": file.stat().st_size,
        "config_sha256": _config_digest(folder, entries),
        "entries": list(entries),
    }
    (folder / INTEGRITY).write_text(json.dumps(record, indent=2))


def seal_again(folder: Path) -> None:
    """Record the weights anew, after they were rewritten on purpose, with the entries that were sealed before."""
    seal(folder, json.loads((folder / INTEGRITY).read_text())["entries"])


def check_sealed(folder: Path, entries: Sequence[str]) -> None:
    """Compare a checkpoint's weights, and these entries of its configuration, with their recorded hashes.

    Raises:
        CheckpointError: weights missing, truncated or changed, or an entry changed.
    """
    file, record = folder / WEIGHTS, folder / INTEGRITY
    if not file.exists() or not record.exists():
        missing = [f.name for f in (file, record) if not f.exists()]
        raise CheckpointError(f"{folder} lacks {', '.join(missing)}; expected a folder written by save_pretrained")
    try:
        expected = json.loads(record.read_text())
        size, sha256, config_sha256 = expected["bytes"], expected["sha256"], expected["config_sha256"]
    except (json.JSONDecodeError, KeyError, TypeError) as e:
        raise CheckpointError(f"{record} is not readable ({e}); copy the checkpoint again") from e
    if file.stat().st_size != size:
        raise CheckpointError(
            f"{file} is truncated: {file.stat().st_size} bytes, {size} were saved; copy or download it again"
        )
    if _digest(file) != sha256:
        raise CheckpointError(
            f"{file} does not match its recorded hash: it was changed after saving. A safety filter with edited "
            "weights is not loaded; save it again with save_pretrained if the change was meant"
        )
    if _config_digest(folder, entries) != config_sha256:
        raise CheckpointError(
            f"{folder / CONFIG} was edited: {', '.join(entries)} belong to the weights. Restore it; only the law and "
            "other options may be changed by hand"
        )
