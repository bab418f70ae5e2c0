"""Whether checkpoints are whole: nothing that was cut, edited or mistyped is ever run.

Three rules hold for every checkpoint. Its files are read by `read_json` and safetensors alone. What its files name is
looked for where `named_by` in `locations.py` says, and never fetched. What its seal covers is compared before it is
used.
"""

import hashlib
import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import draccus
import torch
from lerobot.configs.policies import PreTrainedConfig
from safetensors import SafetensorError, safe_open
from torch import Tensor

from lerobot_latentsafe.runtime.files import locked_folder, replacing_folder, scratch_folder
from lerobot_latentsafe.runtime.locations import CONFIG, CheckpointError
from lerobot_latentsafe.runtime.plugins import register_plugins

WEIGHTS, INTEGRITY = "model.safetensors", "integrity.json"
BASE_FOLDER = "base_policy"
"""The folder inside a filter's that holds the policy which it shields."""
LARGEST_JSON = 2**24
"""Bytes of the largest file of settings that is read."""
AGAIN = "copy or download the checkpoint again"


class CheckpointWriteError(OSError):
    """A checkpoint that could not be written, such as on a full disk; what was there before is as it was."""


class OldLayoutError(RuntimeError):
    """A configuration of an earlier version, with the command that migrates it.

    No ValueError: of those draccus, which reads configurations for LeRobot, drops the message.
    """


# -- what they say ---


def read_json(file: Path) -> dict[str, Any]:
    """What a checkpoint's file of settings says.

    Raises:
        CheckpointError: missing, too large, or no JSON object; NaN is none.
    """
    if not file.is_file():
        raise CheckpointError(f"{file} is missing; {AGAIN}")
    try:
        if file.stat().st_size > LARGEST_JSON:
            raise ValueError(f"{file.stat().st_size} bytes, at most {LARGEST_JSON} are read")
        found = json.loads(file.read_text(encoding="utf-8"), parse_constant=_constant)
        if not isinstance(found, dict):
            raise ValueError(f"a {type(found).__name__}, expected an object")
    except (OSError, ValueError, RecursionError) as e:
        raise CheckpointError(f"{file} is not readable ({e}); {AGAIN}") from e
    return found


def _constant(name: str) -> float:
    if name == "NaN":
        raise ValueError("it holds NaN")
    return float(name)


def read_config(folder: Path, device: str | None = None) -> PreTrainedConfig:
    """A checkpoint's configuration.

    Args:
        device: to run on; None takes the checkpoint's.

    Raises:
        CheckpointError: config.json is missing, not readable or of an old layout.
    """
    register_plugins()
    read_json(folder / CONFIG)
    try:
        config = PreTrainedConfig.from_pretrained(folder)
    except Exception as e:  # draccus meets with entries of any type, and each setting has checks of its own
        reason: BaseException = e
        while isinstance(reason, draccus.utils.ParsingError) and reason.__cause__:  # where; its cause says what
            reason = reason.__cause__
        if isinstance(reason, OldLayoutError):
            raise CheckpointError(f"{folder}: {reason}") from e
        raise CheckpointError(f"{folder / CONFIG} is not readable ({reason}); correct that entry, or {AGAIN}") from e
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
    except (RuntimeError, SafetensorError) as e:
        raise CheckpointError(f"weights of {folder} do not fit its {CONFIG}: {e}") from e


def _check_tensors(file: Path) -> None:
    """Refuse weights that are cut, that claim to be larger than their file, or that are not finite."""
    try:
        with safe_open(file, "pt") as weights:
            wrong = [name for name in weights.keys() if not weights.get_tensor(name).isfinite().all()]  # noqa: SIM118
    except (SafetensorError, OSError, RuntimeError, MemoryError, OverflowError) as e:
        raise CheckpointError(f"{file} is not readable ({e}); {AGAIN}") from e
    if wrong:
        raise CheckpointError(f"{file} holds weights that are not finite: {', '.join(wrong[:3])}; train it again")


