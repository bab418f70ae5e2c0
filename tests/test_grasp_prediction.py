"""Policies that see through the frozen encoder."""

import numpy as np
import pytest
import tiny
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import OBS_ENV_STATE
from safetensors.torch import load_file, save_file

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.datasets.build_cache import build_frame_cache
from lerobot_latentsafe.datasets.frame_cache import FrameCache, FrameCacheError
from lerobot_latentsafe.dubins.car import ACTION_NAMES, STATE_NAMES
from lerobot_latentsafe.encoders.perception import EncoderMismatchError
from lerobot_latentsafe.policies import grasp_prediction
from lerobot_latentsafe.policies.grasp_prediction import FewValuedStep, GraspPredictionStep, GraspPredictor
from lerobot_latentsafe.policies.grasp_training import (
    AIM,
    check_seen,
    few_valued,
    foreseen,
    let_see,
    until_switched,
    with_aim,
)

REPO_ID = tiny.REPO_ID + "_cache"
AIMED = {"switch": ACTION_NAMES[0], "moved": STATE_NAMES}
"""The car has no fingers: it aims at where it will next turn right."""


@pytest.fixture(scope="module", autouse=True)
def few_steps():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(grasp_prediction, "STEPS", 20)
        yield


@pytest.fixture(scope="module")
def seen(token_root, few_steps, tmp_path_factory):
    """The dataset with the aim."""
    return with_aim(token_root, REPO_ID, tmp_path_factory.mktemp("aim") / "seen", **AIMED)


