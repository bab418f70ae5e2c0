"""Each kind of dataset that people have either has a contract or is refused with what is wrong and what to do."""

import logging

import datasets_of_the_world as world
import numpy as np
import pytest
import torch

from lerobot_latentsafe.datasets.contract import Contract, _say_once
from lerobot_latentsafe.datasets.folder import load_metadata, open_dataset
from lerobot_latentsafe.datasets.labels import LabelFileError, all_labels
from lerobot_latentsafe.datasets.names import settled_names
from lerobot_latentsafe.datasets.reading import DatasetContractError

CHW = ("channels", "height", "width")
TWO_BY_ONE = {"dtype": "float32", "shape": (2, 1), "names": world.AXES}


def plain(root, **changes):
    return world.record(root, world.features(**changes))


def contract(root):
    return Contract.read(load_metadata("me/data", root))


@pytest.fixture(autouse=True)
def said_anew():
    """What is said once a process is said once a test."""
    _say_once.cache_clear()


@pytest.mark.parametrize(
    ("given", "settled"),
    [
        ((["a", "b"], ["c", "d"], 2, 2), (["a", "b"], ["c", "d"])),
        (({"motors": ["a", "b"]}, [["a", "b"]], 2, 2), (["a", "b"], ["a", "b"])),
        (({"a": 0, "b": 1}, [["a"], ["b"]], 2, 2), (["a", "b"], ["a", "b"])),
        (({"left": ["a"], "right": ["a"]}, None, 2, 2), (["left.a", "right.a"],) * 2),
        ((["state"], ["action"], 3, 3), (["motor_0", "motor_1", "motor_2"],) * 2),
        ((None, None, 2, 2), (["motor_0", "motor_1"],) * 2),
        ((None, ["a", "b"], 2, 2), (["a", "b"],) * 2),
        ((["a", "a"], ["a", "b"], 2, 2), (["a", "b"],) * 2),
        ((["a", ""], ["b", "b"], 2, 2), (["motor_0", "motor_1"],) * 2),
        ((None, None, 1, 2), (["state_0"], ["action_0", "action_1"])),
        ((None, ["a"], 0, 1), ([], ["a"])),
        (("x.pos", "x.vel", 1, 1), (["x.pos"], ["x.vel"])),
    ],
)
def test_every_number_has_one_distinct_name(given, settled):
    assert settled_names(*given) == settled


USABLE = {
    "as LeRobot records": lambda root: plain(root),
    "videos": lambda root: plain(root, dtype="video"),
    "channels first": lambda root: plain(root, shape=(3, world.HEIGHT, world.WIDTH), axes=CHW),
    "channels last, named otherwise": lambda root: plain(root, axes=("rows", "columns", "rgb")),
    "axes without names": lambda root: world.edit_feature(plain(root), world.CAMERA, names=None),
    "actions of two axes": lambda root: plain(root, action=TWO_BY_ONE),
    "double precision": lambda root: plain(root, action={**world.NUMBERS, "dtype": "float64"}),
    "no statistics": lambda root: world.delete(plain(root), "meta/stats.json"),
    "times off, pictures beside the numbers": lambda root: world.edit_column(
        plain(root), "timestamp", lambda times: [t + 0.07 for t in times]
    ),
}


@pytest.mark.parametrize("kind", USABLE)
def test_kinds_that_can_be_used(tmp_path, kind):
    found = contract(USABLE[kind](tmp_path / "data"))
    assert found.cameras == {world.CAMERA: (3, world.HEIGHT, world.WIDTH)} and found.left_out == {}
    assert found.action_names == found.state_names == world.AXES
    assert found.state.shape == found.action.shape == (11, 2) and found.action.dtype == np.float32
    np.testing.assert_allclose(found.action[:, 1], [0.1 * t for t in (*range(6), *range(5))], atol=1e-6)
    assert found.lengths.tolist() == [6, 5]
    np.testing.assert_allclose(found.statistics["action"]["max"], found.action.max(0))


def test_a_rate_keeps_its_fraction(tmp_path):
    assert contract(world.edit_info(plain(tmp_path / "data"), lambda info: info.update(fps=9.97))).fps == 9.97
    assert contract(plain(tmp_path / "whole")).fps == 10