# -- whether they are whole ---


def _digest(file: Path) -> str:
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def weights_digest(weights: dict[str, Tensor]) -> str:
    """What tells weights apart, name -> tensor, wherever they lie: SHA-256 of their numbers in order.

    Fractions count in half precision, as they may be stored.
    """
    known = hashlib.sha256()
    for tensor in weights.values():
        numbers = tensor.detach().cpu()
        numbers = numbers.half() if numbers.is_floating_point() else numbers
        known.update(numbers.contiguous().reshape(-1).view(torch.uint8).numpy())
    return known.hexdigest()


def _entry(config: dict[str, Any], name: str) -> dict[str, Any]:
    """An entry of a configuration, such as `margin.hidden`, by its name; nothing if it is not there."""
    value: Any = config
    for part in name.split("."):
        if not isinstance(value, dict) or part not in value:
            return {}
        value = value[part]
    return {name: value}


def _config_digest(folder: Path, entries: Sequence[str]) -> str:
    config = read_json(folder / CONFIG)
    sealed: dict[str, Any] = {}
    for name in entries:
        sealed |= _entry(config, name)
    return hashlib.sha256(json.dumps(sealed, sort_keys=True).encode()).hexdigest()


def _deciding_files(folder: Path) -> dict[str, str]:
    """Processors of a checkpoint, and all of the policy in it: file -> hash."""
    files = [*folder.glob("policy_*.json"), *folder.glob("policy_*.safetensors"), *(folder / BASE_FOLDER).rglob("*")]
    names = (f.relative_to(folder).as_posix() for f in files if f.is_file() and not f.name.startswith("."))
    return {name: _digest(folder / name) for name in sorted(names)}


def seal(folder: Path, entries: Sequence[str]) -> None:
    """Record hashes of a checkpoint's weights, processors and base policy, and of what of its configuration decides.

    Args:
        entries: of the configuration, such as `trained_on` or `margin.hidden`.
    """
    file = folder / WEIGHTS
    record = {
        "sha256": _digest(file),
        "bytes": file.stat().st_size,
        "config_sha256": _config_digest(folder, entries),
        "entries": list(entries),
        "files": _deciding_files(folder),
    }
    (folder / INTEGRITY).write_text(json.dumps(record, indent=2))


def seal_again(folder: Path) -> None:
    """Record a checkpoint and the sealed ones in it anew, after they were changed on purpose: the innermost first."""
    for record in sorted(folder.rglob(INTEGRITY), key=lambda file: -len(file.parts)):
        seal(record.parent, read_json(record)["entries"])


def check_sealed(folder: Path, entries: Sequence[str]) -> None:
    """Compare a checkpoint with its record.

    Args:
        entries: of the configuration that the record must cover; older versions recorded fewer than this one does.

    Raises:
        CheckpointError: weights missing, truncated, changed or not finite; a recorded entry or file changed; a file
            added to the base policy.
    """
    file, record = folder / WEIGHTS, folder / INTEGRITY
    if missing := [f.name for f in (file, record) if not f.is_file()]:
        raise CheckpointError(f"{folder} lacks {', '.join(missing)}; expected a folder written by save_pretrained")
    expected = _read_record(record, entries)
    if file.stat().st_size != expected["bytes"]:
        raise CheckpointError(
            f"{file} is truncated: {file.stat().st_size} bytes, {expected['bytes']} were saved; copy or download it "
            "again"
        )
    if _digest(file) != expected["sha256"]:
        raise CheckpointError(
            f"{file} does not match its recorded hash: it was changed after saving. A safety filter with edited "
            "weights is not loaded; save it again with save_pretrained if the change was meant"
        )
    if _config_digest(folder, expected["entries"]) != expected["config_sha256"]:
        raise CheckpointError(
            f"{folder / CONFIG} was edited: {', '.join(expected['entries'])} belong to the weights. Restore it; only "
            "the law and other options may be changed by hand"
        )
    if expected["files"] is not None:
        _check_files(folder, expected["files"])
    _check_tensors(file)


