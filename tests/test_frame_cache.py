import copy
import errno
import json
import os
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tiny
import torch
import torch.nn.functional as F
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.datasets import build_cache, cache_layout, cache_recipes
from lerobot_latentsafe.datasets.build_cache import build_frame_cache
from lerobot_latentsafe.datasets.frame_cache import FrameCache, FrameCacheError, dataset_fingerprint
from lerobot_latentsafe.datasets.labels import FailureLabels
from lerobot_latentsafe.pictures import to_model_images


@pytest.fixture
def torn(cache_root, tmp_path):
    """A copy of the cached dataset to break."""
    return shutil.copytree(cache_root, tmp_path / "torn")


def losses(policy, batch):
    torch.manual_seed(0)
    loss, metrics = policy.forward(batch)
    return {"loss": loss.item(), **metrics}


@pytest.mark.parametrize("mode", ["eval", "train"])
def test_losses_from_the_cache_equal_those_of_decoding(dataset_root, dataset_meta, cache_meta, mode):
    torch.manual_seed(0)
    decoding = tiny.new_policy(dataset_meta)
    torch.manual_seed(0)
    cached = tiny.new_policy(cache_meta)
    assert decoding.reader.cache is None and cached.reader.cache is not None
    getattr(decoding, mode)(), getattr(cached, mode)()

    windows = resolve_delta_timestamps(decoding.config, dataset_meta)
    dataset = LeRobotDataset(tiny.REPO_ID, root=dataset_root, delta_timestamps=windows)
    ends = np.asarray(dataset_meta.episodes["dataset_to_index"])
    starts = [
        0,
        1,
        7,
        int(ends[0]) - 3,
        int(ends[0]) - 1,
        int(ends[0]),
        int(ends[4]) - 6,
        dataset_meta.total_frames - 2,
    ]
    batch = torch.utils.data.default_collate([dataset[i] for i in starts])
    assert batch["observation.state_is_pad"].any()  # windows that run past an episode's end are among them

    decoded, read = losses(decoding, batch), losses(cached, {"index": torch.tensor(starts)})
    assert decoded.keys() == read.keys()
    for name in decoded:
        assert decoded[name] == pytest.approx(read[name], rel=1e-5, abs=1e-5), name


def test_cached_policy_asks_the_dataset_for_no_window(cache_meta):
    policy = tiny.new_policy(cache_meta)
    assert resolve_delta_timestamps(policy.config, cache_meta) is None


def test_copy_has_no_images_but_all_else(dataset_meta, cache_meta):
    assert set(dataset_meta.features) - set(cache_meta.features) == {"observation.image"}
    assert cache_meta.total_frames == dataset_meta.total_frames
    assert dataset_fingerprint(cache_meta) == dataset_fingerprint(dataset_meta)


def test_sidecar_labels_come_along(dataset_root, tmp_path):
    root = shutil.copytree(dataset_root, tmp_path / "car")
    n = tiny.metadata(root).total_frames
    (root / "labels").mkdir()
    pq.write_table(pa.table({"index": range(n), "failure": np.arange(n) % 2}), root / "labels" / "failure.parquet")
    build_frame_cache(LeRobotDataset(tiny.REPO_ID, root=root), tmp_path / "cache", 8)
    labels = FailureLabels.load(tmp_path / "cache").failure
    np.testing.assert_array_equal(labels, FailureLabels.load(root).failure)
    np.testing.assert_array_equal(labels, np.arange(n) % 2)


def test_manifest_says_what_it_was_made_from(cache_root, cache_meta):
    manifest = FrameCache.open(cache_root, cache_meta).manifest
    assert manifest["n_frames"] == cache_meta.total_frames
    assert (manifest["image_size"], manifest["fps"]) == (32, 20)
    assert manifest["cameras"] == {"observation.image": [128, 128, 3]}


