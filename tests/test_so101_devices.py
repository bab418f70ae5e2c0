from types import SimpleNamespace

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import make_env
from lerobot.envs.utils import env_to_policy_features
from lerobot.robots.so_follower import SO101FollowerConfig
from lerobot.robots.utils import make_robot_from_config
from lerobot.teleoperators.utils import make_teleoperator_from_config
from lerobot.utils.errors import DeviceNotConnectedError

from lerobot_latentsafe import LatentSafeSO101Env, LatentSafeSO101LeaderConfig, LatentSafeSO101MujocoConfig
from lerobot_latentsafe.collection import so101
from lerobot_latentsafe.datasets.labels import FailureLabels
from lerobot_latentsafe.so101.actions import NAMES, REST

STILL = dict(zip(NAMES, REST.tolist()))


@pytest.fixture
def robot():
    """At 32 pixels."""
    made = make_robot_from_config(LatentSafeSO101MujocoConfig(image_size=32, seed=3))
    with made:
        yield made


def leader(**options):
    made = make_teleoperator_from_config(LatentSafeSO101LeaderConfig(**options))
    made.connect()
    return made


def test_names_and_features_are_those_of_lerobots_own_robot(robot, monkeypatch):
    # Its motors' package is not installed; the names are its own.
    bus = lambda port, motors, calibration: SimpleNamespace(motors=motors)  # noqa: E731
    monkeypatch.setattr("lerobot.robots.so_follower.so_follower.FeetechMotorsBus", bus)
    real = make_robot_from_config(SO101FollowerConfig(port="none", cameras={}))
    assert list(robot.action_features.items()) == list(real.action_features.items())
    assert robot.name == "so101_follower"
    scalars = {name: kind for name, kind in robot.observation_features.items() if kind is float}
    assert list(scalars.items()) == list(real.observation_features.items())
    seen = robot.get_observation()
    assert list(seen) == list(robot.observation_features)
    assert seen["front"].shape == seen["wrist"].shape == (32, 32, 3)


def test_what_is_returned_is_what_was_executed_and_an_observation_is_a_pose_to_return_to(robot):
    start = robot.get_observation()
    sent = robot.send_action(STILL | {"shoulder_pan.pos": 200.0})
    assert sent["shoulder_pan.pos"] == 110.0
    back = {name: value for name, value in start.items() if name.endswith(".pos")}
    for _ in range(90):
        robot.send_action(back)
    assert robot.get_observation()["shoulder_pan.pos"] == pytest.approx(start["shoulder_pan.pos"], abs=0.1)


def test_the_leader_begins_anew_with_each_episode_and_then_holds_still(robot):
    operator = leader(behavior="careful")
    first = [operator.get_action() for _ in range(3)]
    robot.reset(3)
    assert [operator.get_action() for _ in range(3)] == first
    for _ in range(160):
        robot.send_action(last := operator.get_action())
    assert operator.get_action() == last and list(last) == NAMES


def test_a_leader_without_its_robot_says_which():
    with pytest.raises(DeviceNotConnectedError, match=r"--robot\.type=latentsafe_so101_mujoco"):
        leader(behavior="careful").get_action()
    with pytest.raises(ValueError, match="behavior is 'dance'; expected one of careful, reckless"):
        LatentSafeSO101LeaderConfig(behavior="dance")
    with pytest.raises(ValueError, match="image_size is 4"):
        LatentSafeSO101MujocoConfig(image_size=4)


def test_environment_and_robot_show_the_same(robot):
    config = LatentSafeSO101Env(image_size=32)
    features = env_to_policy_features(config)
    assert features["observation.state"].shape == features["action"].shape == (6,)
    env = next(iter(make_env(config).values()))[0]
    seen, info = env.reset(seed=[3])
    for action in (np.float32(REST), np.float32(REST + 2)):
        from_robot = robot.get_observation()
        np.testing.assert_array_equal(seen["pixels"]["front"][0], from_robot["front"])
        np.testing.assert_array_equal(seen["pixels"]["wrist"][0], from_robot["wrist"])
        np.testing.assert_array_equal(seen["agent_pos"][0], np.float32([from_robot[name] for name in NAMES]))
        robot.send_action(dict(zip(NAMES, action.tolist())))
        seen, _, _, _, info = env.step(action[None])
        np.testing.assert_allclose(info["state"][0], robot.scene.truth()["state"], atol=1e-5)
    assert {"failure", "is_success", "severity", "state"} <= set(info)
    env.close()


def test_collected_episodes_are_labelled_and_depend_on_the_seed_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(so101, "EPISODE_SECONDS", 3.5)
    for name in ("once", "again"):
        so101.collect_so101("so101_reckless", "me/cube", tmp_path / name, 2, seed=0)
    datasets = [LeRobotDataset("me/cube", root=tmp_path / name) for name in ("once", "again")]
    for column in ("observation.state", "action", "failure"):
        np.testing.assert_array_equal(*(np.array(dataset.hf_dataset[column]) for dataset in datasets))
    labels = FailureLabels.load(tmp_path / "once")
    for episode in range(2):
        assert (np.diff(labels.failure[labels.episode == episode]) >= 0).all()
    assert datasets[0].meta.info.robot_type == "so101_follower" and datasets[0].num_frames == 210
    assert datasets[0][0]["observation.images.wrist"].shape == (3, 64, 64)


def test_a_mix_keeps_its_proportions_and_an_unknown_source_is_refused(tmp_path):
    parts = [so101.part_of("so101_mix", episode) for episode in range(300)]
    assert all(parts.count(part) == part.episodes for part in so101.SOURCES["so101_mix"])
    assert len({part.behavior for part in parts[:30]}) == 4
    with pytest.raises(ValueError, match="expected one of so101_careful"):
        so101.collect_so101("so101_dance", "me/x", tmp_path / "x", 1, seed=0)
