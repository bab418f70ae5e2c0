"""Any robot behind a filter: what is sent is judged, and nothing unjudged moves it."""

import logging
import sys
import threading
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import torch
from lerobot.configs.types import PipelineFeatureType
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.processor import RobotActionProcessorStep, RobotProcessorPipeline, make_default_processors
from lerobot.processor.converters import robot_action_observation_to_transition, transition_to_robot_action
from lerobot.robots.utils import make_robot_from_config
from lerobot.scripts import lerobot_record
from shielded_robots import ALWAYS, NEVER, PERIOD, PUSH, STILL, config, last

from lerobot_latentsafe import cli
from lerobot_latentsafe.cli import record as recording_verbs
from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.franka.actions import ACTION_NAMES, STATE_NAMES
from lerobot_latentsafe.robots.shielded.config_shielded import LatentSafeShieldedConfig

pytestmark = pytest.mark.usefixtures("virtual_time")


def test_it_is_the_inner_robot_to_lerobot(robot):
    assert robot.name == robot.robot_type == "latentsafe_franka_mujoco"
    assert robot.action_features == robot.inner.action_features
    assert set(robot.cameras) == {"front", "wrist"} and robot.is_connected and robot.is_calibrated
    decided = {"shield.value", "shield.margin", "shield.intervened"}
    seen = robot.get_observation()
    assert set(seen) == {*robot.observation_features, *decided} and seen["shield.intervened"] == 0.0
    assert np.isnan([seen["shield.value"], seen["shield.margin"]]).all()
    robot.send_action(STILL)
    seen = robot.get_observation()
    assert np.isfinite([seen[name] for name in decided]).all()


def test_a_safe_action_is_executed_as_it_is(robot):
    robot.get_observation()
    assert robot.send_action(PUSH) == pytest.approx(PUSH) and not last(robot).intervened.item()


def test_an_unsafe_action_is_replaced(trained):
    with make_robot_from_config(config(trained, {"epsilon": ALWAYS})) as robot:
        robot.get_observation()
        sent = robot.send_action(PUSH)
        assert last(robot).reason.item() == Reason.UNSAFE_VALUE
        assert sent == pytest.approx(dict(zip(ACTION_NAMES, last(robot).action[0].tolist())), abs=1e-6)
        assert sent["gripper.pos"] == 1.0 and sent != PUSH  # it moves, but keeps its grip


def test_in_monitor_mode_it_only_reports(trained):
    with make_robot_from_config(config(trained, {"epsilon": ALWAYS, "mode": "monitor"})) as robot:
        assert robot.send_action(PUSH) == pytest.approx(PUSH) and last(robot).unsafe.item()


def test_without_a_fresh_observation_it_looks_itself(robot, virtual_time):
    robot.send_action(PUSH)
    first = robot.filter.shield.latent
    virtual_time.sleep(PERIOD)
    robot.send_action(PUSH)
    assert last(robot).reason.item() == Reason.PASSED
    assert any((first[key] != robot.filter.shield.latent[key]).any() for key in first)


@pytest.mark.fault(
    "R02", "a camera repeats an old picture while the robot moves", "The robot stays: `OBSERVATION_STALE`"
)
def test_a_camera_that_repeats_itself_while_the_robot_moves_is_stale(robot, virtual_time, monkeypatch):
    frozen, reasons = robot.get_observation(), []
    read = robot.inner.get_observation
    monkeypatch.setattr(robot.inner, "get_observation", lambda: {**read(), "wrist": frozen["wrist"].copy()})
    for _ in range(8):
        robot.get_observation()
        robot.send_action(PUSH)
        reasons.append(last(robot).reason.item())
        virtual_time.sleep(0.05)
    assert reasons[0] == Reason.PASSED and reasons[-1] == Reason.OBSERVATION_STALE


def test_a_robot_that_stands_still_may_see_the_same_picture(robot, virtual_time):
    for _ in range(5):
        virtual_time.sleep(PERIOD)
        robot.get_observation()
        robot.send_action(STILL)
        assert last(robot).reason.item() == Reason.PASSED


