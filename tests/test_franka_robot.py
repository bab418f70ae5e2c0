import logging
from dataclasses import dataclass

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.robots.utils import make_robot_from_config
from lerobot.teleoperators.utils import make_teleoperator_from_config
from lerobot.utils.errors import DeviceNotConnectedError
from lerobot_loops import RECORD_LOOP, Recorded, looping

from lerobot_latentsafe.franka.actions import ACTION_NAMES, DELTA_NAMES, JOINT_NAMES, STATE_NAMES
from lerobot_latentsafe.franka.behaviors import BAG, BLOCKS
from lerobot_latentsafe.robots.franka_mujoco.config_franka_mujoco import LatentSafeFrankaMujocoConfig
from lerobot_latentsafe.teleoperators.end_effector.config_end_effector import DeviceConfig, LatentSafeEndEffectorConfig
from lerobot_latentsafe.teleoperators.end_effector.end_effector import LatentSafeEndEffector
from lerobot_latentsafe.teleoperators.scripted.config_scripted import BEHAVIORS, LatentSafeScriptedConfig

STILL = dict.fromkeys(ACTION_NAMES, 0.0) | {"gripper.pos": 1.0}


@pytest.fixture
def robot():
    """The blocks, at 32 pixels."""
    made = make_robot_from_config(LatentSafeFrankaMujocoConfig(scene="blocks", image_size=32, seed=3))
    with made:
        yield made


def operator(behavior="pluck_careful", **options):
    made = make_teleoperator_from_config(LatentSafeScriptedConfig(behavior=behavior, **options))
    made.connect()
    return made


def test_features_end_as_lerobot_keeps_them_and_match(robot):
    scalars = [name for name, kind in robot.observation_features.items() if kind is float]
    assert scalars == STATE_NAMES and list(robot.action_features) == ACTION_NAMES
    assert all(name.endswith((".pos", ".vel")) for name in [*scalars, *ACTION_NAMES])
    seen = robot.get_observation()
    assert set(seen) == set(robot.observation_features)
    for name, kind in robot.observation_features.items():
        assert isinstance(seen[name], float) if kind is float else seen[name].shape == kind


def test_what_is_returned_is_what_was_executed(robot, caplog):
    with caplog.at_level(logging.WARNING):
        sent = robot.send_action(STILL | {"delta_x.pos": 1.0})
    assert sent["delta_x.pos"] == pytest.approx(0.30 / 20) and "clipped" in caplog.text
    assert robot.send_action(sent) == sent


def test_lerobots_return_to_the_start_is_a_joint_move(robot):
    start = robot.get_observation()
    for _ in range(10):
        robot.send_action(STILL | {"delta_x.pos": 0.015, "delta_y.pos": 0.015})
    back = {name: value for name, value in start.items() if name.endswith(".pos")}
    for _ in range(40):
        sent = robot.send_action(back)
    assert set(sent) == {*JOINT_NAMES, "gripper.pos"}
    now = robot.get_observation()
    assert all(abs(now[name] - start[name]) < 0.02 for name in STATE_NAMES)


def test_an_episode_of_lerobots_starts_from_its_own_seed(robot):
    at = []
    for dataset, began in ((Recorded(2), 1.0), (Recorded(2), 1.0), (None, 2.0), (Recorded(0), 3.0)):
        looping(RECORD_LOOP, robot.get_observation, dataset=dataset, start_episode_t=began)
        at.append(robot.scene.seed)
    assert at == [5, 5, 5, 3] and robot.episode == 3


def test_replaying_what_an_operator_did_gives_the_same_states(robot):
    behave, states = operator("pluck_careless"), []
    robot.reset(7)
    actions = []
    for _ in range(60):
        states.append(robot.get_observation())
        # As a dataset stores them.
        actions.append({name: float(np.float32(value)) for name, value in behave.get_action().items()})
        robot.send_action(actions[-1])
    robot.reset(7)
    for seen, action in zip(states, actions):
        again = robot.get_observation()
        np.testing.assert_array_equal(again["front"], seen["front"])
        robot.send_action(action)


def test_operators_begin_anew_in_each_episode(robot):
    behave = operator()
    first = []
    for _ in range(2):
        robot.reset(9)
        first.append([behave.get_action() for _ in range(3)])
    assert first[0] == first[1]


def test_every_behavior_is_documented_and_the_other_way_round():
    assert set(BEHAVIORS) == {*BAG, *BLOCKS}


def test_lerobot_record_writes_labelless_episodes_that_replay(tmp_path, virtual_time):
    """lerobot-record itself, in this process: half a second an episode."""
    from lerobot.configs.dataset import DatasetRecordConfig
    from lerobot.scripts.lerobot_record import RecordConfig, record

    config = RecordConfig(
        robot=LatentSafeFrankaMujocoConfig(scene="blocks", image_size=32),
        teleop=LatentSafeScriptedConfig(behavior="pluck_careful"),
        dataset=DatasetRecordConfig(
            repo_id="me/blocks", root=tmp_path / "blocks", single_task="pluck", fps=20, num_episodes=2,
            episode_time_s=0.5, reset_time_s=0.1, push_to_hub=False, video=False, no_stamp=True,
        ),
        play_sounds=False,
    )  # fmt: skip
    record(config)
    dataset = LeRobotDataset("me/blocks", root=tmp_path / "blocks")
    assert dataset.num_episodes == 2 and dataset.features["action"]["names"] == ACTION_NAMES
    column = np.array(dataset.hf_dataset["observation.state"])
    starts = np.flatnonzero(np.array(dataset.hf_dataset["frame_index"]) == 0)
    np.testing.assert_allclose(column[starts[0]], column[starts[1]], atol=1e-6)  # the arm begins at home
    robot = make_robot_from_config(LatentSafeFrankaMujocoConfig(scene="blocks", image_size=32, seed=1))
    with robot:
        for i in range(starts[1], len(dataset)):
            seen = robot.get_observation()
            np.testing.assert_allclose(column[i], [seen[name] for name in STATE_NAMES], atol=1e-6)
            robot.send_action(dict(zip(ACTION_NAMES, dataset.hf_dataset[i]["action"])))


