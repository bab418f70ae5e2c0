"""What a notebook uses, on a tiny filter of the car."""

import subprocess
import sys

import numpy as np
import pytest
import tiny
import torch
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.policies.factory import make_pre_post_processors

import lerobot_latentsafe
from lerobot_latentsafe import (
    LatentSafeDubinsEnv,
    LawOptions,
    decide,
    evaluate_filter,
    load_filter,
    shield_policy,
    train_filter,
    values_along,
)


def test_everything_that_is_exported_is_there():
    for name in lerobot_latentsafe.__all__:
        assert getattr(lerobot_latentsafe, name) is not None
    with pytest.raises(AttributeError, match=r"no attribute 'load_filtre'; it has .*load_filter"):
        lerobot_latentsafe.load_filtre  # noqa: B018


def test_importing_the_package_loads_no_model_and_no_simulator():
    code = (
        "import sys, lerobot_latentsafe; print(*{'mujoco', 'lerobot_latentsafe.api', 'matplotlib'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, "")


def test_law_of_a_loaded_filter_is_changed_by_options_and_nothing_else(tiny_filter):
    plain, changed = load_filter(tiny_filter), load_filter(tiny_filter, law=LawOptions(epsilon=0.3, mode="monitor"))
    assert (changed.config.law.epsilon, changed.config.law.mode) == (0.3, "monitor")
    assert changed.config.law.lookahead == plain.config.law.lookahead
    with pytest.raises(ValueError, match=r"law\.mode is 'watch'; expected one of filter, monitor"):
        load_filter(tiny_filter, law=LawOptions(mode="watch"))


def test_a_policy_object_is_shielded_as_its_folder_is(tiny_filter, tiny_diffusion):
    loaded = DiffusionPolicy.from_pretrained(tiny_diffusion)
    pipelines = make_pre_post_processors(loaded.config, pretrained_path=str(tiny_diffusion))
    by_path = shield_policy(tiny_diffusion, tiny_filter, law=LawOptions(epsilon=-2.0))
    by_object = shield_policy(
        loaded, load_filter(tiny_filter), preprocessor=pipelines[0], postprocessor=pipelines[1],
        law=LawOptions(epsilon=-2.0),
    )  # fmt: skip
    drives = []
    for shielded in (by_path, by_object):
        torch.manual_seed(0)
        drives.append(tiny.executed(tiny.drive(shielded)))
    torch.testing.assert_close(*drives)


def test_a_policy_object_without_processors_says_what_to_give(tiny_filter):
    with pytest.raises(ValueError, match=r"loaded from no checkpoint.*preprocessor="):
        shield_policy(DiffusionPolicy(tiny.diffusion_config()), tiny_filter)


def test_one_decision_on_what_a_robot_sees(policy):
    seen = tiny.observation([[-0.9, 0.1, 0.0]])
    picture = (seen["observation.image"][0].permute(1, 2, 0) * 255).byte().numpy()
    one = {"observation.image": picture, "observation.state": seen["observation.state"][0].numpy()}
    decision = decide(policy, one, [0.3, 1.0])
    assert decision.proposed.shape == (1, 2) and np.isfinite(decision.value.item())
    policy.reset()
    picture = torch.from_numpy(picture).permute(2, 0, 1)[None] / 255
    batch = policy.shield({**seen, "observation.image": picture}, torch.tensor([[0.3, 1.0]]))
    torch.testing.assert_close(decision.value, batch.value)


def test_values_along_an_episode_are_those_of_its_frames(tiny_filter, dataset_root, dataset_meta):
    found = values_along(load_filter(tiny_filter), tiny.REPO_ID, 2, root=dataset_root)
    length = dataset_meta.episodes[2]["length"]
    assert found.value.shape == found.margin.shape == (length,)
    assert (found.value <= found.margin + 1e-6).all()


def test_bare_and_shielded_are_compared_and_filmed(tiny_filter, tiny_diffusion, tmp_path):
    shielded = shield_policy(tiny_diffusion, tiny_filter)
    result = evaluate_filter(shielded, LatentSafeDubinsEnv(episode_length=4), 2, video=tmp_path / "film", n_videos=1)
    assert result["bare"]["violation"]["n"] == result["shielded"]["violation"]["n"] == 2
    assert [file.name for file in (tmp_path / "film").iterdir()] == ["episode_000.mp4"]


def test_a_filter_is_trained_from_a_dataset(dataset_root, tmp_path):
    trained = train_filter(
        tiny.REPO_ID, tmp_path / "out", root=dataset_root, config=tiny.config(), steps=2, batch_size=4,
        reachability_steps=3,
    )  # fmt: skip
    assert trained.config.trained_on.stage == "critic"
    again = load_filter(tmp_path / "out" / "filter")
    torch.testing.assert_close(tiny.executed(tiny.drive(trained)), tiny.executed(tiny.drive(again)))
    with pytest.raises(FileExistsError):
        train_filter(tiny.REPO_ID, tmp_path / "out", root=dataset_root, config=tiny.config(), steps=2)
