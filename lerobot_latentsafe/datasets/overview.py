"""What `latentsafe check-dataset` says of a dataset: a table of its contract, and what to do."""

from collections.abc import Iterator

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.video_utils import decode_video_frames

from lerobot_latentsafe.datasets.adoption import displacements, told_by
from lerobot_latentsafe.datasets.cameras import stored_picture
from lerobot_latentsafe.datasets.contract import ACTION, STATE, Contract
from lerobot_latentsafe.datasets.frame_cache import FOLDER, FrameCache
from lerobot_latentsafe.datasets.labels import FAILING, SAFE, UNLABELLED, all_labels
from lerobot_latentsafe.datasets.layout import INFO, NO_STATISTICS, STATISTICS, lacks_statistics
from lerobot_latentsafe.datasets.names import usable_names
from lerobot_latentsafe.datasets.reading import reading

ON_TIME = 1e-4
"""Seconds by which LeRobot lets a picture's time differ from a frame's, if it is not told otherwise."""

Row = tuple[str, str]
"""What, and how it is."""


def rows(contract: Contract) -> list[Row]:
    """The table of what a dataset says of its robot."""
    lengths, apart = contract.lengths, contract.seconds_apart * float(contract.fps)
    spread = f"{lengths.min()} to {lengths.max()} frames, {np.median(lengths):g} in the middle"
    table = [
        ("dataset", f"{contract.repo_id} in {contract.root}"),
        ("robot", contract.robot_type or "unknown"),
        ("rate", f"{contract.fps:g} Hz"),
        ("episodes", f"{len(lengths)}, of {spread}; {len(contract.episode)} frames in all"),
        ("timestamps", f"at most {apart:.2g} frames from their places"),
    ]
    table += [("camera", f"{key}: {c} channels, {h} x {w} pixels") for key, (c, h, w) in contract.cameras.items()]
    table += [("left out", f"{key}: {why}") for key, why in contract.left_out.items()]
    spans = zip(contract.state_names, contract.state.min(0), contract.state.max(0))
    table += [("state", f"{name}: {low:g} to {high:g}") for name, low, high in spans]
    return table + command_rows(contract)


def command_rows(contract: Contract) -> list[Row]:
    """What each command means, as far as names and data tell, and how far it goes."""
    commands = told_by(contract)
    sent, moves, table = contract.action, displacements(contract, commands), []
    for command, low, high, least, largest in zip(commands, sent.min(0), sent.max(0), moves.min(0), moves.max(0)):
        meaning = command.described if command.meaning else "of unknown meaning"
        meaning += f", at {least:+.3g} to {largest:+.3g} from the state" if command.of_state else ""
        table.append(("command", f"{command.name}: {low:g} to {high:g}, {meaning}"))
    return table


def feature_rows(meta: LeRobotDatasetMetadata) -> list[Row]:
    """The table of a dataset that has no contract: its features as its info gives them."""
    return [
        ("feature", f"{key}: {feature['dtype']} {tuple(feature['shape'])}") for key, feature in meta.features.items()
    ]


def cached_cameras(meta: LeRobotDatasetMetadata) -> list[Row]:
    """The cameras whose frames are cached in the dataset's folder.

    Raises:
        FrameCacheError: a torn cache, one of another dataset, or a shard that is not what was written.
    """
    if not (meta.root / FOLDER).exists():
        return []
    manifest = FrameCache.open(meta.root, meta).manifest
    FrameCache.check_content(meta.root)
    size = manifest["image_size"]
    return [("camera", f"{key}: cached at {size} x {size} pixels") for key in manifest["cameras"]]


def label_rows(meta: LeRobotDatasetMetadata) -> list[Row]:
    """How many frames each specification labels failing, safe and not at all.

    Raises:
        LabelFileError: labels of another dataset, or values that are none.
    """
    kinds = (("failing", FAILING), ("safe", SAFE), ("not labelled", UNLABELLED))
    return [
        ("labels", f"{name}: {', '.join(f'{(labels == value).sum()} {kind}' for kind, value in kinds)}")
        for name, labels in all_labels(meta.root, meta.features, meta.repo_id).items()
    ]


def check_first_pictures(meta: LeRobotDatasetMetadata, contract: Contract) -> None:
    """Decode the first picture of each camera.

    Raises:
        BrokenFileError: naming the file.
    """
    for key in contract.cameras:
        if key not in meta.video_keys:
            with reading(meta.root / meta.get_data_file_path(0)):
                stored_picture(meta, key).load()
            continue
        path = meta.root / meta.get_video_file_path(0, key)
        with reading(path):
            begin = float(meta.episodes[0][f"videos/{key}/from_timestamp"])
            decode_video_frames(path, [begin], 0.5 / meta.fps, backend="pyav")


def advice(meta: LeRobotDatasetMetadata, contract: Contract) -> Iterator[str]:
    """What a user should know or do, though the dataset can be used."""
    for key, names in ((STATE, contract.state_names), (ACTION, contract.action_names)):
        given = meta.features.get(key, {}).get("names")
        if names and usable_names(given, len(names)) is None:
            yield (
                f"{key} has {len(names)} numbers and the names {given}; they are called {', '.join(names)} here. Write "
                f"one name a number into {INFO} if a robot has others"
            )
    if not contract.state_names:
        yield f"there is no {STATE}: a filter sees pictures alone, without proprioception"
    if lacks_statistics(meta.root, meta.camera_keys):
        yield f"{STATISTICS} is missing or lacks a camera: {NO_STATISTICS}"
    if any(key in meta.video_keys for key in contract.cameras) and contract.seconds_apart > ON_TIME:
        yield f"timestamps are off: give lerobot-train --tolerance_s={2 * contract.seconds_apart:.2g}"
    for key in contract.cameras:
        if len(meta.features[key].get("names") or []) != 3:
            yield (
                f"{key} does not name its axes, which lerobot-train wants: run latentsafe cache and train on that, or "
                f'write "names": ["height", "width", "channels"] into {INFO}'
            )
