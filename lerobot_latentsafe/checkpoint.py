"""Where checkpoints come from and whether they are whole: nothing that was cut, edited or mistyped is ever run."""

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lerobot.configs.policies import PreTrainedConfig

PRETRAINED = Path(__file__).parent / "pretrained"
WEIGHTS, INTEGRITY = "model.safetensors", "integrity.json"


class CheckpointError(ValueError):
    """A checkpoint that is missing, truncated, edited or of another type."""


def committed_names() -> list[str]:
    """Names of the checkpoints that come with the package."""
    return sorted(p.parent.name for p in PRETRAINED.glob("*/config.json"))


def resolve_checkpoint(path: str | Path, revision: str | None = None, **hub: object) -> Path:
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
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(str(path), revision=revision, **hub))
    except Exception as e:
        raise CheckpointError(
            f"could not get {path!s} from the Hub ({type(e).__name__}: {e}). Check the id and the connection, "
            "or give a local folder"
        ) from e


def read_config(folder: Path) -> "PreTrainedConfig":
    """A checkpoint's configuration.

    Raises:
        CheckpointError: config.json is missing or not readable.
    """
    import draccus
    from lerobot.configs.policies import PreTrainedConfig

    try:
        return PreTrainedConfig.from_pretrained(folder)
    except (OSError, ValueError, draccus.utils.DecodingError) as e:
        raise CheckpointError(f"{folder / 'config.json'} is missing or not readable ({e})") from e


@contextmanager
def fitting_weights(folder: Path) -> Iterator[None]:
    """Name the checkpoint whose weights do not fit its configuration, where they are loaded.

    Raises:
        CheckpointError: naming the folder.
    """
    try:
        yield
    except RuntimeError as e:
        raise CheckpointError(f"weights of {folder} do not fit its config.json: {e}") from e


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


TRAINED = (
    "stage", "target", "task", "world_model", "cameras", "fps", "state_names", "action_names", "action_low",
    "action_high", "action_varies", "state_mean", "state_std", "action_candidates", "kept_commands", "fallback_moves",
    "fallback_low", "fallback_high",
)  # fmt: skip
"""Entries of config.json that belong to the weights; epsilon, mode, device and the like are the user's."""


def _trained_digest(folder: Path) -> str:
    config = json.loads((folder / "config.json").read_text())
    return hashlib.sha256(
        json.dumps({k: config[k] for k in TRAINED if k in config}, sort_keys=True).encode()
    ).hexdigest()


def seal(folder: Path) -> None:
    """Record the hash and size of the weights, and the hash of the config's entries that belong to them."""
    file = folder / WEIGHTS
    record = {"sha256": _digest(file), "bytes": file.stat().st_size, "config_sha256": _trained_digest(folder)}
    (folder / INTEGRITY).write_text(json.dumps(record, indent=2))


def check_sealed(folder: Path) -> None:
    """Compare a filter's weights with their recorded hash.

    Raises:
        CheckpointError: weights missing, truncated or changed.
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
    if _trained_digest(folder) != config_sha256:
        raise CheckpointError(
            f"{folder / 'config.json'} was edited: {', '.join(TRAINED)} belong to the weights. Restore it; only "
            "epsilon, mode and other options may be changed by hand"
        )
