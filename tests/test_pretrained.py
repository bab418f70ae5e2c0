"""The checkpoints that come with the package."""

import numpy as np
import pytest

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.dubins.ground_truth import exact_value
from lerobot_latentsafe.evaluation.statistics import confusion
from lerobot_latentsafe.experiments.dubins.monitor import LatentMonitor
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.runtime.locations import PRETRAINED, committed_names


def size_of(name):
    return sum(file.stat().st_size for file in (PRETRAINED / name).rglob("*") if file.is_file())


def test_names_that_users_rely_on_are_committed():
    bag, blocks = {"bag", "bag_diffusion_weak", "bag_diffusion_strong"}, {"blocks", "blocks_dreamer"}
    assert {"dubins", "dubins_diffusion_reckless", *bag, *blocks} <= set(committed_names())


def test_every_committed_checkpoint_loads():
    from lerobot.configs.policies import PreTrainedConfig

    assert committed_names()
    for name in committed_names():
        if PreTrainedConfig.from_pretrained(PRETRAINED / name).type == "latentsafe":
            assert LatentSafePolicy.from_pretrained(name).config.trained_on.stage == "critic"
        else:
            assert BasePolicy.load(name).config.output_features["action"].shape in {(2,), (7,)}


def test_weights_are_small():
    assert all(0 < size_of(name) <= 5e6 for name in ("dubins", "bag", "blocks"))
    weights = [file.stat().st_size for file in PRETRAINED.rglob("*.safetensors")]
    assert sum(weights) <= 20e6


@pytest.mark.parametrize("name", ["dubins", "bag", "blocks"])
def test_filter_stores_no_path_of_the_machine_it_was_trained_on(name):
    config = LatentSafePolicy.from_pretrained(name).config
    assert config.frame_cache is None and config.base_policy_path is None


@pytest.fixture(scope="module")
def states():
    return np.random.default_rng(11).uniform([-1.1, -1.1, -np.pi], [1.1, 1.1, np.pi], (3000, 3))


def test_filter_knows_the_safe_set(states):
    monitor = LatentMonitor(LatentSafePolicy.from_pretrained("dubins").model)
    row = confusion(monitor.value(states) > 0, exact_value(states) > 0)
    assert row["f1_safe"] >= 0.97
    assert row["balanced_accuracy"] >= 0.96


def test_filter_shields_the_committed_diffusion_policy():
    from lerobot_latentsafe import LatentSafeDubinsEnv
    from lerobot_latentsafe.evaluation.rollouts import compare

    policy = LatentSafePolicy.from_pretrained("dubins")
    policy.attach("dubins_diffusion_reckless")
    result = compare(policy, LatentSafeDubinsEnv(), 12, seed=500)
    assert result["bare"]["violation"]["k"] >= 3  # it is reckless
    assert result["shielded"]["violation"]["k"] < result["bare"]["violation"]["k"]


def test_filter_keeps_the_candies_in_the_bag_that_an_operator_pulls_up_by_its_closed_end():
    from lerobot_latentsafe.experiments.bag.runs import drive
    from lerobot_latentsafe.franka.bag import BagScene
    from lerobot_latentsafe.franka.behaviors import begin

    scene, policy = BagScene(), LatentSafePolicy.from_pretrained("bag").eval()
    lost = {}
    for name, actor in {"bare": None, "shielded": policy}.items():
        lost[name] = 0
        for seed in (500, 501):
            scene.reset(seed)
            operator = begin("closed_end", scene, None, np.random.default_rng([0, seed]))
            lost[name] += drive(scene, actor, operator)["lost"]
    assert lost["bare"] >= scene.n_candies and lost["shielded"] <= lost["bare"] / 4


def test_task_policy_of_the_blocks_topples_less_under_the_filter_whose_world_model_it_shares():
    from lerobot_latentsafe.experiments.blocks.study import run, world_model_of

    assert world_model_of("blocks_dreamer") == "blocks"
    toppled = {}
    for mode, name in (("bare", None), ("filter", "blocks")):
        job = {"dreamer": "blocks_dreamer", "filter": name, "mode": mode, "epsilon": 0.4}
        toppled[mode] = sum(run({**job, "seed": seed})["violation"] for seed in range(300_002, 300_008))
    assert toppled["bare"] >= 3 and toppled["filter"] <= toppled["bare"] / 2