def test_frames_are_keyed_by_frame_index(cache_root, dataset_root):
    cache, dataset = FrameCache.open(cache_root), LeRobotDataset(tiny.REPO_ID, root=dataset_root)
    index = np.array([[0, 5], [40, 41]])
    images, state = cache.frames(index)
    assert images["observation.image"].shape == (2, 2, 3, 32, 32) and state.shape == (2, 2, 2)
    for at, i in np.ndenumerate(index):
        item = dataset[int(i)]
        torch.testing.assert_close(images["observation.image"][at], to_model_images(item["observation.image"], 32))
        torch.testing.assert_close(state[at], item["observation.state"])
        np.testing.assert_allclose(cache.action[i], item["action"])


def test_model_images_average_and_round_alike_for_bytes_and_floats():
    images = torch.randint(256, (2, 5, 3, 64, 64), dtype=torch.uint8)
    small = to_model_images(images, 16)
    assert small.shape == (2, 5, 3, 16, 16)
    torch.testing.assert_close(small, to_model_images(images / 255.0, 16), rtol=0, atol=0)
    mean = images[0, 0, 0, :4, :4].float().mean()
    assert abs(small[0, 0, 0, 0, 0] * 255 - mean) <= 0.502
    torch.testing.assert_close(to_model_images(images, 64), images / 255.0)


@pytest.mark.parametrize("shape", [(224, 224, 3), (480, 640, 3), (227, 227, 3), (2, 64, 48, 3), (2, 2, 40, 40, 1)])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_pictures_are_averaged_alike_however_they_lie_in_memory(shape, dtype):
    """Cameras and videos give the colours of a pixel side by side, LeRobot's processors one colour after the other."""
    pixels = torch.randint(256, shape, dtype=torch.uint8)
    images = (pixels if dtype == torch.uint8 else pixels / 255).movedim(-1, -3)
    small = to_model_images(images, 96)
    assert torch.equal(small, to_model_images(images.contiguous(), 96))
    whole = images.float() / (255 if dtype == torch.uint8 else 1)
    by_area = F.interpolate(whole.reshape(-1, *images.shape[-3:]), (96, 96), mode="area").view(
        *images.shape[:-2], 96, 96
    )
    torch.testing.assert_close(small, by_area.expand_as(small), rtol=0, atol=0.51 / 255)


@pytest.mark.parametrize("name", ["observation.image", "state", "action"])
def test_truncated_array_is_torn(torn, name):
    file = torn / "frame_cache" / f"{name}.npy"
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(FrameCacheError, match=r"torn.*latentsafe cache again"):
        FrameCache.open(torn)


@pytest.mark.parametrize("name", ["observation.image", "action"])
def test_missing_array_is_torn(torn, name):
    (torn / "frame_cache" / f"{name}.npy").unlink()
    with pytest.raises(FrameCacheError, match="torn"):
        FrameCache.open(torn)


def test_array_of_another_length_is_refused(torn):
    file = torn / "frame_cache" / "state.npy"
    np.save(file, np.load(file)[:-1])
    with pytest.raises(FrameCacheError, match="holds arrays of"):
        FrameCache.open(torn)


@pytest.mark.parametrize("content", [None, "", '{"version": 1, "n_fr'], ids=["none", "empty", "half"])
def test_build_that_was_cut_off_is_not_taken_for_a_whole_one(torn, content):
    manifest = torn / "frame_cache" / "manifest.json"
    manifest.unlink() if content is None else manifest.write_text(content)
    with pytest.raises(FrameCacheError, match="cut off"):
        tiny.new_policy(tiny.metadata(torn))