def _read_record(record: Path, entries: Sequence[str]) -> dict[str, Any]:
    """The record of a seal, of the present or of an older version, which had no `files`."""
    found = {"entries": list(entries), "files": None, **read_json(record)}
    types = {"sha256": str, "bytes": int, "config_sha256": str, "entries": list, "files": dict | None}
    lacking = [name for name, kind in types.items() if not isinstance(found.get(name), kind)]
    if not lacking:
        lacking = [name for name in entries if name not in found["entries"]]
    if lacking or not all(isinstance(name, str) for name in found["entries"]):
        raise CheckpointError(f"{record} is not readable (it says nothing of {', '.join(lacking)}); {AGAIN}")
    return found


def _check_files(folder: Path, expected: dict[str, str]) -> None:
    """Compare processors and base policy; LeRobot's commands write processors after the policy, unrecorded."""
    found = _deciding_files(folder)
    added = [name for name in found if name not in expected and name.startswith(f"{BASE_FOLDER}/")]
    changed = [name for name, digest in expected.items() if found.get(name) != digest]
    for names, what in ((changed, "was changed or removed"), (added, "was added")):
        if names:
            raise CheckpointError(
                f"{folder / names[0]} {what} after saving. It decides what the weights mean, so it is not loaded; "
                f"restore it, or {AGAIN}. Change a policy before it is wrapped, and wrap it again"
            )


def check_in_use(folder: Path, config: PreTrainedConfig, entries: Sequence[str]) -> None:
    """Compare the configuration that is about to be used with the checkpoint's, whoever changed it.

    Raises:
        CheckpointError: an entry that belongs to the weights was overridden.
    """
    own, used = (draccus.encode(c, PreTrainedConfig) for c in (read_config(folder), config))
    for name in entries:
        ours, theirs = _entry(own, name).get(name), _entry(used, name).get(name)
        if ours != theirs:
            what = [f"{name}.{key}" for key in ours if ours[key] != theirs.get(key)] if _alike(ours, theirs) else [name]
            raise CheckpointError(
                f"--policy.{(what or [name])[0]} was overridden: {', '.join(what or [name])} belong to the weights of "
                f"{folder} and are what these were trained with. Leave the option out, or train another filter"
            )


def _alike(*values: Any) -> bool:
    return all(isinstance(value, dict) for value in values)


# -- writing ---


@contextmanager
def writing_checkpoint(folder: str | Path) -> Iterator[Path]:
    """A new folder beside `folder` to write a checkpoint to, whose files take their place together at the end.

    A folder that holds other files keeps these. Whoever is stopped while files are moved there leaves no record of a
    seal, so that what lies there is refused.

    Raises:
        CheckpointWriteError: such as on a full disk; nothing in `folder` was changed.
    """
    folder = Path(folder).resolve()
    try:
        if not folder.exists() or not any(folder.iterdir()):
            with replacing_folder(folder) as partial:
                partial.mkdir()
                yield partial
            return
        with locked_folder(folder), scratch_folder(folder) as partial:
            yield partial
            _move_into(folder, partial)
    except (OSError, SafetensorError) as e:
        raise CheckpointWriteError(
            f"the checkpoint {folder} could not be written ({e}); no part of it was left there. Free some space or "
            "choose another folder, then save it again"
        ) from e


def _move_into(folder: Path, partial: Path) -> None:
    (folder / INTEGRITY).unlink(missing_ok=True)
    for entry in sorted(partial.iterdir(), key=lambda entry: entry.name == INTEGRITY):
        place = folder / entry.name
        if place.is_dir():
            shutil.rmtree(place)
        entry.replace(place)
