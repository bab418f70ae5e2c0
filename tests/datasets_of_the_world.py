"""Small datasets as people have them: pictures in other orders, names of all kinds, and files that are broken."""

import json
from io import BytesIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

AXES, CAMERA = ["x.pos", "y.pos"], "observation.images.front"
HEIGHT, WIDTH = 48, 64  # no smaller ones make a video
NUMBERS = {"dtype": "float32", "shape": (2,), "names": AXES}
DEPTH = {
    "dtype": "image", "shape": (HEIGHT, WIDTH, 1), "names": ["height", "width", "channels"],
    "info": {"is_depth_map": True},
}  # fmt: skip


def features(camera=CAMERA, dtype="image", shape=(HEIGHT, WIDTH, 3), axes=("height", "width", "channels"), **others):
    """Features of a robot of two axes with one camera; others, or None to leave one out."""
    own = {"observation.state": NUMBERS, "action": NUMBERS, "failure": {"dtype": "int64", "shape": (1,), "names": None}}
    own |= {camera: {"dtype": dtype, "shape": shape, "names": list(axes)}} if camera else {}
    return {key: feature for key, feature in {**own, **others}.items() if feature is not None}


def record(root, features, lengths=(6, 5), fps=10, alter=None):
    """Record episodes; frame t of an episode is labelled failing from 3 on.

    Args:
        alter: gets frame, episode and t, and changes the frame.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    videos = any(feature["dtype"] == "video" for feature in features.values())
    dataset = LeRobotDataset.create("me/data", fps=fps, features=dict(features), root=root, use_videos=videos)
    for episode, length in enumerate(lengths):
        for t in range(length):
            frame = {key: _value(key, feature, episode, t) for key, feature in features.items()} | {"task": "go"}
            if alter:
                alter(frame, episode, t)
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    return root


def _value(key, feature, episode, t):
    shape, dtype = tuple(feature["shape"]), feature["dtype"]
    if (feature.get("info") or {}).get("is_depth_map"):
        return np.full(shape, 700 + t, np.uint16)
    if dtype in ("image", "video"):
        picture = np.full((HEIGHT, WIDTH, 3), 20 * t, np.uint8)
        picture[: HEIGHT // 2, : WIDTH // 2] = 255 - 20 * t  # tells height from width, and top from bottom
        return picture.transpose(2, 0, 1) if shape[0] == 3 else picture
    if dtype == "string":
        return "yes"
    if key == "failure":
        return np.array([int(t >= 3)]).astype(dtype)
    return np.resize(np.array([np.sin(t + episode), 0.1 * t]), shape).astype(dtype)


def edit_info(root, change):
    """Let a function change `meta/info.json`."""
    file = root / "meta/info.json"
    info = json.loads(file.read_text())
    change(info)
    file.write_text(json.dumps(info))
    return root


def edit_feature(root, key, **entries):
    """Change entries of a feature in `meta/info.json`."""
    return edit_info(root, lambda info: info["features"][key].update(entries))


def edit_column(root, name, change, folder="data"):
    """Let a function change the values of a column, a list of one value a row."""
    file = next((root / folder).rglob("*.parquet"))
    table = pq.read_table(file)
    place = table.column_names.index(name)
    values = pa.array(change(table[name].to_pylist()), table.schema.field(name).type)
    pq.write_table(table.set_column(place, name, values), file)
    return root


def keep_rows(root, keep, folder="data"):
    """Keep the rows of which a function of their number is true."""
    file = next((root / folder).rglob("*.parquet"))
    table = pq.read_table(file)
    pq.write_table(table.filter(pa.array([keep(i) for i in range(len(table))])), file)
    return root


def cut(root, pattern, share=0.6):
    """Cut off the end of the files of a pattern."""
    for file in root.glob(pattern):
        file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    return root


def delete(root, pattern):
    """Delete the files of a pattern."""
    for file in root.glob(pattern):
        file.unlink()
    return root


def repaint(root, mode, camera=CAMERA):
    """Store the pictures in another of PIL's modes, such as L, which is grey."""

    def painted(stored):
        buffer = BytesIO()
        Image.open(BytesIO(stored["bytes"])).convert(mode).save(buffer, "PNG")
        return {**stored, "bytes": buffer.getvalue()}

    return edit_column(root, camera, lambda pictures: [painted(stored) for stored in pictures])
