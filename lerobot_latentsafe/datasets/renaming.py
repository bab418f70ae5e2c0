"""Features of other names than LeRobot's: which are meant, and a copy of a dataset in which they are renamed."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from lerobot_latentsafe.datasets.reading import DatasetContractError, reading
from lerobot_latentsafe.runtime.files import refuse_existing, replacing_folder

ACTION, STATE, OBSERVATION = "action", "observation.state", "observation."
HUGGINGFACE = b"huggingface"
MEANT = {ACTION: ("action", "actions"), STATE: ("state", "states", "qpos", "proprio")}
"""LeRobot's name -> the last parts of names that others give to the same."""


def renames_of(features: dict[str, dict]) -> dict[str, str]:
    """Names that are found -> LeRobot's names, of features that a policy would not be given as they are.

    LeRobot hands a policy `action` and what begins with `observation.`, and nothing else.
    """
    renames: dict[str, str] = {}
    for expected, endings in MEANT.items():
        if expected not in features:
            found = [key for key, f in features.items() if _last(key) in endings and _is_number(f)]
            renames |= {found[0]: expected} if len(found) == 1 else {}
    for key, feature in features.items():
        if feature["dtype"] in ("image", "video") and not key.startswith(OBSERVATION):
            renames[key] = f"observation.images.{_last(key)}"
    return renames


def rename_command(root: Path, renames: dict[str, str]) -> str:
    """What to type for a copy with these names."""
    return (
        f"latentsafe rename-features --dataset.root={root} --rename_map='{json.dumps(renames)}' "
        f"--output_dir={root}_renamed"
    )


def _last(key: str) -> str:
    return key.replace("/", ".").rpartition(".")[2].lower()


def _is_number(feature: dict) -> bool:
    return feature["dtype"].startswith(("float", "int", "uint"))


def renamed_copy(root: Path, renames: dict[str, str], output_dir: Path) -> None:
    """Copy a dataset's folder with other names of features; nothing is decoded or encoded.

    Raises:
        DatasetContractError: a feature that there is not, or a name that another has.
        FileExistsError: output_dir exists.
    """
    refuse_existing(output_dir)
    features = json.loads((root / "meta/info.json").read_text())["features"]
    unknown = [key for key in renames if key not in features]
    if unknown or not renames:
        raise DatasetContractError(
            f"--rename_map names {', '.join(unknown) or 'no feature'}; the features of {root} are {', '.join(features)}"
        )
    names = [renames.get(key, key) for key in features]
    if taken := sorted({name for name in names if names.count(name) > 1}):
        raise DatasetContractError(f"--rename_map gives the name {', '.join(taken)} twice; each feature needs its own")
    with replacing_folder(output_dir) as begun:
        for file in sorted(path for path in root.rglob("*") if path.is_file()):
            copy = begun / _renamed_path(file.relative_to(root), renames)
            copy.parent.mkdir(parents=True, exist_ok=True)
            _copy_file(file, copy, file.relative_to(root), renames)


def _renamed_path(path: Path, renames: dict[str, str]) -> Path:
    """`videos/<feature>/...` of the feature's new name."""
    for found, expected in renames.items():
        before, after = Path("videos", found), Path("videos", expected)
        if path.is_relative_to(before):
            return after / path.relative_to(before)
    return path


def _copy_file(file: Path, copy: Path, place: Path, renames: dict[str, str]) -> None:
    if place.suffix == ".parquet" and place.parts[0] in ("data", "meta"):
        with reading(file):
            _rename_columns(file, copy, renames)
    elif place.as_posix() in ("meta/info.json", "meta/stats.json"):
        with reading(file):
            content = json.loads(file.read_text())
        info = place.name == "info.json"
        renamed = {**content, "features": _renamed_keys(content["features"], renames)} if info else None
        copy.write_text(json.dumps(renamed or _renamed_keys(content, renames), indent=4))
    else:
        _link(file, copy)


def _link(file: Path, copy: Path) -> None:
    """The same file under another name where the disk can do that, or else a copy."""
    try:
        os.link(file.resolve(), copy)
    except OSError:
        shutil.copyfile(file, copy)


def _renamed_keys(content: dict[str, Any], renames: dict[str, str]) -> dict[str, Any]:
    return {renames.get(key, key): value for key, value in content.items()}


def _rename_columns(file: Path, copy: Path, renames: dict[str, str]) -> None:
    """Rewrite a parquet file, row group by row group: LeRobot reads an episode's by itself."""
    source = pq.ParquetFile(file)
    names = [_renamed_column(name, renames) for name in source.schema_arrow.names]
    metadata = dict(source.schema_arrow.metadata or {})
    if HUGGINGFACE in metadata:  # says again what the features are
        described = json.loads(metadata[HUGGINGFACE])
        described["info"]["features"] = _renamed_keys(described["info"]["features"], renames)
        metadata[HUGGINGFACE] = json.dumps(described)
    renamed = lambda table: table.rename_columns(names).replace_schema_metadata(metadata)  # noqa: E731
    with pq.ParquetWriter(copy, renamed(source.schema_arrow.empty_table()).schema) as writer:
        for group in range(source.num_row_groups):
            writer.write_table(renamed(source.read_row_group(group)))


def _renamed_column(name: str, renames: dict[str, str]) -> str:
    for found, expected in renames.items():
        if name == found:
            return expected
        for folder in ("stats", "videos"):
            if name.startswith(f"{folder}/{found}/"):
                return f"{folder}/{expected}/{name.removeprefix(f'{folder}/{found}/')}"
    return name
