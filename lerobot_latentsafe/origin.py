"""What a base policy was trained on: names and order of its numbers, and its rate, as far as files here tell.

A policy's own configuration rarely says it. LeRobot writes train_config.json beside a checkpoint, and that names a
dataset.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from huggingface_hub.utils import HFValidationError, validate_repo_id
from lerobot.configs.policies import PreTrainedConfig
from lerobot.utils.constants import ACTION, HF_LEROBOT_HOME, HF_LEROBOT_HUB_CACHE, OBS_STATE

from lerobot_latentsafe.runtime.checkpoint import read_json
from lerobot_latentsafe.runtime.locations import CheckpointError, is_downloaded

FILE = "trained_on.json"
"""What is known of a policy's origin, in its folder; a person may write it. It counts more than everything else."""


@dataclass
class Origin:
    """Names of the numbers of an action and of a state, in order, and the rate. None where nothing tells."""

    action_names: list[str] | None = None
    state_names: list[str] | None = None
    fps: float | None = None

    @classmethod
    def of(cls, config: PreTrainedConfig, folder: Path | None = None) -> "Origin":
        """What is known of a policy: by `FILE`, by its configuration, by the dataset that it was trained on.

        Args:
            folder: the policy's; by default where it was loaded from, if that is on this machine.

        Raises:
            ValueError: `FILE` is not readable.
        """
        folder = folder or getattr(config, "pretrained_path", None)
        own = {
            "action_names": getattr(config, "action_names", None) or getattr(config, "action_feature_names", None),
            "state_names": getattr(config, "state_names", None),
            "fps": getattr(config, "fps", None),
        }
        told = [_told(Path(folder) / FILE), own, _of_dataset(Path(folder))] if folder else [own]
        return cls(**{name: next((t[name] for t in told if t.get(name)), None) for name in own})

    def save(self, folder: Path) -> None:
        """Write what is known to a policy's folder, if anything is."""
        known = {name: value for name, value in asdict(self).items() if value}
        if known:
            (folder / FILE).write_text(json.dumps(known, indent=2))


def order(theirs: Sequence[str] | None, ours: Sequence[str] | None, what: str) -> list[int] | None:
    """Where each of our names stands in their list; None if it is our list, or if either is not known.

    Raises:
        ValueError: they name other things.
    """
    if not theirs or not ours or list(theirs) == list(ours):
        return None
    if len(theirs) != len(ours) or set(theirs) != set(ours):
        raise ValueError(
            f"{what} {', '.join(theirs)}, the filter {', '.join(ours)}. If they are the same numbers by other names, "
            f"write them as the filter names them, in the policy's order, into a file {FILE} in its folder: "
            f'{{"action_names": [...], "state_names": [...]}}'
        )
    return [list(theirs).index(name) for name in ours]


def inverse(order: list[int] | None) -> list[int] | None:
    """The order that undoes an order."""
    return None if order is None else sorted(range(len(order)), key=order.__getitem__)


def _told(file: Path) -> dict[str, Any]:
    if not file.exists():
        return {}
    try:
        told = read_json(file)
        names = [name for key in ("action_names", "state_names") for name in told.get(key) or []]
    except (ValueError, AttributeError, TypeError) as e:
        raise ValueError(f"{file} is not readable ({e}); expected action_names, state_names, fps") from e
    if not all(isinstance(name, str) for name in names):
        raise ValueError(f"{file} holds the names {names}; expected words")
    return told


def _of_dataset(folder: Path) -> dict[str, Any]:
    for file in _infos(folder):
        try:
            info = read_json(file)
            features = info["features"]
            names = {
                name: _flat(features.get(key)) for name, key in (("action_names", ACTION), ("state_names", OBS_STATE))
            }
            return {**names, "fps": info.get("fps")}
        except (CheckpointError, KeyError, TypeError, AttributeError):
            continue  # a file that is not one tells nothing
    return {}


def _infos(folder: Path) -> Iterator[Path]:
    """Where the metadata of the dataset of a checkpoint may lie on this machine."""
    try:
        dataset = read_json(folder / "train_config.json")["dataset"]
        repo_id, root = dataset["repo_id"], dataset.get("root")
    except (CheckpointError, KeyError, TypeError, AttributeError):
        return
    places = [Path(root)] if isinstance(root, str) and not is_downloaded(folder) else []  # else it is another machine's
    if _is_repo_id(repo_id):
        places.append(HF_LEROBOT_HOME / repo_id)
        places += sorted((HF_LEROBOT_HUB_CACHE / f"datasets--{repo_id.replace('/', '--')}").glob("snapshots/*"))
    yield from (file for place in places if (file := place / "meta" / "info.json").is_file())


def _is_repo_id(repo_id: Any) -> bool:
    try:
        validate_repo_id(repo_id)
    except HFValidationError:
        return False
    return isinstance(repo_id, str)


def _flat(feature: dict | None) -> list[str] | None:
    """One name for each number of a feature, if its dataset says so in one of the ways that are in use."""
    names, size = (feature or {}).get("names"), (feature or {}).get("shape", [0])[0]
    if isinstance(names, dict):
        names = list(names.values())
    while isinstance(names, list) and len(names) == 1 and isinstance(names[0], list):
        names = names[0]
    named = isinstance(names, list) and all(isinstance(name, str) for name in names)
    return names if named and len(set(names)) == len(names) == size else None
