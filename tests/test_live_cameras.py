"""The looks of a dataset's cameras: from its pictures or from its cache, of some whole episodes."""

import numpy as np
import pytest
import tiny

from lerobot_latentsafe.datasets.adoption import adopt_dataset
from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.frame_cache import FrameCache
from lerobot_latentsafe.datasets.live_cameras import looks_of, sampled_episodes
from lerobot_latentsafe.units import TrainedOn

CAMERA = "observation.image"


def looked(root, cache=None):
    meta = tiny.metadata(root)
    contract = Contract.read(meta)
    trained_on = adopt_dataset(TrainedOn(), contract)
    trained_on.cameras = [CAMERA]
    return looks_of(meta, contract, trained_on, cache)


def test_looks_are_of_the_pictures(dataset_root):
    look = looked(dataset_root)[CAMERA]
    assert look.frames == tiny.metadata(dataset_root).total_frames
    assert "with red and blue exchanged" in look.told  # the disc is red
    assert "upside down" not in look.told  # the car drives everywhere, and the disc is in the middle
    assert len(look.mean) == 3 * 8 * 8 and len(look.unseen) == 2 and len(look.detail) == 2


def test_a_cache_of_pictures_looks_the_same(dataset_root, cache_root):
    cache = FrameCache.open(cache_root)
    original, cached = looked(dataset_root)[CAMERA], looked(cache_root, cache)[CAMERA]
    np.testing.assert_allclose(cached.mean, original.mean, atol=0.005)
    np.testing.assert_allclose(cached.contrast, original.contrast, rtol=0.1)
    np.testing.assert_allclose(cached.detail, original.detail, rtol=0.2)
    assert cached.told == original.told


def test_a_cache_of_tokens_has_no_looks(dataset_root, cache_root):
    assert looked(cache_root) is None


@pytest.mark.parametrize(("most", "n"), [(10_000, 5), (250, 2), (1, 1)])
def test_whole_episodes_are_sampled(most, n):
    assert len(sampled_episodes(np.full(5, 100), most)) == n


def test_lerobot_train_adopts_looks_once(cache_root, monkeypatch):
    policy = tiny.new_policy(tiny.metadata(cache_root))
    assert list(policy.config.trained_on.looks) == [CAMERA]
    monkeypatch.setattr("lerobot_latentsafe.modeling_latentsafe.looks_of", None)
    again = tiny.new_policy(tiny.metadata(cache_root), **{"trained_on_looks": policy.config.trained_on.looks})
    assert again.config.trained_on.looks == policy.config.trained_on.looks


def test_looks_survive_saving(tmp_path, cache_root):
    from lerobot_latentsafe.runtime.checkpoint import read_config

    policy = tiny.new_policy(tiny.metadata(cache_root))
    policy.save_pretrained(tmp_path)
    assert read_config(tmp_path).trained_on.looks == policy.config.trained_on.looks
