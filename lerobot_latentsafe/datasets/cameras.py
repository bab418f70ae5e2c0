"""Which of a dataset's cameras are used, and what shape their pictures have."""

from typing import TYPE_CHECKING

from lerobot_latentsafe.datasets.reading import DatasetContractError

if TYPE_CHECKING:  # the package imports this module, and LeRobot's datasets are heavy
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

DEPTH = "it is a depth map, and the filter reads pictures alone"
CHANNELS = (1, 3)
"""Of a grey and of a coloured picture."""


def settled_cameras(
    meta: "LeRobotDatasetMetadata",
) -> tuple[dict[str, tuple[int, int, int]], dict[str, str]]:
    """Cameras that are used, key -> (C, H, W), and features that are not, key -> why.

    Raises:
        DatasetContractError: a camera whose shape is none of a picture.
    """
    cameras, left_out = {}, {}
    for key in meta.camera_keys:
        if key in meta.depth_keys or is_depth(key, meta.features[key]):
            left_out[key] = DEPTH
        else:
            cameras[key] = channels_first(key, meta.features[key])
    return cameras, left_out


def is_depth(key: str, feature: dict) -> bool:
    """Whether a feature that is not marked as a depth map is one: one channel of 16 bits, or named so."""
    shape, info = tuple(feature["shape"]), feature.get("info") or {}
    grey_format = str(info.get("video.pix_fmt", "")).startswith(("gray1", "grayf"))
    return 1 in (shape[0], shape[-1]) and ("depth" in key.lower() or grey_format)


def channels_first(key: str, feature: dict) -> tuple[int, int, int]:
    """(C, H, W) of a camera, whose info may give (H, W, C) or (C, H, W).

    The number of channels tells which; only where both ends could be channels do the names of the axes.

    Raises:
        DatasetContractError: neither end is 1 or 3 channels.
    """
    shape = tuple(feature["shape"])
    ends = [end for end in (0, 2) if len(shape) == 3 and shape[end] in CHANNELS]
    if not ends:
        raise DatasetContractError(
            f"camera {key} has shape {shape}; expected (height, width, channels) or (channels, height, width) with 1 "
            "or 3 channels. Convert its pictures, or leave it out with lerobot-edit-dataset "
            f"--operation.type=remove_feature --operation.feature_names='[{key}]'"
        )
    names = feature.get("names")
    first = isinstance(names, list | tuple) and len(names) == 3 and str(names[0]).startswith("channel")
    if ends == [0] or (len(ends) == 2 and first):
        return shape
    return shape[2], shape[0], shape[1]
