import numpy as np
import pytest

from lerobot_latentsafe.so101.actions import HIGH, LOW, NAMES, PITCH, REST, OutOfReachError, joints_for, read_targets
from lerobot_latentsafe.so101.operators import BEHAVIORS, begin
from lerobot_latentsafe.so101.scene import EDGE, MARKS, STARTS, PushScene
from lerobot_latentsafe.teleoperators.so101_leader import config_so101_leader


@pytest.fixture(scope="module")
def scene():
    return PushScene(32)


def play(scene, name, seed, **options):
    """An episode: whether it failed, whether it succeeded, and the targets (120, 6)."""
    scene.reset(seed)
    behavior, failed, targets = begin(name, scene, np.random.default_rng([0, seed]), **options), False, []
    for _ in range(120):
        targets.append(next(behavior, scene.targets))
        scene.step(targets[-1])
        failed |= scene.truth()["failure"]
    return failed, scene.truth()["is_success"] and not failed, np.array(targets)


def test_the_tip_comes_where_the_inverse_kinematics_says(scene):
    scene.reset(0)
    azimuth, distance, height = place = np.array([12.0, 0.20, 0.05])
    for _ in range(60):
        scene.step(np.append(joints_for(place, PITCH), [0.0, 0.0]))
    ahead = distance * np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))])
    np.testing.assert_allclose(scene.tip_position(), [*ahead, height], atol=5e-4)
    for tip in ([0, 0.5, 0.05], [0, 0.36, 0.1]):
        with pytest.raises(OutOfReachError, match="the tip cannot be 0"):
            joints_for(np.array(tip), PITCH)


def test_at_rest_the_arm_is_folded_far_from_zero_and_stays(scene):
    scene.reset(5)
    for _ in range(30):
        scene.step(REST)
    np.testing.assert_allclose(scene.proprioception(), REST, atol=0.05)
    assert REST[1] < -60 and REST[2] > 50


def test_the_arm_comes_after_its_targets_as_servos_do(scene):
    scene.reset(0)
    scene.step(REST + np.array([5.0, 0, 0, 0, 0, 0]))
    assert 0.5 < scene.proprioception()[0] < 3


def test_an_episode_depends_on_its_seed_alone(scene):
    starts = []
    for seed in range(20):
        scene.reset(seed)
        starts.append([*scene.cube_position(), scene.mark])
    scene.reset(0)
    assert [*scene.cube_position(), scene.mark] == starts[0]
    x, _, _, mark = np.array(starts).T
    assert STARTS[0] <= x.min() < x.max() <= STARTS[1] and MARKS[0] <= mark.min() < mark.max() <= MARKS[1]


def test_the_careful_succeed_and_the_reckless_fail_where_the_mark_is_near_the_edge(scene):
    careful = [play(scene, "careful", seed) for seed in range(8)]
    assert all(success and not failed for failed, success, _ in careful)
    fell, marks = [], []
    for seed in range(8):
        fell.append(play(scene, "reckless", seed)[0])
        marks.append(scene.mark)
    assert 2 <= sum(fell) <= 7
    assert min(np.array(marks)[fell]) > max(np.array(marks)[~np.array(fell)]) - 0.01


@pytest.mark.parametrize("name", BEHAVIORS)
def test_targets_are_joint_angles_of_the_arm_and_move_steadily(scene, name):
    targets = np.concatenate([play(scene, name, seed, interrupted=seed > 0)[2] for seed in range(2)])
    assert ((targets >= LOW - 3) & (targets <= HIGH)).all()
    assert np.abs(np.diff(targets[:120], axis=0)).max() < 25
    assert name in config_so101_leader.BEHAVIORS and set(BEHAVIORS) == set(config_so101_leader.BEHAVIORS)


def test_stopping_in_time_keeps_the_cube_on_the_table(scene):
    """What a filter can do: a hold after the mark, before the edge."""
    scene.reset(0)
    behavior = begin("reckless", scene, np.random.default_rng(0))
    while scene.cube_position()[0] < EDGE - 0.012:
        scene.step(next(behavior))
    held = scene.proprioception().astype(float)
    for _ in range(60):
        scene.step(held)
    assert not scene.truth()["failure"]


def test_broken_targets_are_refused_and_far_ones_clipped(caplog):
    still = dict(zip(NAMES, REST))
    assert read_targets(still).tolist() == REST.tolist()
    assert read_targets(still | {"shoulder_lift.pos": -300.0})[1] == LOW[1] and "clipped" in caplog.text
    for broken, message in (
        (still | {"gripper.pos": float("nan")}, r"non-finite values for gripper\.pos"),
        ({"shoulder_pan.pos": 0.0}, r"expected shoulder_pan\.pos, shoulder_lift\.pos"),
        ({}, r"names \(none\)"),
    ):
        with pytest.raises(ValueError, match=message):
            read_targets(broken)
    with pytest.raises(ValueError, match="image_size is 4; expected 16 to 1024"):
        PushScene(4)
