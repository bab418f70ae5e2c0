"""Policies that see through the frozen encoder."""

import numpy as np
import pytest
import tiny
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import OBS_ENV_STATE

from lerobot_latentsafe.datasets.frame_cache import FrameCache, FrameCacheError
from lerobot_latentsafe.perceive import let_see, with_views
from lerobot_latentsafe.shield import BasePolicy


@pytest.fixture(scope="module")
def seen(token_root, tmp_path_factory):
    """The dataset with the camera's views."""
    root = tmp_path_factory.mktemp("views") / "seen"
    return with_views(token_root, tiny.REPO_ID + "_cache", root, components=tiny.COMPONENTS)


@pytest.fixture(scope="module")
def seeing(token_root, seen, tmp_path_factory):
    """Folder of a diffusion policy with random weights that makes its environment state from the camera."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
    from lerobot.policies.factory import make_pre_post_processors

    folder = tmp_path_factory.mktemp("seeing")
    features = {"observation.state": PolicyFeature(FeatureType.STATE, (2,))}
    features[OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, (tiny.COMPONENTS,))
    config = tiny.diffusion_config(input_features=features)
    one = torch.ones(2)
    stats = {key: {"min": -one, "max": one} for key in ("observation.state", "action")}
    DiffusionPolicy(config).save_pretrained(folder / "trained")
    for pipeline in make_pre_post_processors(config, dataset_stats=stats):
        pipeline.save_pretrained(folder / "trained")
    let_see(folder / "trained", token_root, seen.root, folder / "seeing")
    return folder / "seeing"


def test_views_keep_what_varies_among_frames(seen, token_root):
    assert seen.meta.features[OBS_ENV_STATE]["shape"] == (tiny.COMPONENTS,)
    cache = FrameCache.open(token_root)
    rows = np.arange(0, cache.manifest["n_frames"], 3)
    tokens = cache.frames(rows, ["tokens"])[0]["tokens"].float().flatten(1)
    views = torch.stack([seen[int(i)][OBS_ENV_STATE] for i in rows])
    apart, seen_apart = torch.pdist(tokens), torch.pdist(views)
    assert torch.corrcoef(torch.stack([apart, seen_apart]))[0, 1] > 0.9


def test_live_observation_is_seen_as_in_training(seeing, seen, dataset_root):
    item = LeRobotDataset(tiny.REPO_ID, root=dataset_root)[7]
    base = BasePolicy(seeing, "cpu")
    batch = {key: item[key][None] for key in ("observation.image", "observation.state")}
    view = base.preprocessor(dict(batch))[OBS_ENV_STATE]
    torch.testing.assert_close(view[0], seen[7][OBS_ENV_STATE], rtol=1e-2, atol=1e-2)  # the cache holds 16 bits
    assert base.propose(batch).shape == (1, 2)


def test_missing_camera_is_named(seeing):
    with pytest.raises(KeyError, match=r"lacks observation\.image"):
        BasePolicy(seeing, "cpu").propose({"observation.state": torch.zeros(1, 2)})


def test_existing_folder_is_left_alone(seeing, seen, token_root):
    with pytest.raises(FileExistsError, match="choose another"):
        let_see(seeing, token_root, seen.root, seeing)


def test_pictures_are_no_views(cache_root, tmp_path):
    with pytest.raises(FrameCacheError, match="holds pictures"):
        with_views(cache_root, tiny.REPO_ID + "_cache", tmp_path / "seen")
