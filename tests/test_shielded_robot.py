"""Any robot behind a filter: what is sent is judged, and nothing unjudged moves it."""

import logging
import time

import numpy as np
import pytest
import tiny
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.robots.utils import make_robot_from_config

from lerobot_latentsafe import cli
from lerobot_latentsafe.filter import Reason
from lerobot_latentsafe.robots.franka_interface import ACTION_NAMES
from lerobot_latentsafe.robots.franka_mujoco.config_franka_mujoco import LatentSafeFrankaMujocoConfig
from lerobot_latentsafe.robots.shielded.config_shielded import LatentSafeShieldedConfig

STILL = dict.fromkeys(ACTION_NAMES, 0.0) | {"gripper.pos": 1.0}
PUSH = STILL | {"delta_x.pos": 0.015}
ALWAYS, NEVER = 2.0, -2.0
"""Thresholds at which a filter always, and never, intervenes."""


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return tiny.save_franka_filter(tmp_path_factory.mktemp("filter") / "filter")


def config(trained, **changes):
    inner = LatentSafeFrankaMujocoConfig(scene="blocks", image_size=32, seed=3)
    return LatentSafeShieldedConfig(**{"inner": inner, "filter": str(trained), "epsilon": NEVER, **changes})


@pytest.fixture
def robot(trained):
    made = make_robot_from_config(config(trained))
    with made:
        yield made


def last(robot):
    return robot.filter.shield.decision


def test_it_is_the_inner_robot_to_lerobot(robot):
    assert robot.name == robot.robot_type == "latentsafe_franka_mujoco"
    assert robot.action_features == robot.inner.action_features
    assert set(robot.cameras) == {"front", "wrist"} and robot.is_connected and robot.is_calibrated
    seen = robot.get_observation()
    assert set(robot.observation_features) == set(seen)
    robot.send_action(STILL)
    assert set(robot.get_observation()) - set(seen) == {"shield.value", "shield.margin", "shield.intervened"}


def test_a_safe_action_is_executed_as_it_is(robot):
    robot.get_observation()
    assert robot.send_action(PUSH) == pytest.approx(PUSH) and not last(robot).intervened.item()


def test_an_unsafe_action_is_replaced(trained):
    with make_robot_from_config(config(trained, epsilon=ALWAYS)) as robot:
        robot.get_observation()
        sent = robot.send_action(PUSH)
        assert last(robot).reason.item() == Reason.UNSAFE_VALUE
        assert sent == pytest.approx(dict(zip(ACTION_NAMES, last(robot).action[0].tolist())), abs=1e-6)
        assert sent["gripper.pos"] == 1.0 and sent != PUSH  # it moves, but keeps its grip


def test_in_monitor_mode_it_only_reports(trained):
    with make_robot_from_config(config(trained, epsilon=ALWAYS, mode="monitor")) as robot:
        assert robot.send_action(PUSH) == pytest.approx(PUSH) and last(robot).unsafe.item()


def test_without_a_fresh_observation_it_looks_itself(robot):
    robot.send_action(PUSH)
    first = robot.filter.shield.latent
    robot.send_action(PUSH)
    assert last(robot).reason.item() == Reason.PASSED
    assert any((first[key] != robot.filter.shield.latent[key]).any() for key in first)


def test_an_action_decided_on_an_old_observation_is_not_trusted(robot, monkeypatch):
    robot.get_observation()
    now = time.perf_counter()
    monkeypatch.setattr(time, "perf_counter", lambda: now + 0.2)
    robot.send_action(PUSH)
    assert last(robot).reason.item() == Reason.OBSERVATION_STALE and last(robot).intervened.item()


def test_a_camera_that_repeats_itself_while_the_robot_moves_is_stale(robot, monkeypatch):
    robot.send_action(STILL)
    frozen, reasons = robot.get_observation(), []
    read = robot.inner.get_observation
    monkeypatch.setattr(robot.inner, "get_observation", lambda: {**read(), "wrist": frozen["wrist"].copy()})
    for _ in range(8):
        robot.get_observation()
        robot.send_action(PUSH)
        reasons.append(last(robot).reason.item())
        time.sleep(0.02)
    assert reasons[0] == Reason.PASSED and reasons[-1] == Reason.OBSERVATION_STALE