@pytest.fixture(scope="module")
def seeing(token_root, seen, tmp_path_factory):
    """Folder of a diffusion policy with random weights that makes its environment state from the camera."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
    from lerobot.policies.factory import make_pre_post_processors

    folder = tmp_path_factory.mktemp("seeing")
    features = {"observation.state": PolicyFeature(FeatureType.STATE, (2,))}
    features[OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, (4,))
    config = tiny.diffusion_config(input_features=features)
    one = torch.ones(2)
    stats = {key: {"min": -one, "max": one} for key in ("observation.state", "action")}
    DiffusionPolicy(config).save_pretrained(folder / "trained")
    for pipeline in make_pre_post_processors(config, dataset_stats=stats):
        pipeline.save_pretrained(folder / "trained")
    let_see(folder / "trained", token_root, seen.root, folder / "seeing")
    return folder / "seeing"


def test_aim_is_at_the_next_fall_of_the_command_in_the_episode():
    state = np.arange(10, dtype=np.float32)[:, None]
    command = np.array([1, 1, 0, 0, 1, 0, 1, 1, 1, 0])
    episode = np.array([0, 0, 0, 0, 0, 0, 1, 1, 1, 1])
    assert until_switched(state, command, episode)[:, 0].tolist() == [2, 1, 0, 2, 1, 0, 3, 2, 1, 0]
    command[9] = 1  # it does not fall any more
    assert until_switched(state, command, episode)[6:, 0].tolist() == [0, 0, 0, 0]


def test_what_is_learnt_of_an_object_in_some_places_holds_in_others():
    """A bright patch is to be reached; the places of the test were never shown."""
    patches, rng = torch.arange(36), np.random.default_rng(0)
    places = torch.cartesian_prod(torch.linspace(-1, 1, 6), torch.linspace(-1, 1, 6))
    shown = torch.from_numpy(rng.permutation(36)[:27])
    tokens = torch.randn(36, 36, 4) * 0.05
    tokens[patches, patches, 1] += 3
    torch.manual_seed(0)
    aim, state = GraspPredictor(1, 36, 4, state_dim=1, n_moves=2), torch.zeros(36, 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(grasp_prediction, "STEPS", 400)
        aim.fit(tokens[shown], state[shown], places[shown])
    unseen = torch.from_numpy(np.setdiff1d(patches, shown))
    error = (aim(tokens[unseen], state[unseen]) - places[unseen]).norm(dim=-1)
    assert error.median() < 0.3  # patches are 0.4 apart, the picture is 2 wide


def test_live_observation_is_seen_as_in_training(seeing, token_root, dataset_root):
    item = LeRobotDataset(tiny.REPO_ID, root=dataset_root)[7]
    base = BasePolicy.load(seeing)
    batch = {key: item[key][None] for key in ("observation.image", "observation.state")}
    view = base.preprocessor(dict(batch))[OBS_ENV_STATE]
    aim = next(step.aim for step in base.preprocessor.steps if isinstance(step, GraspPredictionStep))
    percepts, state = FrameCache.open(token_root).frames(np.array([7]), ["tokens"])
    moves = aim(percepts["tokens"], state)
    torch.testing.assert_close(view, aim.in_detail(moves), rtol=1e-2, atol=1e-2)  # the cache holds 16 bits
    assert base.propose(batch).shape == (1, 2)


def test_a_policy_learns_from_aims_of_a_network_that_did_not_learn_from_them(seen, token_root):
    dataset, cache = LeRobotDataset(f"{REPO_ID}_seen", root=seen.root), FrameCache.open(token_root)
    percepts, state = cache.frames(np.arange(len(dataset)), ["tokens"])
    aim = GraspPredictor(1, *percepts["tokens"].shape[1:], state.shape[1], n_moves=2)
    aim.load_state_dict(load_file(seen.root / AIM))
    column = torch.from_numpy(np.stack(dataset.hf_dataset.with_format("numpy")[OBS_ENV_STATE]))
    by_one_that_did = aim.in_detail(foreseen(aim.eval(), percepts["tokens"], state))
    assert column.shape == by_one_that_did.shape
    assert not torch.isclose(column, by_one_that_did, rtol=1e-2).all(1).any()


def test_small_motions_are_told_apart_where_large_ones_saturate():
    aim = GraspPredictor(1, 36, 4, state_dim=1, n_moves=1)  # its motions have a deviation of 1
    shown = aim.in_detail(torch.tensor([[0.0], [0.1], [2.0], [3.0], [-3.0]]))
    torch.testing.assert_close(shown[:, 0], torch.tensor([0.0, 0.1, 2.0, 3.0, -3.0]))
    torch.testing.assert_close(shown[:, 1], torch.tensor([0.0, 0.4621, 1.0, 1.0, -1.0]), atol=1e-3, rtol=0)


def test_commands_that_cannot_be_aimed_at_are_named(token_root, tmp_path):
    with pytest.raises(ValueError, match=r"lacks gripper\.pos"):
        with_aim(token_root, REPO_ID, tmp_path / "seen")
    with pytest.raises(ValueError, match=f"{ACTION_NAMES[1]} hardly ever falls"):
        with_aim(token_root, REPO_ID, tmp_path / "seen", switch=ACTION_NAMES[1], moved=STATE_NAMES)


def test_commands_of_few_values_are_given_as_the_nearest():
    shown = np.array([[0.1, 1, 5, 0], [0.2, 0, 5, 0.5], [0.3, 1, 5, 1], [0.4, 1, 5, 1]], np.float32)
    levels = few_valued(shown)
    assert levels == {"1": (0.0, 1.0), "3": (0.0, 0.5, 1.0)}
    given = torch.tensor([[0.15, 0.94, 4.0, 0.7], [0.25, 0.07, 4.0, 0.8]])
    expected = torch.tensor([[0.15, 1.0, 4.0, 0.5], [0.25, 0.0, 4.0, 1.0]])
    torch.testing.assert_close(FewValuedStep(levels).action(given), expected)


def test_missing_camera_is_named(seeing):
    with pytest.raises(KeyError, match=r"lacks observation\.image"):
        BasePolicy.load(seeing).propose({"observation.state": torch.zeros(1, 2)})


def test_existing_folder_is_left_alone(seeing, seen, token_root):
    with pytest.raises(FileExistsError, match="choose another"):
        let_see(seeing, token_root, seen.root, seeing)


def test_aims_of_another_dataset_are_refused(seen, token_root, tmp_path):
    check_seen(seen.root, token_root)
    save_file({"x": torch.zeros(1)}, tmp_path / AIM, metadata={"fingerprint": "another"})
    with pytest.raises(FrameCacheError, match=r"another.*learn anew"):
        let_see(tmp_path, token_root, tmp_path, tmp_path / "seeing")


def test_pictures_are_no_views(cache_root, tmp_path):
    with pytest.raises(EncoderMismatchError, match="holds pictures"):
        with_aim(cache_root, REPO_ID, tmp_path / "seen", **AIMED)


def test_components_of_tokens_are_refused(dataset_root, tmp_path):
    recipe = tiny.tokens(config=tiny.perception_config(token_components=3))
    build_frame_cache(LeRobotDataset(tiny.REPO_ID, root=dataset_root), tmp_path / "few", tiny.TOKEN_SIZE, recipe)
    with pytest.raises(EncoderMismatchError, match=r"token_components 3, .*--token_components"):
        with_aim(tmp_path / "few", f"{tiny.REPO_ID}_cache", tmp_path / "seen", switch="turn_rate", moved=["cos"])
