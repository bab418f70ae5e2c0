"""Checkpoints of versions before 0.2, whose configuration was flat, in the present layout."""

import json
import shutil
from pathlib import Path
from typing import Any

from safetensors.torch import load_file, save_file

from lerobot_latentsafe.configuration_latentsafe import SEALED, SEALED_ENTRIES
from lerobot_latentsafe.runtime.checkpoint import INTEGRITY, WEIGHTS, check_sealed, read_json, seal
from lerobot_latentsafe.runtime.files import refuse_existing, replacing_folder
from lerobot_latentsafe.runtime.locations import CONFIG, CheckpointError

MOVED = {
    **{f"margin_{name}": ("margin", name) for name in ("hidden", "layers", "delta", "weight", "clips")},
    "failure_specification": ("margin", "failure_specification"),
    "action_candidates": ("fallback", "action_candidates"),
    "kept_commands": ("fallback", "frozen_commands"),
    "fallback_moves": ("fallback", "moves"),
    "fallback_low": ("fallback", "low"),
    "fallback_high": ("fallback", "high"),
    "law": ("law", "name"),
    "release": ("law", "resume_above"),
    "guard": ("law", "proposal_steps"),
    "memory": ("law", "history_frames"),
    "patience": ("law", "retreat_after"),
    "dwell": ("law", "min_retreat_steps"),
    **{name: ("law", name) for name in ("mode", "epsilon", "lookahead", "samples", "deadline_ms", "retreat")},
    **{
        name: ("trained_on", name)
        for name in (
            "stage", "target", "task", "cameras", "robot_type", "fps", "state_names", "action_names", "action_low",
            "action_high", "action_varies", "state_mean", "state_std",
        )
    },
}  # fmt: skip
"""Entry of the flat configuration -> its group and name there."""

SEALED_WHEN_FLAT = (
    "world_model",
    *(old for old, (group, _) in MOVED.items() if group in SEALED and old != "robot_type"),
)
"""Entries of the flat configuration that belonged to the weights."""


def is_old(config: dict[str, Any]) -> bool:
    """Whether a config.json is a filter's in the flat layout."""
    return config.get("type") == "latentsafe" and "margin" not in config


def migrated(config: dict[str, Any]) -> dict[str, Any]:
    """A flat configuration of a filter in groups."""
    groups: dict[str, Any] = {"margin": {}, "fallback": {}, "law": {}, "trained_on": {}}
    for name, value in config.items():
        if name in MOVED:
            group, entry = MOVED[name]
            groups[group][entry] = value
        else:
            groups[name] = value
    if groups["trained_on"].get("stage") == "reachability":
        groups["trained_on"]["stage"] = "critic"
    reachability = groups.get("reachability", {})
    if "kept" in reachability:
        reachability["learned_steps"] = reachability.pop("kept")
    return groups


def migrate_checkpoint(source: str | Path, output_dir: str | Path) -> list[str]:
    """Copy a checkpoint, with whatever filters lie in it, and migrate those of the old layout.

    Returns:
        The migrated folders, relative to output_dir.

    Raises:
        FileExistsError: output_dir exists.
        CheckpointError: nothing there is of the old layout, or it was cut or edited since it was saved.
    """
    source, output_dir = Path(source), Path(output_dir)
    refuse_existing(output_dir)
    folders = [file.parent.relative_to(source) for file in source.rglob(CONFIG) if is_old(read_json(file))]
    if not folders:
        raise CheckpointError(f"{source} holds no filter of the old layout; nothing was written")
    for folder in folders:
        if (source / folder / INTEGRITY).exists():
            check_sealed(source / folder, SEALED_WHEN_FLAT)  # sealed anew, it would pass for what was saved
    with replacing_folder(output_dir) as partial:
        shutil.copytree(source, partial, dirs_exist_ok=True)
        for folder in sorted(folders, key=lambda folder: -len(folder.parts)):  # a seal covers what lies inside
            _migrate_in_place(partial / folder)
    return [str(folder) for folder in sorted(folders)]


def _migrate_in_place(folder: Path) -> None:
    config = migrated(read_json(folder / CONFIG))
    (folder / CONFIG).write_text(json.dumps(config, indent=4))
    tensors = load_file(folder / WEIGHTS)
    save_file({f"model.{name}": tensor for name, tensor in tensors.items()}, folder / WEIGHTS, {"format": "pt"})
    if (folder / INTEGRITY).exists():
        seal(folder, SEALED_ENTRIES)