def test_a_robot_that_stands_still_may_see_the_same_picture(robot):
    for _ in range(5):
        robot.get_observation()
        robot.send_action(STILL)
        assert last(robot).reason.item() == Reason.PASSED


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"wrist": np.zeros((32, 32, 3), np.uint8)}, Reason.OBSERVATION_MISSING),
        ({"joint_1.pos": float("nan")}, Reason.OBSERVATION_NOT_FINITE),
    ],
)
def test_what_cannot_be_seen_is_never_safe(robot, monkeypatch, change, reason):
    read = robot.inner.get_observation
    monkeypatch.setattr(robot.inner, "get_observation", lambda: {**read(), **change})
    robot.send_action(PUSH)
    assert last(robot).reason.item() == reason and last(robot).intervened.item()


def test_an_action_that_is_not_finite_never_reaches_the_robot(robot):
    sent = robot.send_action(PUSH | {"delta_y.pos": float("nan")})
    assert last(robot).reason.item() == Reason.ACTION_NOT_FINITE and np.isfinite(list(sent.values())).all()


def test_joint_moves_are_held_back_unless_allowed(trained, caplog):
    with make_robot_from_config(config(trained)) as robot:
        back = {name: value for name, value in robot.get_observation().items() if name.endswith(".pos")}
        joints = {name: back[name] for name in back if name.startswith("joint_") or name == "gripper.pos"}
        with caplog.at_level(logging.WARNING):
            sent = robot.send_action(joints)
        assert set(sent) == set(ACTION_NAMES) and "unfiltered_moves" in caplog.text
    with make_robot_from_config(config(trained, unfiltered_moves=True)) as robot:
        assert set(robot.send_action(joints)) == set(joints)


def test_a_shielded_policy_is_not_filtered_twice(robot, trained, caplog):
    from lerobot.policies.utils import prepare_observation_for_inference

    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

    policy = LatentSafePolicy.from_pretrained(trained).eval()
    robot.filter.config.epsilon = ALWAYS
    seen = robot.get_observation()
    batch = prepare_observation_for_inference(robot._frame(), policy.device)
    action = dict(zip(ACTION_NAMES, policy.select_action(batch)[0].tolist()))
    with caplog.at_level(logging.WARNING):
        assert robot.send_action(action) == pytest.approx(action, abs=1e-6)
    assert "not filtered again" in caplog.text and seen
    robot.send_action(PUSH)  # what did not come from there is
    assert last(robot).intervened.item()


def test_shields_do_not_nest(trained):
    with pytest.raises(ValueError, match="nest"):
        LatentSafeShieldedConfig(inner=config(trained), filter=str(trained))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"cameras": ["observation.images.front", "observation.images.side"]}, "no camera side"),
        ({"action_names": [*ACTION_NAMES[:-1], "hand.pos"], "kept_commands": []}, "acts in"),
    ],
)
def test_a_filter_of_another_robot_is_refused_before_anything_moves(tmp_path, changes, words):
    from lerobot.configs.types import FeatureType, PolicyFeature

    if "cameras" in changes:
        image = PolicyFeature(FeatureType.VISUAL, (3, 32, 32))
        changes["input_features"] = {
            **dict.fromkeys(changes["cameras"], image),
            "observation.state": PolicyFeature(FeatureType.STATE, (15,)),
        }
    other = tiny.save_franka_filter(tmp_path / "other", **changes)
    with pytest.raises(ValueError, match=words):
        make_robot_from_config(config(other))


def test_options_out_of_range_are_refused(trained):
    with pytest.raises(ValueError, match="guard"):
        make_robot_from_config(config(trained, guard=99))


def options(trained, root, **more):
    given = {
        "filter": trained, "robot.type": "latentsafe_franka_mujoco", "robot.scene": "blocks", "robot.image_size": 32,
        "robot.seed": 3, "teleop.type": "latentsafe_scripted", "teleop.behavior": "pluck_careful", **more,
    }  # fmt: skip
    return [f"--{name}={value}" for name, value in given.items()]


def recording(trained, root):
    given = {
        "repo_id": "me/shielded", "root": root, "single_task": "pluck", "fps": 20, "num_episodes": 2,
        "episode_time_s": 0.6, "reset_time_s": 0.2, "push_to_hub": "false", "video": "false",
    }  # fmt: skip
    dataset = [f"--dataset.{name}={value}" for name, value in given.items()]
    return [*options(trained, root), *dataset, "--play_sounds=false"]