def test_no_proprioception_is_an_empty_state(tmp_path):
    found = contract(plain(tmp_path / "data", **{"observation.state": None}))
    assert found.state.shape == (11, 0) and found.state_names == [] and list(found.statistics) == ["action"]


def test_grey_pictures_have_one_channel(tmp_path):
    root = world.repaint(plain(tmp_path / "data"), "L")
    found = contract(world.edit_feature(root, world.CAMERA, shape=[world.HEIGHT, world.WIDTH, 1]))
    assert found.cameras == {world.CAMERA: (1, world.HEIGHT, world.WIDTH)}


@pytest.mark.parametrize("marked", [True, False])
def test_depth_maps_are_left_out_and_said_once(tmp_path, caplog, marked):
    root = plain(tmp_path / "data", **{"observation.images.far": world.DEPTH})
    if not marked:  # then 16 bits tell
        world.edit_feature(root, "observation.images.far", info=None)
    with caplog.at_level(logging.WARNING):
        found = contract(root)
        assert contract(root).left_out == found.left_out
    assert list(found.cameras) == [world.CAMERA] and "depth map" in found.left_out["observation.images.far"]
    assert len([r for r in caplog.records if "far is left out" in r.getMessage()]) == 1


def with_value(key, value):
    def alter(frame, episode, t):
        if (episode, t) == (1, 2):
            frame[key] = np.array([0.0, value], np.float32)

    return lambda root: world.record(root, world.features(), alter=alter)


def shifted(times):
    return [t + 0.07 for t in times]


