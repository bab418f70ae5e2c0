"""A dataset shows no file of this machine but its own."""

import datasets_of_the_world as world
import pytest
import tiny

from lerobot_latentsafe.datasets.cameras import stored_picture
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.folder import load_metadata, open_dataset
from lerobot_latentsafe.datasets.paths import inside_dataset, leads_out
from lerobot_latentsafe.datasets.reading import BrokenFileError, DatasetContractError

OUTSIDE = [
    "/etc/hostname", "../../secret.png", "a/../../secret.png", "C:\\secret.png", "\\\\server\\share\\x.png",
    "..\\secret.png",
]  # fmt: skip
OPENERS = {
    "metadata": lambda root: load_metadata("me/data", root),
    "dataset": lambda root: open_dataset("me/data", root),
    "frames": lambda root: DatasetFrames(tiny.metadata(root, "me/data")),
    "picture": lambda root: stored_picture(tiny.metadata(root, "me/data"), world.CAMERA),
}


@pytest.fixture
def root(tmp_path):
    return world.record(tmp_path / "data", world.features())


def named(root, path, embedded=False):
    """The dataset, whose pictures are stored as paths."""
    return world.edit_column(
        root, world.CAMERA, lambda rows: [{"bytes": row["bytes"] if embedded else None, "path": path} for row in rows]
    )


@pytest.mark.parametrize("path", OUTSIDE)
@pytest.mark.parametrize("opener", OPENERS)
@pytest.mark.fault("M38", "a dataset names a picture outside of its folder", "Refused; no other file is read")
def test_a_picture_elsewhere_is_not_read(root, path, opener):
    named(root, path)
    with pytest.raises(DatasetContractError, match="not in that folder"):
        OPENERS[opener](root)


@pytest.mark.parametrize("entry", ["data_path", "video_path", "features"])
def test_templates_and_names_do_not_lead_out(root, entry):
    def change(info):
        if entry == "features":
            info["features"]["../../x"] = {"dtype": "video", "shape": [1, 1, 3], "names": None}
        else:
            info[entry] = "../../{chunk_index}/{file_index}"

    world.edit_info(root, change)
    with pytest.raises(DatasetContractError, match="not in that folder"):
        load_metadata("me/data", root)


def test_a_link_that_leads_out_is_not_followed(root, tmp_path):
    (tmp_path / "secret.png").write_bytes(b"secret")
    (root / "images").mkdir(exist_ok=True)
    (root / "images" / "x.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(DatasetContractError, match="not in that folder"):
        inside_dataset(root, "images/x.png")


def test_pictures_in_the_folder_are_read_and_links_of_the_hubs_cache_are(root, tmp_path):
    frames = DatasetFrames(tiny.metadata(root, "me/data"))
    picture = frames.encoded(world.CAMERA, 0, [0])[0]
    (root / "images").mkdir(exist_ok=True)
    (root / "images" / "x.png").write_bytes(picture)
    named(root, "images/x.png")
    assert DatasetFrames(tiny.metadata(root, "me/data")).encoded(world.CAMERA, 0, [0]) == [picture]
    snapshot = tmp_path / "datasets--me--data" / "snapshots" / "abc"
    (snapshot / "images").mkdir(parents=True)
    (tmp_path / "datasets--me--data" / "blobs").mkdir()
    (tmp_path / "datasets--me--data" / "blobs" / "1").write_bytes(picture)
    (snapshot / "images" / "x.png").symlink_to("../../../blobs/1")
    assert inside_dataset(snapshot, "images/x.png").read_bytes() == picture


def test_the_path_of_an_embedded_picture_means_nothing(root):
    named(root, "/home/somebody/x.png", embedded=True)
    assert len(DatasetFrames(tiny.metadata(root, "me/data")).encoded(world.CAMERA, 0)) == 6


def test_an_entry_without_a_picture_is_named(root):
    named(root, None)
    with pytest.raises(BrokenFileError, match="entry without a picture"):
        stored_picture(tiny.metadata(root, "me/data"), world.CAMERA)


@pytest.mark.parametrize("path", ["x.png", "images/x.png", "images/a..b.png", "./x.png"])
def test_plain_paths_stay(path):
    assert not leads_out(path)