def test_manifest_is_written_last(dataset_root, tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("lerobot_latentsafe.datasets.build_cache._finish", interrupted)
    with pytest.raises(KeyboardInterrupt):
        build_frame_cache(LeRobotDataset(tiny.REPO_ID, root=dataset_root), tmp_path / "cache", 8)
    assert not (tmp_path / "cache" / "frame_cache" / "manifest.json").exists()


def test_cache_of_another_dataset_is_refused(cache_root, cache_meta):
    other = copy.copy(cache_meta)
    other.stats = copy.deepcopy(cache_meta.stats)
    other.stats["action"]["mean"] = other.stats["action"]["mean"] + 0.1
    with pytest.raises(FrameCacheError, match="was made from me/car"):
        FrameCache.open(cache_root, other)


def test_cache_of_another_resolution_is_refused(cache_meta):
    with pytest.raises(FrameCacheError, match=r"holds 32-pixel frames.*reads 64.*--image_size=64"):
        tiny.new_policy(cache_meta, world_model=tiny.rssm_config(image_size=64))


def test_manifest_of_another_shape_is_a_clear_error(torn):
    manifest = torn / "frame_cache" / "manifest.json"
    manifest.write_text(json.dumps({"version": 1}))
    with pytest.raises(FrameCacheError):
        tiny.new_policy(tiny.metadata(torn))


@pytest.mark.parametrize(
    "step",
    [
        (cache_layout, "_without_cameras"), (build_cache, "allocate"), (cache_layout, "_write"),
        (build_cache, "_await_layout"), (build_cache, "_array"), (build_cache, "_finish"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("episodes", [None, [1, 3]], ids=["all", "some"])
def test_build_killed_at_any_step_ends_as_one_that_was_not(dataset_root, tmp_path, monkeypatch, step, episodes):
    dataset = LeRobotDataset(tiny.REPO_ID, root=dataset_root)

    def killed(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(*step, killed)
        build_frame_cache(dataset, tmp_path / "cut", 8, episodes=episodes)
    build_frame_cache(dataset, tmp_path / "cut", 8, episodes=episodes)
    build_frame_cache(dataset, tmp_path / "whole", 8, episodes=episodes)
    files = [
        {p.relative_to(root): p.read_bytes() for p in root.rglob("*.npy")} for root in sorted(tmp_path.glob("[cw]*"))
    ]
    assert files[0] == files[1] and FrameCache.open(tmp_path / "cut", tiny.metadata(tmp_path / "cut"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cut", "whole"]


@pytest.mark.fault("D01", "the disk is full when a cache is built", "A message, before any work")
def test_a_full_disk_is_an_error_before_any_frame_is_decoded(dataset_root, tmp_path, monkeypatch):
    """Writing to a page of a memory map that has no room on the disk would kill the process."""

    def full(descriptor, offset, size):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    dataset = LeRobotDataset(tiny.REPO_ID, root=dataset_root)
    with (
        monkeypatch.context() as patch,
        pytest.raises(OSError, match=r"No space left.* are free\. Make room and start"),
    ):
        patch.setattr(os, "posix_fallocate", full, raising=False)
        patch.setattr(cache_recipes.Sight, "pieces", None)
        build_frame_cache(dataset, tmp_path / "cache", 8)
    assert not (tmp_path / "cache").exists()
    build_frame_cache(dataset, tmp_path / "cache", 8)


@pytest.mark.parametrize("size", [0, -1])
def test_pictures_of_no_size_are_refused(dataset_root, tmp_path, size):
    with pytest.raises(ValueError, match=f"--image_size is {size}; expected at least 1"):
        build_frame_cache(LeRobotDataset(tiny.REPO_ID, root=dataset_root), tmp_path / "cache", size)


def test_existing_folder_is_left_alone(dataset_root, tmp_path):
    (tmp_path / "precious").write_text("data")
    with pytest.raises(FileExistsError, match="another --output_dir"):
        build_frame_cache(LeRobotDataset(tiny.REPO_ID, root=dataset_root), tmp_path, 32)
    assert (tmp_path / "precious").read_text() == "data"


def test_dataset_without_a_camera_is_refused(cache_root, tmp_path):
    with pytest.raises(FrameCacheError, match="has no camera"):
        build_frame_cache(LeRobotDataset(tiny.REPO_ID, root=cache_root), tmp_path / "again", 32)