REFUSED = {
    "no folder": (lambda root: root, ["no folder", "--dataset.root"]),
    "no dataset": (lambda root: root.mkdir(), ["meta/info.json"]),
    "version 2.1": (
        lambda root: world.edit_info(plain(root), lambda info: info.update(codebase_version="v2.1")),
        ["v2.1", "convert_dataset_v21_to_v30"],
    ),
    "empty": (
        lambda root: world.edit_info(plain(root), lambda info: info.update(total_episodes=0, total_frames=0)),
        ["is empty"],
    ),
    "a rate that is none": (
        lambda root: world.edit_info(plain(root), lambda info: info.update(fps="10")),
        ["fps is '10'", "info.json"],
    ),
    "info cut": (lambda root: world.cut(plain(root), "meta/info.json"), ["info.json", "cut or damaged"]),
    "statistics cut": (lambda root: world.cut(plain(root), "meta/stats.json"), ["stats.json", "delete it"]),
    "tasks missing": (lambda root: world.delete(plain(root), "meta/tasks.parquet"), ["tasks.parquet is missing"]),
    "tasks cut": (lambda root: world.cut(plain(root), "meta/tasks.parquet"), ["tasks.parquet", "cut or damaged"]),
    "numbers cut": (lambda root: world.cut(plain(root), "data/*/*.parquet"), ["file-000.parquet", "cut or damaged"]),
    "numbers missing": (lambda root: world.delete(plain(root), "data/*/*.parquet"), ["0 frames of episode 0"]),
    "episodes cut": (lambda root: world.cut(plain(root), "meta/episodes/*/*.parquet"), ["meta/episodes", "damaged"]),
    "episode without frames": (
        lambda root: world.keep_rows(plain(root), lambda i: i < 6),
        ["0 frames of episode 1", "5 by meta/episodes"],
    ),
    "episode that is not listed": (
        lambda root: world.keep_rows(plain(root), lambda i: i < 1, "meta/episodes"),
        ["lists 1 episodes", "2 by total_episodes", "1 missing"],
    ),
    "index that does not count": (
        lambda root: world.edit_column(plain(root), "index", lambda index: [i + 1 for i in index]),
        ["index", "count up from 0"],
    ),
    "video missing": (lambda root: world.delete(plain(root, dtype="video"), "videos/**/*.mp4"), ["mp4 is missing"]),
    "video cut": (lambda root: world.cut(plain(root, dtype="video"), "videos/**/*.mp4"), ["mp4 is cut off"]),
    "video empty": (lambda root: world.cut(plain(root, dtype="video"), "videos/**/*.mp4", 0.0), ["mp4 cannot be read"]),
    "times off, pictures in a video": (
        lambda root: world.edit_column(plain(root, dtype="video"), "timestamp", shifted),
        ["0.70 frames", "frame_index / fps"],
    ),
    "video that begins between frames": (
        lambda root: world.edit_column(
            plain(root, dtype="video"), f"videos/{world.CAMERA}/from_timestamp", shifted, "meta/episodes"
        ),
        ["0.30 frames", "from_timestamp"],
    ),
    "NaN": (
        with_value("observation.state", np.nan),
        ["y.pos is nan", "frame 2 of episode 1", "delete_episodes", "[1]"],
    ),
    "infinity": (with_value("action", np.inf), ["action", "y.pos is inf", "frame 2 of episode 1", "delete_episodes"]),
    "other names": (
        lambda root: plain(
            root,
            camera="image",
            state=world.NUMBERS,
            actions=world.NUMBERS,
            action=None,
            **{"observation.state": None},
        ),
        ["actions for action", "state for observation.state", "image for observation.images.image", "rename-features"],
    ),
    "no action": (lambda root: plain(root, action=None), ["no feature 'action'", "failure", "rename-features"]),
    "four channels": (
        lambda root: world.edit_feature(plain(root), world.CAMERA, shape=[world.HEIGHT, world.WIDTH, 4]),
        ["shape (48, 64, 4)", "remove_feature"],
    ),
    "height for width": (
        lambda root: world.edit_feature(plain(root), world.CAMERA, shape=[world.WIDTH, world.HEIGHT, 3]),
        ["48 x 64 pixels", "64 x 48", "correct the shape"],
    ),
    "more numbers than there are": (
        lambda root: world.edit_feature(plain(root), "action", shape=[3]),
        ["2 numbers a frame", "3 by its meta/info.json"],
    ),
    "feature without a shape": (
        lambda root: world.edit_info(plain(root), lambda info: info["features"]["action"].pop("shape")),
        ["does not say the shape of action"],
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_kinds_that_are_refused_say_what_and_what_to_do(tmp_path, kind):
    make, words = REFUSED[kind]
    root = tmp_path / "data"
    make(root)
    existed = root.exists()
    with pytest.raises(DatasetContractError) as refused:
        contract(root)
    assert [word for word in words if word not in str(refused.value)] == [], refused.value
    assert len(str(refused.value).split()) > 6 and root.exists() == existed


@pytest.mark.parametrize("kind", ["no folder", "version 2.1", "numbers cut", "episode without frames"])
def test_opening_does_not_look_at_the_hub(tmp_path, kind):
    make, words = REFUSED[kind]
    make(tmp_path / "data")
    with pytest.raises(DatasetContractError, match=words[0]):
        open_dataset("me/data", tmp_path / "data")


@pytest.mark.parametrize(("dtype", "fits"), [("bool", True), ("float32", True), ("uint8", True), ("string", False)])
def test_labels_may_be_of_any_type_of_number(tmp_path, dtype, fits):
    root = plain(tmp_path / "data", failure={"dtype": dtype, "shape": (1,), "names": None})
    features = load_metadata("me/data", root).features
    if fits:
        assert all_labels(root, features)["failure"].tolist() == [int(t >= 3) for t in (*range(6), *range(5))]
    else:
        with pytest.raises(LabelFileError, match="holds yes; expected 1, 0 or -1"):
            all_labels(root, features)


@pytest.mark.parametrize("label", [np.nan, np.inf, 2.0])
def test_labels_that_are_none_are_refused(tmp_path, label):
    def alter(frame, episode, t):
        frame["failure"] = np.array([label if t == 1 else 0.0], np.float32)

    kind = {"dtype": "float32", "shape": (1,), "names": None}
    root = world.record(tmp_path / "data", world.features(failure=kind), alter=alter)
    with pytest.raises(LabelFileError, match="expected 1, 0 or -1"):
        all_labels(root, load_metadata("me/data", root).features)


def test_a_grey_picture_is_seen_in_three_channels():
    from lerobot_latentsafe.pictures import to_model_images

    grey = torch.randint(256, (2, 1, 8, 8), dtype=torch.uint8)
    assert torch.equal(to_model_images(grey, 4), to_model_images(grey.repeat(1, 3, 1, 1), 4))