def test_joint_moves_are_held_back_unless_allowed(trained, caplog):
    with make_robot_from_config(config(trained)) as robot:
        back = {name: value for name, value in robot.get_observation().items() if name.endswith(".pos")}
        joints = {name: back[name] for name in back if name.startswith("joint_") or name == "gripper.pos"}
        with caplog.at_level(logging.WARNING):
            sent = robot.send_action(joints)
        assert set(sent) == set(ACTION_NAMES) and "unfiltered_moves" in caplog.text
    with make_robot_from_config(config(trained, unfiltered_moves=True)) as robot:
        assert set(robot.send_action(joints)) == set(joints)


@pytest.mark.parametrize("opening", [1.0, 0.4])
def test_at_the_first_tick_the_grip_is_held_as_it_is_seen(robot, opening):
    """Nothing was executed yet, and nothing that could be is proposed: 0 would close the fingers."""
    seen = robot.inner.get_observation()
    seen["gripper.pos"] = opening
    robot.inner.get_observation = lambda: seen
    sent = robot.send_action(PUSH | {"delta_x.pos": float("nan")})
    assert last(robot).intervened.item() and sent["gripper.pos"] == pytest.approx(opening, abs=1e-5)
    robot._forget()
    robot._sent.clear()
    assert robot.send_action({"joint_1.pos": 0.1}) == pytest.approx(STILL | {"gripper.pos": opening})


def test_what_stays_closed_stays_closed_through_moves_of_other_names(robot):
    robot.get_observation()
    robot.send_action(PUSH | {"gripper.pos": 0.25})
    joints = {name: value for name, value in robot.get_observation().items() if name.startswith("joint_")}
    for _ in range(3):
        sent = robot.send_action(joints)
        assert sent == pytest.approx(STILL | {"gripper.pos": 0.25})


def policy_decision(robot, trained):
    """A policy under the same filter acts on what the robot sees: the policy and its action, as LeRobot sends it."""
    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

    policy = LatentSafePolicy.from_pretrained(trained).eval()
    policy.config.law.epsilon = robot.filter.config.law.epsilon
    robot.get_observation()
    with torch.inference_mode():
        action = policy.select_action(robot._batch())
    return policy, dict(zip(ACTION_NAMES, action[0].tolist()))


def test_a_shielded_policy_is_not_filtered_twice(robot, trained, caplog, virtual_time):
    policy, action = policy_decision(robot, trained)
    assert robot.send_action(action) == pytest.approx(action)
    assert "not filtered again" in caplog.text and last(robot) is policy.shield.decision
    virtual_time.sleep(PERIOD)
    robot.get_observation()
    robot.send_action(PUSH)  # what did not come from there is, on the same memory
    assert last(robot) is not policy.shield.decision and last(robot).reason.item() == Reason.PASSED


@pytest.mark.parametrize("difference", ["laxer", "other weights", "monitor"])
def test_another_filter_of_the_policy_does_not_excuse_the_robots(robot, trained, difference):
    policy, action = policy_decision(robot, trained)
    if difference == "laxer":
        robot.filter.config.law.epsilon = ALWAYS
    elif difference == "monitor":
        policy.config.law.mode = "monitor"
    else:
        next(policy.model.margin.parameters()).data.add_(1)
    robot.send_action(action)
    assert last(robot) is not policy.shield.decision


@pytest.fixture
def twins(trained):
    """Two robots behind the same filter, whose scenes differ."""
    with make_robot_from_config(config(trained)) as first, make_robot_from_config(config(trained)) as second:
        second.inner.reset(9)
        yield first, second


@pytest.mark.fault("R44", "two robots have one filter; one of them is blind", "Each decides by what it sees itself")
def test_a_blind_robot_takes_nothing_from_another(twins, monkeypatch):
    seeing, blind = twins
    read = blind.inner.get_observation
    monkeypatch.setattr(blind.inner, "get_observation", lambda: read() | {"wrist": np.zeros((32, 32, 3), np.uint8)})
    assert seeing.send_action(PUSH) == pytest.approx(PUSH)
    assert blind.send_action(PUSH) == pytest.approx(STILL)
    assert last(blind).reason.item() == Reason.OBSERVATION_MISSING and last(seeing).reason.item() == Reason.PASSED


