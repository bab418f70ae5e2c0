"""Policies that see through the frozen encoder."""

import pytest
import tiny
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import OBS_ENV_STATE

from lerobot_latentsafe.datasets.frame_cache import FrameCache
from lerobot_latentsafe.perceive import let_see, with_vectors
from lerobot_latentsafe.shield import BasePolicy


@pytest.fixture(scope="module")
def seeing(token_root, tmp_path_factory):
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
    let_see(folder / "trained", token_root, folder / "seeing")
    return folder / "seeing"


def test_dataset_gains_what_the_cache_holds(token_root, tmp_path):
    copy = with_vectors(token_root, tiny.REPO_ID + "_cache", tmp_path / "seen")
    vector = FrameCache.open(token_root).percepts["vector"]
    assert copy.meta.features[OBS_ENV_STATE]["shape"] == (tiny.COMPONENTS,)
    torch.testing.assert_close(copy[7][OBS_ENV_STATE], torch.tensor(vector[7]))


def test_live_observation_is_seen_as_in_training(seeing, token_root, dataset_root):
    item = LeRobotDataset(tiny.REPO_ID, root=dataset_root)[7]
    base = BasePolicy(seeing, "cpu")
    batch = {key: item[key][None] for key in ("observation.image", "observation.state")}
    seen = base.preprocessor(dict(batch))[OBS_ENV_STATE]
    expected = torch.tensor(FrameCache.open(token_root).percepts["vector"][7])
    torch.testing.assert_close(seen[0], expected, rtol=1e-3, atol=1e-3)
    assert base.propose(batch).shape == (1, 2)


def test_missing_camera_is_named(seeing):
    with pytest.raises(KeyError, match=r"lacks observation\.image"):
        BasePolicy(seeing, "cpu").propose({"observation.state": torch.zeros(1, 2)})


def test_existing_folder_is_left_alone(seeing, token_root):
    with pytest.raises(FileExistsError, match="choose another"):
        let_see(seeing, token_root, seeing)
