"""Policies that are told where the bag is, instead of looking: what they are told, from recording to acting."""

from dataclasses import replace

import numpy as np
import pytest
from lerobot.utils.constants import OBS_ENV_STATE

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.collection import franka
from lerobot_latentsafe.collection.policy_operator import check_policy
from lerobot_latentsafe.experiments.bag.seeing_policy import train_seeing_policy
from lerobot_latentsafe.experiments.scene_world import SceneWorld
from lerobot_latentsafe.franka.bag import LOCATION_NAMES, MIDDLE, TAIL, BagScene
from lerobot_latentsafe.franka.scenes import SCENES, make_scene


@pytest.fixture(scope="module")
def bag():
    with_bag = BagScene(image_size=32)
    yield with_bag
    with_bag.close()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_bag_is_told_as_seen_from_the_hand(bag, seed):
    bag.reset(seed)
    told = np.array([bag.location()[name] for name in LOCATION_NAMES])
    hand, _ = bag.tool_pose()
    np.testing.assert_allclose(hand + told[:3], bag.segment_position(TAIL))
    np.testing.assert_allclose(hand + told[3:6], bag.segment_position(MIDDLE))
    assert abs(told[6]) <= np.pi / 2
    np.testing.assert_allclose(told[7:13], np.tanh(told[:6] / 0.02))


def test_turning_by_what_is_told_aligns_the_hand_with_the_bag(bag):
    bag.reset(0)
    for _ in range(60):
        turn = np.clip(bag.location()["bag_yaw"], -0.05, 0.05)
        bag.step(np.array([0, 0, 0, 0, 0, turn, 1.0]))
    assert abs(bag.location()["bag_yaw"]) < 0.05


@pytest.mark.parametrize(("name", "tells"), [("bag", True), ("blocks", False)])
def test_a_world_tells_what_its_scene_tells(name, tells):
    scene = make_scene(name)
    seen = SceneWorld(scene, 1, cameras=()).observe()
    assert (OBS_ENV_STATE in seen) == tells == bool(scene.location())
    if tells:
        assert seen[OBS_ENV_STATE].shape == (1, len(LOCATION_NAMES))


def test_a_policy_that_is_told_is_recorded_trained_and_acts(bag, monkeypatch, tmp_path):
    short = replace(franka.SOURCES["bag_mixed"], mix={"nearer": 2}, astray=0.0, seconds=2.0)
    monkeypatch.setitem(franka.SOURCES, "bag_mixed", short)
    monkeypatch.setitem(SCENES, "bag", replace(SCENES["bag"], image_size=32))
    recorded = franka.collect_franka("bag_mixed", "me/told", tmp_path / "told", 2, seed=0)
    first = np.asarray(recorded[0][OBS_ENV_STATE])
    assert recorded.meta.features[OBS_ENV_STATE]["names"] == LOCATION_NAMES and np.isfinite(first).all()

    train_seeing_policy(tmp_path / "told", "me/told", tmp_path / "policy", steps=2)
    policy = BasePolicy.load(tmp_path / "policy")
    assert not policy.config.image_features  # it is told, and does not look
    bag.reset(0)
    action = policy.propose(SceneWorld(bag, 1, cameras=()).observe())
    assert action.shape == (1, 7) and action.isfinite().all()
    check_policy(str(tmp_path / "policy"), SCENES["bag"].fps, 32)

    franka.collect_franka("bag_mixed", "me/told", tmp_path / "others", 2, seed=1)
    (tmp_path / "told_told").rename(tmp_path / "others_told")
    with pytest.raises(ValueError, match="others_told was made of other demonstrations than those of"):
        train_seeing_policy(tmp_path / "others", "me/told", tmp_path / "another", steps=2)