@pytest.mark.parametrize("alike", [True, False])
@pytest.mark.fault("R45", "two robots have one filter; one of them is in danger", "Each decides by what it sees itself")
def test_a_robot_decides_for_itself_even_where_another_sees_the_same(twins, trained, alike):
    first, second = twins
    second.inner.reset(first.config.inner.seed if alike else 9)
    first.send_action(PUSH)
    second.send_action(PUSH)
    assert last(first) is not last(second) and (last(first).value == last(second).value).all() == alike


def test_a_policys_decision_serves_the_robot_that_it_sees_alone(twins, trained):
    first, second = twins
    policy, action = policy_decision(first, trained)
    second.send_action(action)
    assert last(second) is not policy.shield.decision
    first.send_action(action)
    assert last(first) is policy.shield.decision


@pytest.mark.fault(
    "R43b", "another thread decides between a decision and its use", "What is executed is what this call decided"
)
def test_what_is_executed_is_what_this_call_decided(robot, monkeypatch, virtual_time):
    """Another thread, or a policy, asks the same shield between the decision and its use."""
    shield, hear = robot.filter.shield, robot._carry_out

    def interrupted(decision, numbers):
        shield.decision = None
        return hear(decision, numbers)

    monkeypatch.setattr(robot, "_carry_out", interrupted)
    assert robot.send_action(PUSH | {"delta_x.pos": 1e9}) == pytest.approx(STILL)


@pytest.mark.fault("R43b", "several threads send actions at once", "They take turns")
def test_threads_take_turns(robot, virtual_time):
    wild, sent, seen = PUSH | {"delta_x.pos": 1e9}, [], robot.get_observation()
    robot.inner.get_observation = lambda: seen  # each thread would need a renderer of its own
    threads = [threading.Thread(target=lambda a=a: sent.append(robot.send_action(a))) for a in [PUSH, wild] * 4]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(sent) == 8 and all(abs(action["delta_x.pos"]) <= 0.015 + 1e-6 for action in sent)


def test_shields_do_not_nest(trained):
    with pytest.raises(ValueError, match="nest"):
        LatentSafeShieldedConfig(inner=config(trained), filter=str(trained))
    nested = ["--robot.inner.type=latentsafe_shielded", "--robot.inner.inner.type=latentsafe_franka_mujoco"]
    shielded = ["--robot.type=latentsafe_shielded", f"--robot.filter={trained}", "--teleop.type=latentsafe_scripted"]
    with pytest.raises(SystemExit) as stopped:
        cli.main(["teleoperate", *shielded, *nested])
    assert "--robot.inner.type is 'latentsafe_shielded'" in str(stopped.value)


def seen(**cameras):
    """Input features of a filter whose pictures have these shapes."""
    from lerobot.configs.types import FeatureType, PolicyFeature

    images = {f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, shape) for name, shape in cameras.items()}
    return {**images, "observation.state": PolicyFeature(FeatureType.STATE, (len(STATE_NAMES),))}


SQUARE = (3, 32, 32)
SIDE = {"trained_on_cameras": ["observation.images.front", "observation.images.side"]}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({**SIDE, "input_features": seen(front=SQUARE, side=SQUARE)}, "no camera side"),
        ({"input_features": seen(front=SQUARE, wrist=(3, 24, 32))}, r"wrist has shape \(3, 32, 32\).*\(3, 24, 32\)"),
        ({"trained_on_action_names": [*ACTION_NAMES[:-1], "hand.pos"], "fallback_frozen_commands": []}, "acts in"),
        ({"trained_on_state_names": [*STATE_NAMES[:-1], "weight.pos"]}, "does not observe weight.pos"),
    ],
)
def test_a_filter_of_another_robot_is_refused_before_anything_moves(tmp_path, changes, words):
    other = tiny.save_franka_filter(tmp_path / "other", **changes)
    with pytest.raises(ValueError, match=words):
        make_robot_from_config(config(other))