# The adapter for LeRobot's teleoperators


class Device:
    """A teleoperator that says what it is told to."""

    name, is_connected, feedback_features = "device", True, None

    def __init__(self, *said):
        self.said = iter(said)

    def get_action(self):
        return next(self.said)


def adapter(*said, **options):
    from lerobot.teleoperators.phone.config_phone import PhoneConfig, PhoneOS

    config = LatentSafeEndEffectorConfig(device=PhoneConfig(phone_os=PhoneOS.ANDROID), **options)
    return LatentSafeEndEffector(config, Device(*said))


def test_gamepad_deltas_become_metres_and_the_gripper_keeps_its_wish():
    deltas = {"delta_x": 1.0, "delta_y": 0.0, "delta_z": -0.5}
    moved = adapter({**deltas, "gripper": 0}, {**deltas, "gripper": 1}, speed=0.3, fps=15)
    first, second = moved.get_action(), moved.get_action()
    assert first["delta_x.pos"] == pytest.approx(0.02) and first["delta_z.pos"] == pytest.approx(-0.01)
    assert first["gripper.pos"] == second["gripper.pos"] == 0.0 and list(first) == ACTION_NAMES


def test_a_phone_moves_the_hand_while_its_button_is_held():
    from scipy.spatial.transform import Rotation

    def phone(x, enabled=True):
        inputs = {"reservedButtonA": False, "reservedButtonB": False}
        pose = {"phone.pos": np.array([0.0, x, 0.0]), "phone.rot": Rotation.identity()}
        return {**pose, "phone.raw_inputs": inputs, "phone.enabled": enabled}

    moved = adapter(phone(0.5), phone(0.51), phone(0.9, enabled=False), phone(1.3), phone(1.3), {})
    steps = [moved.get_action()["delta_x.pos"] for _ in range(6)]
    np.testing.assert_allclose(np.abs(steps), [0, 0.01, 0, 0, 0, 0], atol=1e-9)


def test_our_own_names_pass_and_others_are_refused():
    moved = adapter(STILL, {"throttle": 1.0})
    assert moved.get_action() == STILL
    with pytest.raises(ValueError, match=r"device gives throttle; expected delta_x"):
        moved.get_action()


def test_the_adapter_parses_any_device_but_itself():
    import draccus
    from lerobot.teleoperators.config import TeleoperatorConfig

    @dataclass
    class Options:
        teleop: TeleoperatorConfig

    args = ["--teleop.type=latentsafe_end_effector", "--teleop.device.type=gamepad", "--teleop.speed=0.1"]
    parsed = draccus.parse(Options, args=args).teleop
    assert parsed.device.type == "gamepad" and parsed.speed == 0.1
    assert {"phone", "keyboard_ee"} <= set(DeviceConfig.get_known_choices())
    assert "latentsafe_end_effector" not in DeviceConfig.get_known_choices()
    with pytest.raises(ValueError, match=r"no device: give --teleop\.device\.type"):
        LatentSafeEndEffectorConfig()


# Bad input


def test_broken_actions_leave_the_simulation_as_it_was(robot):
    before = robot.scene.data.qpos.copy()
    for broken, message in (
        (STILL | {"delta_y.pos": float("inf")}, r"non-finite values for delta_y\.pos"),
        ({name.removesuffix(".pos"): 0.0 for name in DELTA_NAMES}, r"expected delta_x\.pos"),
        ({}, r"names \(none\)"),
    ):
        with pytest.raises(ValueError, match=message):
            robot.send_action(broken)
    np.testing.assert_array_equal(robot.scene.data.qpos, before)


def test_an_unconnected_robot_says_so():
    robot = make_robot_from_config(LatentSafeFrankaMujocoConfig())
    for call in (robot.get_observation, lambda: robot.send_action(STILL), robot.disconnect):
        with pytest.raises(DeviceNotConnectedError, match=r"not connected; call connect\(\) first"):
            call()


def test_unknown_options_are_refused_before_anything_is_recorded():
    for options, message in (
        ({"scene": "kitchen"}, "expected one of bag, blocks"),
        ({"variant": "blue"}, "expected one of red, green"),
        ({"image_size": 4000}, "expected 16 to 1024"),
    ):
        with pytest.raises(ValueError, match=message):
            LatentSafeFrankaMujocoConfig(**options)
    with pytest.raises(ValueError, match=r"behavior is 'dance'; expected one of open_end, middle"):
        LatentSafeScriptedConfig(behavior="dance")
    with pytest.raises(ValueError, match="speed is -1"):
        LatentSafeScriptedConfig(behavior="middle", speed=-1)


def test_an_operator_without_its_scene_says_which_robot(robot):
    with pytest.raises(ValueError, match=r"'middle' does not fit the BlocksScene; expected one of random"):
        operator("middle").get_action()
    robot.disconnect()
    try:
        with pytest.raises(DeviceNotConnectedError, match=r"--robot\.type=latentsafe_franka_mujoco"):
            operator().get_action()
    finally:
        robot.connect()
