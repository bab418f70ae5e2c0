"""Which of a dataset's cameras are used, and what shape their pictures have."""

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow.parquet as pq
from PIL import Image

from lerobot_latentsafe.datasets.paths import stored_picture_bytes
from lerobot_latentsafe.datasets.reading import DatasetContractError, reading

if TYPE_CHECKING:  # the package imports this module, and LeRobot's datasets are heavy
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

DEPTH = "it is a depth map, and the filter reads pictures alone"
CHANNELS = (1, 3)
"""Of a grey and of a coloured picture."""
WIDE_MODES = ("I", "F", "I;16", "I;16B", "I;16L", "I;16N")
"""PIL's names of pictures of more than 8 bits."""


def settled_cameras(
    meta: "LeRobotDatasetMetadata",
) -> tuple[dict[str, tuple[int, int, int]], dict[str, str]]:
    """Cameras that are used, key -> (C, H, W), and features that are not, key -> why.

    Raises:
        DatasetContractError: a camera whose shape is none of a picture.
    """
    cameras, left_out = {}, {}
    for key in meta.camera_keys:
        if key in meta.depth_keys or is_depth(key, meta):
            left_out[key] = DEPTH
        else:
            cameras[key] = channels_first(key, meta.features[key])
    return cameras, left_out


def is_depth(key: str, meta: "LeRobotDatasetMetadata") -> bool:
    """Whether a camera that is not marked as a depth map is one: named so, or of one channel of more than 8 bits."""
    feature = meta.features[key]
    shape, info = tuple(feature["shape"]), feature.get("info") or {}
    if not shape or 1 not in (shape[0], shape[-1]):
        return False
    if feature["dtype"] == "image" and stored_picture(meta, key).mode in WIDE_MODES:
        return True
    return "depth" in key.lower() or str(info.get("video.pix_fmt", "")).startswith(("gray1", "grayf"))


def stored_picture(meta: "LeRobotDatasetMetadata", key: str) -> Image.Image:
    """The first picture of a camera whose pictures lie in the dataset's table; not decoded before it is looked at.

    Raises:
        DatasetContractError: it lies outside of the dataset's folder.
        BrokenFileError: there is none, or it is none.
    """
    file = Path(meta.root) / meta.get_data_file_path(0)
    with reading(file):
        batch = next(pq.ParquetFile(file).iter_batches(batch_size=1, columns=[key]))
        stored = batch[key][0].as_py()
        return Image.open(BytesIO(stored_picture_bytes(Path(meta.root), stored)))


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
            f"camera {key} has shape {shape}; expected (height, width, channels) or (channels, height, width) with "
            "1 or 3 channels. Convert its pictures, or leave it out with lerobot-edit-dataset "
            f"--operation.type=remove_feature --operation.feature_names='[{key}]'"
        )
    names = feature.get("names")
    first = isinstance(names, list | tuple) and len(names) == 3 and str(names[0]).startswith("channel")
    if ends == [0] or (len(ends) == 2 and first):
        return shape
    return shape[2], shape[0], shape[1]