def test_once_it_acted_the_robot_is_released_above_another_value(trained):
    with make_robot_from_config(config(trained, {"epsilon": ALWAYS, "resume_above": 0.9})) as robot:
        robot.send_action(PUSH)
        robot.filter.config.law.epsilon = NEVER
        robot.send_action(PUSH)
        assert last(robot).intervened.item() == (last(robot).value.item() <= 0.9)


def test_options_out_of_range_are_refused(trained):
    with pytest.raises(ValueError, match="proposal_steps"):
        make_robot_from_config(config(trained, {"proposal_steps": 99}))


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
def test_a_recording_stores_what_was_executed(tmp_path, epsilon, capsys):
    import pyarrow.parquet as pq

    trained = tiny.save_franka_filter(tmp_path / "filter", law_epsilon=epsilon)
    root = tmp_path / "data"
    cli.main(["record", *recording(trained, root)])
    assert "stores what was proposed" not in capsys.readouterr().err
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
    page = tmp_path / "report.html"
    shown = ["--dataset.repo_id=me/shielded", f"--dataset.root={root}", f"--output={page}"]
    cli.main(["report", f"--policy.path={trained}", *shown])
    assert f"{100.0 * (epsilon == ALWAYS):.1f}% of all steps" in page.read_text()
    assert page.read_text().count("<video") == dataset.num_episodes
    assert ("imagined failure" in page.read_text()) == (epsilon == ALWAYS)
    cli.main(["report", f"--policy.path={trained}", *shown, "--dataset.episodes=[1]"])
    assert page.read_text().count("<video") == 1 and "me/shielded: 1 episodes" in page.read_text()


def test_an_episode_that_is_recorded_again_keeps_its_last_decisions(trained, tmp_path, monkeypatch):
    """The operator repeats the first episode, as soon as it has five frames."""
    from lerobot_latentsafe.datasets.decisions import FILE, decision_columns
    from lerobot_latentsafe.datasets.labels import read_frames

    events = {"exit_early": False, "rerecord_episode": False, "stop_recording": False}
    monkeypatch.setattr(lerobot_record, "init_keyboard_listener", lambda: (None, events))
    add, frames = LeRobotDataset.add_frame, []

    def repeat(dataset, frame):
        add(dataset, frame)
        frames.append(dataset.num_episodes)
        if len(frames) == 5:
            events.update(exit_early=True, rerecord_episode=True)

    monkeypatch.setattr(LeRobotDataset, "add_frame", repeat)
    root = tmp_path / "data"
    cli.main(["record", *recording(trained, root)])
    stored = read_frames(root, ["frame_index", "action"])
    assert set(stored["episode_index"]) == {0, 1} and len(stored["index"]) == len(frames) - 5
    assert len(decision_columns(root / FILE, stored)["value"]) == len(frames) - 5


@pytest.mark.skipif(sys.platform == "win32", reason="needs fork")
def test_a_recording_of_the_command_that_is_killed_goes_on(trained, tmp_path):
    from test_killed_recording import killed

    root = tmp_path / "data"
    given = ["record", *recording(trained, root)]
    killed(lambda: cli.main(given), "lerobot.datasets.dataset_metadata.write_stats", 2)
    assert LeRobotDataset("me/shielded", root=root).num_episodes == 1
    cli.main([*given, "--resume=true", "--dataset.num_episodes=1"])
    merge = [f"--output_dir={tmp_path / 'merged'}", "--new_repo_id=me/merged"]
    cli.main(["merge-decisions", "--dataset.repo_id=me/shielded", f"--dataset.root={root}", *merge])
    assert LeRobotDataset("me/merged", root=tmp_path / "merged").num_episodes == 2


def test_videos_are_saved_with_their_episode(trained, tmp_path):
    with pytest.raises(SystemExit, match="video_encoding_batch_size is 3; expected 1"):
        cli.main(["record", *recording(trained, tmp_path / "data"), "--dataset.video_encoding_batch_size=3"])