@pytest.mark.parametrize("epsilon", [ALWAYS, NEVER])
def test_a_recording_stores_what_was_executed(tmp_path, epsilon):
    import pyarrow.parquet as pq

    trained = tiny.save_franka_filter(tmp_path / "filter", epsilon=epsilon)
    root = tmp_path / "data"
    cli.main(["record", *recording(trained, root)])
    dataset = LeRobotDataset("me/shielded", root=root)
    rows = pq.read_table(root / "shield" / "decisions.parquet").to_pylist()
    assert [r["episode_index"] for r in rows] == [int(i) for i in dataset.hf_dataset["episode_index"]]
    assert [r["frame_index"] for r in rows] == [int(i) for i in dataset.hf_dataset["frame_index"]]
    stored, proposed = np.array(dataset.hf_dataset["action"]), np.array([r["proposed"] for r in rows])
    assert all(r["intervened"] == (epsilon == ALWAYS) for r in rows)
    assert np.allclose(stored, proposed, atol=1e-6) == (epsilon == NEVER)
    merge = [f"--output_dir={tmp_path / 'merged'}", "--new_repo_id=me/merged"]
    cli.main(["merge-decisions", "--dataset.repo_id=me/shielded", f"--dataset.root={root}", *merge])
    merged = LeRobotDataset("me/merged", root=tmp_path / "merged")
    assert np.allclose(np.array(merged.hf_dataset["shield.proposed"]), proposed, atol=1e-6)
    assert len(merged) == len(rows) and "shield.reason" in merged.features


def test_lerobots_own_commands_take_the_shielded_robot(trained, tmp_path, monkeypatch):
    """lerobot-replay of a bare recording, through the command line, filtered."""
    from lerobot.scripts import lerobot_record, lerobot_replay

    root = tmp_path / "bare"
    bare = [option for option in recording(trained, root) if not option.startswith("--filter")]
    monkeypatch.setattr("sys.argv", ["lerobot-record", *bare])
    lerobot_record.main()
    journal = tmp_path / "replay.parquet"
    replayed = {
        "robot.type": "latentsafe_shielded", "robot.filter": trained, "robot.epsilon": ALWAYS, "robot.journal": journal,
        "robot.inner.type": "latentsafe_franka_mujoco", "robot.inner.scene": "blocks", "robot.inner.image_size": 32,
        "robot.inner.seed": 3, "dataset.repo_id": "me/shielded", "dataset.root": root, "dataset.episode": 0,
        "play_sounds": "false",
    }  # fmt: skip
    monkeypatch.setattr("sys.argv", ["lerobot-replay", *(f"--{name}={value}" for name, value in replayed.items())])
    lerobot_replay.main()
    from lerobot_latentsafe.robots.shielded.journal import decision_columns

    dataset = LeRobotDataset("me/shielded", root=root)
    frames = int((np.array(dataset.hf_dataset["episode_index"]) == 0).sum())
    found = decision_columns(journal, np.zeros(frames, int), np.arange(frames))
    assert found["intervened"].all()
    assert np.allclose(found["proposed"], np.array(dataset.hf_dataset["action"])[:frames], atol=1e-6)


def test_decisions_of_another_dataset_are_refused(tmp_path):
    from lerobot_latentsafe.robots.shielded.journal import decision_columns

    with pytest.raises(FileNotFoundError, match="latentsafe record"):
        decision_columns(tmp_path / "none.parquet", np.zeros(1, int), np.zeros(1, int))
    torn = tmp_path / "torn.parquet"
    torn.write_bytes(b"PAR1")
    with pytest.raises(ValueError, match="not a readable journal"):
        decision_columns(torn, np.zeros(1, int), np.zeros(1, int))


def test_teleoperation_is_shielded(trained, tmp_path, monkeypatch):
    from lerobot_latentsafe.robots.shielded import shielded

    sent, inner_send = [], shielded.LatentSafeShielded.send_action
    monkeypatch.setattr(
        shielded.LatentSafeShielded, "send_action", lambda self, a: sent.append(inner_send(self, a)) or sent[-1]
    )
    cli.main(["teleoperate", *options(trained, tmp_path), "--fps=20", "--teleop_time_s=0.5"])
    assert len(sent) > 2


def test_a_missing_filter_is_named(trained, tmp_path):
    given = [o for o in options(trained, tmp_path) if not o.startswith("--filter")]
    with pytest.raises(SystemExit, match="--filter"):
        cli.main(["teleoperate", *given, "--fps=20", "--teleop_time_s=0.5"])