def test_lerobots_own_commands_take_the_shielded_robot(trained, tmp_path, monkeypatch):
    """lerobot-replay of a bare recording, through the command line, filtered."""
    from lerobot.scripts import lerobot_record, lerobot_replay

    root = tmp_path / "bare"
    bare = [option for option in recording(trained, root) if not option.startswith("--filter")]
    monkeypatch.setattr("sys.argv", ["lerobot-record", *bare])
    lerobot_record.main()
    journal = tmp_path / "replay.parquet"
    replayed = {
        "robot.journal": journal, "dataset.repo_id": "me/shielded", "dataset.root": root, "dataset.episode": 0,
        "play_sounds": "false",
    }  # fmt: skip
    monkeypatch.setattr("sys.argv", ["lerobot-replay", *shielded_options(trained, **replayed)])
    lerobot_replay.main()
    import pyarrow.parquet as pq

    dataset = LeRobotDataset("me/shielded", root=root)
    frames = int((np.array(dataset.hf_dataset["episode_index"]) == 0).sum())
    rows = pq.read_table(journal).to_pylist()
    assert [r["frame_index"] for r in rows] == list(range(frames)) and all(r["intervened"] for r in rows)
    assert np.allclose([r["proposed"] for r in rows], np.array(dataset.hf_dataset["action"])[:frames], atol=1e-6)


def test_a_journal_goes_on_and_forgets_what_is_recorded_again(tmp_path):
    import pyarrow.parquet as pq

    from lerobot_latentsafe.datasets.decisions import Journal
    from lerobot_latentsafe.decision import least_restrictive

    def note(journal, episode, values):
        journal.begin(episode)
        for value in values:
            judged = least_restrictive(np.zeros((1, 2)), np.ones((1, 2)), np.float32([value]), np.ones(1), 0.0)
            journal.add(judged, [0.0, 1.0])

    path = tmp_path / "shield" / "decisions.parquet"
    first = Journal(path)
    note(first, 0, [0.5, -0.5])
    note(first, None, [0.1])
    note(first, 1, [0.2, 0.2, 0.2])  # cut off, and recorded again when the recording goes on
    first.write()
    resumed = Journal(path)
    note(resumed, 1, [0.7])
    resumed.write()
    rows = [
        (r["episode_index"], r["frame_index"], round(r["value"], 1), r["reason"])
        for r in pq.read_table(path).to_pylist()
    ]
    assert rows == [(0, 0, 0.5, "passed"), (0, 1, -0.5, "unsafe_value"), (1, 0, 0.7, "passed")]


def frames_of(*actions):
    """An episode as a dataset stores it."""
    n = len(actions)
    return {"episode_index": np.zeros(n, int), "frame_index": np.arange(n), "action": np.array(actions, np.float32)}


def test_decisions_of_another_dataset_are_refused(tmp_path):
    from lerobot_latentsafe.datasets.decisions import Journal, decision_columns
    from lerobot_latentsafe.decision import least_restrictive

    with pytest.raises(FileNotFoundError, match="latentsafe record"):
        decision_columns(tmp_path / "none.parquet", frames_of([0.0, 1.0]))
    torn = tmp_path / "torn.parquet"
    torn.write_bytes(b"PAR1")
    with pytest.raises(ValueError, match="not a readable file of decisions"):
        decision_columns(torn, frames_of([0.0, 1.0]))
    journal = Journal(tmp_path / "decisions.parquet")
    judged = least_restrictive(np.zeros((1, 2)), np.ones((1, 2)), np.ones(1), np.ones(1), 0.0)
    for executed in ([0.0, 1 / 3], [0.5, 1.0]):
        journal.add(judged, executed)
    journal.write()
    assert decision_columns(journal.path, frames_of([0.0, 1 / 3], [0.5, 1.0]))["value"].tolist() == [1.0, 1.0]
    with pytest.raises(ValueError, match=r"None was executed in episode 0, frame 2.*another dataset"):
        decision_columns(journal.path, frames_of([0.0, 1 / 3], [0.5, 1.0], [0.5, 1.0]))
    with pytest.raises(ValueError, match=r"\[0\.5, 1\.0\] was executed in episode 0, frame 1.*another dataset"):
        decision_columns(journal.path, frames_of([0.0, 1 / 3], [0.5, 0.9]))


@pytest.fixture
def executed(monkeypatch):
    """Every (proposed, executed) pair of actions in LeRobot's own loops."""
    from lerobot_latentsafe.robots.shielded.shielded import LatentSafeShielded

    pairs, send = [], LatentSafeShielded.send_action

    def noted(self, action):
        pairs.append((dict(action), send(self, action)))
        return pairs[-1][1]

    monkeypatch.setattr(LatentSafeShielded, "send_action", noted)
    return pairs


def shielded_options(trained, **more):
    given = {
        "robot.type": "latentsafe_shielded", "robot.filter": trained, "robot.law.epsilon": ALWAYS,
        "robot.inner.type": "latentsafe_franka_mujoco", "robot.inner.scene": "blocks", "robot.inner.image_size": 32,
        "robot.inner.seed": 3, **more,
    }  # fmt: skip
    return [f"--{name}={value}" for name, value in given.items()]


OPERATOR = {"teleop.type": "latentsafe_scripted", "teleop.behavior": "pluck_careful", "fps": 20, "teleop_time_s": 0.5}


def test_teleoperation_is_shielded(trained, monkeypatch, executed):
    from lerobot.scripts import lerobot_teleoperate

    monkeypatch.setattr("sys.argv", ["lerobot-teleoperate", *shielded_options(trained, **OPERATOR)])
    lerobot_teleoperate.main()
    assert len(executed) > 2 and all(sent != proposed for proposed, sent in executed)
    executed.clear()
    cli.main(["teleoperate", *shielded_options(trained, **OPERATOR | {"robot.law.epsilon": NEVER})])
    assert len(executed) > 2 and all(sent == pytest.approx(proposed) for proposed, sent in executed)


def test_lerobot_record_is_shielded_but_stores_what_was_proposed(trained, tmp_path, monkeypatch, executed, capsys):
    from lerobot.scripts import lerobot_record

    given = [o for o in recording(trained, tmp_path / "data") if not o.startswith(("--filter", "--robot."))]
    monkeypatch.setattr("sys.argv", ["lerobot-record", *shielded_options(trained), *given])
    lerobot_record.main()
    assert len(executed) > 2 and all(sent != proposed for proposed, sent in executed)
    assert "`latentsafe record` stores that" in capsys.readouterr().err


@pytest.mark.parametrize(("epsilon", "once"), [(None, True), (ALWAYS, False)])
def test_a_rollout_is_shielded_once(trained, monkeypatch, executed, epsilon, once):
    """By the policy's own filter if that is the robot's too; its return to the start is held back."""
    from lerobot.rollout.strategies.core import RolloutStrategy
    from lerobot.scripts import lerobot_rollout

    from lerobot_latentsafe.shield import Shield

    adopted, adopt, back = [], Shield.adopt, RolloutStrategy._return_to_initial_position
    monkeypatch.setattr(Shield, "adopt", lambda *given: adopted.append(adopt(*given)) or adopted[-1])
    monkeypatch.setattr(RolloutStrategy, "_return_to_initial_position", lambda self, hw: back(hw, duration_s=0.1))
    given = {"policy.path": trained, "policy.device": "cpu", "task": "pluck", "fps": 20, "duration": 0.5}
    given = [option for option in shielded_options(trained, **given) if epsilon or "epsilon" not in option]
    monkeypatch.setattr("sys.argv", ["lerobot-rollout", *given])
    lerobot_rollout.main()
    assert len(adopted) > 2 and all((taken is not None) == once for taken in adopted)
    assert all(set(sent) == set(ACTION_NAMES) for _, sent in executed)
    returning = [sent for proposed, sent in executed if set(proposed) != set(ACTION_NAMES)]
    assert returning and all(sent[name] == 0.0 for sent in returning for name in ACTION_NAMES[:6])


@pytest.fixture
def viewer(monkeypatch):
    """A stand-in for rerun, which need not be installed here: `logged` pairs of path and value, `layouts` sent."""
    from lerobot.utils import import_utils

    logged, layouts, ignore = [], [], lambda *a, **k: None
    view = lambda **options: options  # noqa: E731
    blueprint = SimpleNamespace(
        Spatial2DView=view, TimeSeriesView=view, Grid=lambda *views: views, Blueprint=lambda grid: grid
    )
    rerun = SimpleNamespace(
        init=ignore, spawn=ignore, rerun_shutdown=ignore, Scalars=float, Image=np.shape, blueprint=blueprint,
        log=lambda path, entity, **k: logged.append((path, entity)), send_blueprint=layouts.append,
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "rerun", rerun)
    monkeypatch.setitem(sys.modules, "rerun.blueprint", blueprint)
    monkeypatch.setitem(import_utils._require_package_cache, "rerun", True)
    monkeypatch.setenv("RERUN_FLUSH_NUM_BYTES", "8000")  # LeRobot sets it for good
    return SimpleNamespace(logged=logged, layouts=layouts)


def test_live_values_are_displayed(trained, viewer):
    """LeRobot lays the viewer out by the first tick's observation: what is missing then is never shown."""
    cli.main(["teleoperate", *shielded_options(trained, **OPERATOR, display_data="true")])
    (layout,) = viewer.layouts
    (curves,) = [view["contents"] for view in layout if view["name"] == "observation"]
    for name in ("value", "margin", "intervened"):
        path = f"observation.shield.{name}"
        values = [value for logged, value in viewer.logged if logged == path]
        assert path in curves and len(values) > 2 and np.isfinite(values[1:]).all()
    assert set(values[1:]) == {1.0}
    assert {"observation.front", "observation.wrist"} <= {view["name"] for view in layout}


def test_what_the_robot_clips_is_what_was_sent(robot, monkeypatch, virtual_time):
    sent, half = [], lambda action: {name: value / 2 for name, value in action.items()}
    monkeypatch.setattr(robot.inner, "send_action", lambda action: sent.append(action) or half(action))
    assert robot.take_sent() is None
    for _ in range(2):
        virtual_time.sleep(PERIOD)
        robot.get_observation()
        assert robot.send_action(PUSH) == half(PUSH)
        sent_now, decision = robot.take_sent()
        assert sent_now == half(PUSH) and torch.equal(decision.action, last(robot).action)
        assert robot.take_sent() is None
    assert sent == [PUSH, PUSH]


# -- plugins that change what lies between operator, robot and dataset ---


@dataclass
class Halve(RobotActionProcessorStep):
    """Halves every command."""

    def action(self, action):
        return {name: value / 2 for name, value in action.items()}

    def transform_features(self, features):
        return features


class Rename(Halve):
    """Stores commands of a tip, from which the robot's are found again, as in LeRobot's examples with a phone."""

    def action(self, action):
        return {f"tip_{name}": value for name, value in action.items()}

    def transform_features(self, features):
        return {**features, PipelineFeatureType.ACTION: self.action(features[PipelineFeatureType.ACTION])}


class NameBack(Halve):
    """The other half."""

    def action(self, action):
        return {name.removeprefix("tip_"): value for name, value in action.items()}


def halved(frame):
    return {**frame, "action": frame["action"] / 2}


def pipeline(step):
    return RobotProcessorPipeline(
        [step], to_transition=robot_action_observation_to_transition, to_output=transition_to_robot_action
    )


def alter(monkeypatch, how):
    """What a third-party plugin of LeRobot may replace at its import, so that commands are halved, or renamed."""
    loop, record, add = lerobot_record.record_loop, recording_verbs.record, LeRobotDataset.add_frame
    operator, robot, seen = make_default_processors()

    def looping(**changed):
        monkeypatch.setattr(lerobot_record, "record_loop", lambda **given: loop(**{**given, **changed}))

    if how == "processors of the operator":
        monkeypatch.setattr(lerobot_record, "make_default_processors", lambda: (pipeline(Halve()), robot, seen))
    elif how == "processors of the robot":
        monkeypatch.setattr(lerobot_record, "make_default_processors", lambda: (operator, pipeline(Halve()), seen))
    elif how == "the loop":
        looping(teleop_action_processor=pipeline(Halve()), robot_action_processor=pipeline(Halve()))
    elif how == "the command":
        monkeypatch.setattr(
            recording_verbs, "record", lambda cfg: record(cfg, robot_action_processor=pipeline(Halve()))
        )
    elif how == "names":
        both = pipeline(Rename()), pipeline(NameBack())
        monkeypatch.setattr(lerobot_record, "make_default_processors", lambda: (*both, seen))
    elif how == "the robot's names":
        looping(robot_action_processor=pipeline(Rename()))
    elif how == "the class of datasets":
        add_half = type("Theirs", (LeRobotDataset,), {"add_frame": lambda self, f: self.writer.add_frame(halved(f))})
        monkeypatch.setattr(lerobot_record, "LeRobotDataset", add_half)
    elif how == "frames that are stored already":

        def double_the_first(dataset, frame):
            add(dataset, frame)
            dataset.writer.episode_buffer["action"][0] *= 2

        monkeypatch.setattr(LeRobotDataset, "add_frame", double_the_first)
    elif how == "the dataset":
        monkeypatch.setattr(LeRobotDataset, "add_frame", lambda self, frame: add(self, halved(frame)))


@pytest.mark.parametrize(
    "how",
    [
        "processors of the operator",
        "processors of the robot",
        "the loop",
        "the command",
        "the dataset",
        "the class of datasets",
    ],
)
@pytest.mark.parametrize("epsilon", [ALWAYS, NEVER])
def test_whatever_a_plugin_changes_the_dataset_holds_what_the_robot_was_sent(
    tmp_path, monkeypatch, executed, how, epsilon
):
    alter(monkeypatch, how)
    trained = tiny.save_franka_filter(tmp_path / "filter", law_epsilon=epsilon)
    cli.main(["record", *recording(trained, tmp_path / "data")])
    stored = np.array(LeRobotDataset("me/shielded", root=tmp_path / "data").hf_dataset["action"])
    sent = np.array([[action[name] for name in ACTION_NAMES] for _, action in executed])
    assert all(min(np.abs(sent - row).max(1)) < 1e-6 for row in stored)
    assert np.abs(stored[: len(stored) // 2] - sent[: len(stored) // 2]).max() < 1e-6


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("names", "was to store tip_delta_x.*, and the robot was sent delta_x"),
        ("the robot's names", "held still.*Use a teleoperator that commands delta_x"),
        ("frames that are stored already", r"was to store \[.*\], and the robot was sent \["),
    ],
)
def test_a_recording_that_would_hold_something_else_is_refused(trained, tmp_path, monkeypatch, how, words):
    alter(monkeypatch, how)
    with pytest.raises(SystemExit, match=words):
        cli.main(["record", *recording(trained, tmp_path / "data")])


@pytest.mark.parametrize(("verb", "fps"), [("teleoperate", "--fps=60"), ("record", "--dataset.fps=30")])
def test_a_loop_of_another_rate_is_refused_before_anything_moves(trained, tmp_path, verb, fps):
    given = recording(trained, tmp_path / "data") if verb == "record" else options(trained, tmp_path)
    with pytest.raises(SystemExit, match="--fps=20"):
        cli.main([verb, *(option for option in given if "fps" not in option), fps])


def test_a_missing_filter_is_named(trained, tmp_path):
    given = [o for o in options(trained, tmp_path) if not o.startswith("--filter")]
    with pytest.raises(SystemExit, match="--filter"):
        cli.main(["teleoperate", *given, "--fps=20", "--teleop_time_s=0.5"])
