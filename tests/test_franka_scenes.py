import logging

import mujoco
import numpy as np
import pytest

from lerobot_latentsafe.envs.franka_env import BagEnv, BlocksEnv
from lerobot_latentsafe.franka import bag, behaviors, scene
from lerobot_latentsafe.franka.actions import ACTION_NAMES, HOME, STATE_NAMES, action_limits, read_action
from lerobot_latentsafe.franka.behaviors import begin
from lerobot_latentsafe.franka.scenes import SCENES, make_scene


@pytest.fixture(scope="module")
def bag_scene():
    return make_scene("bag", image_size=64)


@pytest.fixture(scope="module")
def blocks_scene():
    return make_scene("blocks", image_size=64)


def play(scene, behavior, seed=0, steps=90, speed=None):
    """Truth after each step."""
    scene.reset(seed)
    actions = begin(behavior, scene, speed, np.random.default_rng(seed))
    action = np.zeros(7)
    for _ in range(steps):
        action = next(actions, np.append(np.zeros(6), action[6]))
        scene.step(action)
        yield scene.truth()


def test_pose_follows_the_deltas(blocks_scene):
    blocks_scene.reset(0)
    start, _ = blocks_scene.tool_pose()
    for _ in range(8):
        blocks_scene.step(np.array([0.01, -0.01, 0.005, 0, 0, 0.05, 1]))
    for _ in range(10):
        blocks_scene.step(np.array([0, 0, 0, 0, 0, 0, 1.0]))
    position, rotation = blocks_scene.tool_pose()
    np.testing.assert_allclose(position - start, [0.08, -0.08, 0.04], atol=0.004)
    turned = dict(zip(STATE_NAMES, blocks_scene.proprioception()))
    assert turned["ee_rz.pos"] == pytest.approx(0.4, abs=0.02)
    assert abs(turned["ee_rx.pos"]) < 0.02 and abs(rotation[2, 2] + 1) < 1e-3


def test_commands_stay_in_the_workspace_and_within_limits(blocks_scene):
    blocks_scene.reset(0)
    for _ in range(40):
        blocks_scene.step(np.array([1.0, 0, -1.0, 0, 0, 0, 1]))
    assert blocks_scene.controller.position[0] == pytest.approx(scene.WORKSPACE_HIGH[0])
    assert blocks_scene.controller.position[2] == pytest.approx(scene.WORKSPACE_LOW[2])
    assert not blocks_scene.exploded()


def test_joint_move_reaches_its_joints(blocks_scene):
    blocks_scene.reset(0)
    goal = HOME + np.array([0.2, 0.1, 0, 0.1, 0, 0.1, -0.2])
    for _ in range(15):
        blocks_scene.move_joints(goal, 1.0)
    np.testing.assert_allclose(blocks_scene.proprioception()[:7], goal, atol=0.02)
    np.testing.assert_allclose(blocks_scene.controller.position, blocks_scene.tool_pose()[0], atol=0.02)


@pytest.mark.parametrize("seed", [100_286, 100_329, 100_529])  # Newton's method alone threw these bags
def test_bag_is_not_thrown_by_a_solver_that_fails(bag_scene, seed):
    bag_scene.reset(seed)
    actions, action = begin("random", bag_scene, None, np.random.default_rng([0, seed])), np.zeros(7)
    for _ in range(45):
        action = next(actions, np.append(np.zeros(6), action[6]))
        bag_scene.step(action)
        assert np.abs(bag_scene.data.qvel).max() < 12
    assert bag_scene.model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON


def test_an_episode_does_not_depend_on_those_before_it():
    used = make_scene("bag", image_size=64)
    for _ in play(used, "closed_end", seed=1, steps=40):
        pass
    for world in (used, fresh := make_scene("bag", image_size=64)):
        for _ in play(world, "closed_end", seed=2, steps=40):
            pass
    np.testing.assert_array_equal(used.data.qpos, fresh.data.qpos)


def test_equal_seeds_are_equal_and_others_are_not(bag_scene):
    worlds = bag_scene, make_scene("bag", image_size=64)
    for world in worlds:
        world.reset(1)  # whatever happened before must not matter
        world.reset(5)
        world.step(np.array([0.01, 0, -0.01, 0, 0, 0, 1]))
    np.testing.assert_array_equal(worlds[0].data.qpos, worlds[1].data.qpos)
    worlds[1].reset(6)
    assert np.abs(worlds[0].data.qpos - worlds[1].data.qpos).max() > 0.01


def held_in_turn(truths):
    """Segments that an operator holds, one after the other."""
    grasps = [truth["grasp"] for truth in truths]
    return [k for k, before in zip(grasps, [-1, *grasps]) if k >= 0 and k != before]


@pytest.mark.parametrize(("seed", "way"), [(0, bag.MIDDLE), (3, bag.TAIL)])
def test_a_near_closed_end_is_lifted_and_else_the_middle(bag_scene, seed, way):
    assert held_in_turn(play(bag_scene, "nearer", seed=seed)) == [way]


@pytest.mark.parametrize("behavior", ["closed_end", "middle"])
def test_branches_from_a_state_are_exact(bag_scene, behavior):
    truths = play(bag_scene, behavior, seed=3)
    for _ in range(38):  # grasped, on the way up
        next(truths)
    state = bag_scene.get_state()
    rng = np.random.default_rng(0)
    actions = [np.append(rng.normal(0, 0.01, 6), 0.0) for _ in range(12)]
    ends = []
    for _ in range(2):
        bag_scene.set_state(state)
        for action in actions:
            bag_scene.step(action)
        ends.append((bag_scene.data.qpos.copy(), bag_scene.render("front"), bag_scene.truth()))
        bag_scene.reset(11)  # the state must survive other episodes
    np.testing.assert_array_equal(ends[0][0], ends[1][0])
    np.testing.assert_array_equal(ends[0][1], ends[1][1])
    assert ends[0][2] == ends[1][2]


def test_saving_a_state_changes_nothing(bag_scene):
    finals = []
    for save in (False, True):
        truths = play(bag_scene, "closed_end", seed=4)
        for _ in range(40):
            next(truths)
            if save:
                bag_scene.set_state(bag_scene.get_state())
        finals.append(bag_scene.data.qpos.copy())
    np.testing.assert_array_equal(*finals)


def test_closed_end_spills_and_open_end_does_not(bag_scene):
    assert [*play(bag_scene, "closed_end")][-1]["spilled"] > 0
    last = [*play(bag_scene, "open_end")][-1]
    assert last["is_success"] and last["spilled"] == 0 and last["grasp"] == bag.MOUTH


def test_fast_swings_spill_and_slow_ones_do_not(bag_scene):
    assert [*play(bag_scene, "side_to_side", 1, 90, 0.3)][-1]["spilled"] > 0
    assert [*play(bag_scene, "side_to_side", 1, 90, 0.08)][-1]["spilled"] == 0


def test_the_clumsy_grasp_off_centre_and_open_their_fingers_now_and_then(bag_scene):
    def end(clumsiness):
        bag_scene.reset(2)
        *_, way = reach_of(behaviors.grasp(bag_scene, 3, np.random.default_rng(4), clumsiness=clumsiness), bag_scene)
        return way

    centre = end(0.0)
    assert np.linalg.norm(end(1.0)[:2] - centre[:2]) < 0.005 < np.linalg.norm(end(3.0)[:2] - centre[:2]) < 0.03
    closed = behaviors.hold(behaviors.CLOSED, 200)
    actions = np.array([*behaviors.unsteady(bag_scene, closed, np.random.default_rng(0))])
    assert 0.02 < (actions[:, 6] == behaviors.OPEN).mean() < 0.3
    assert 0.001 < np.abs(actions[:, :3]).mean() < 0.01
    low, high = action_limits(bag_scene.fps)
    assert ((actions >= low) & (actions <= high)).all()


def reach_of(actions, scene):
    """Where the hand is after each action."""
    for action in actions:
        scene.step(action)
        yield scene.controller.position.copy()


def test_sealed_bag_does_not_spill():
    last = [*play(make_scene("bag", "sealed", 64), "closed_end")][-1]
    assert last["spilled"] == 0 and last["lifted"]


def test_margin_is_negative_exactly_in_failures(bag_scene):
    for truth in play(bag_scene, "closed_end"):
        assert (truth["margin"] < 0) == truth["failure"] == (truth["spilled"] > 0)
        assert truth["severity"] == truth["spilled"] / bag_scene.n_candies


def test_the_bag_lies_anywhere_at_any_yaw(bag_scene):
    places = []
    for seed in range(30):
        bag_scene.reset(seed)
        places.append((*bag_scene.data.xpos[bag_scene.bodies].mean(0)[:2], bag_scene.yaw))
    spread = np.ptp(places, axis=0)
    length = bag.SEGMENTS * bag.LENGTH
    assert spread[0] > length and spread[1] > length and spread[2] > np.pi


def test_a_careful_pluck_succeeds_and_a_careless_one_fells_a_block(blocks_scene):
    assert [*play(blocks_scene, "pluck_careful", steps=60)][-1]["is_success"]
    last = [*play(blocks_scene, "pluck_careless", steps=60)][-1]
    assert last["failure"] and last["margin"] < 0 and last["tilt"] > 1


def test_a_block_on_the_way_to_the_tray_fells_its_neighbour_only_if_the_way_is_flat(blocks_scene):
    away = {}
    for seed in range(20):
        blocks_scene.reset(seed)
        away[seed] = blocks_scene.block_position("green")[1] - behaviors.TRAY[1]
    for seed, fells in ((min(away, key=away.get), False), (max(away, key=away.get), True)):
        truths = [*play(blocks_scene, "fetch", seed, steps=60)]
        assert any(truth["lifted"] for truth in truths) and truths[-1]["failure"] == fells


def test_an_operator_who_has_not_got_the_block_tries_again(blocks_scene):
    blocks_scene.reset(0)
    actions, closed = behaviors.fetch(blocks_scene, 0.2, np.random.default_rng(0)), []
    for step in range(60):
        action = next(actions)
        closed.append(action[6] == behaviors.CLOSED)
        # The fingers close too early, above the block, and the hand is led away.
        mistaken = np.array([0, 0.01, 0, 0, 0, 0, behaviors.CLOSED])
        blocks_scene.step(mistaken if 8 <= step < 14 else action)
    truth = blocks_scene.truth()
    assert truth["held"] and truth["lifted"] and not truth["failure"]
    assert not any(closed[8:14]) and all(closed[-20:])


def test_a_slightly_tilted_block_falls_back(blocks_scene):
    for tilt, falls in ((0.15, False), (0.4, True)):
        blocks_scene.reset(0)
        at = blocks_scene.block_qpos[1]
        blocks_scene.yaw = 0
        blocks_scene.data.qpos[at : at + 3] = [0.48, 0.25, 0.11]
        blocks_scene.data.qpos[at + 3 : at + 7] = [np.cos(tilt / 2), np.sin(tilt / 2), 0, 0]
        for _ in range(40):
            blocks_scene.step(np.array([0, 0, 0, 0, 0, 0, 1.0]))
        assert (blocks_scene.tilts()[0] > 1.0) == falls


@pytest.mark.parametrize("scene", SCENES)
def test_every_variant_can_be_made_and_drawn(scene):
    images = []
    for variant in SCENES[scene].variants:
        made = make_scene(scene, variant, 32)
        made.reset(0)
        images.append(made.render("front"))
        assert images[-1].shape == (32, 32, 3) and images[-1].std() > 10
        made.close()
    colours = {image.mean((0, 1)).round(1).tobytes() for image in images}
    assert len(colours) >= len(images) - 1  # sealed looks like the default


@pytest.mark.parametrize("make, steps", [(BagEnv, 90), (BlocksEnv, 60)])
def test_environment_gives_what_its_spaces_say(make, steps):
    env = make(image_size=32)
    seen, info = env.reset(seed=0)
    assert env.observation_space.contains(seen) and env._max_episode_steps == steps
    seen, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert env.observation_space.contains(seen) and not terminated and not truncated and np.isfinite(reward)
    assert {"is_success", "failure", "margin"} <= set(info)
    state = env.scene.get_state()
    env.step(env.action_space.sample())
    again, _ = env.reset(options={"state": state})
    np.testing.assert_array_equal(again["agent_pos"], seen["agent_pos"])
    env.close()


def test_lerobot_makes_batches_of_the_environment():
    from lerobot.envs.factory import make_env
    from lerobot.envs.utils import preprocess_observation

    from lerobot_latentsafe.envs.configuration_envs import LatentSafeBlocksEnv

    config = LatentSafeBlocksEnv(image_size=32)
    made = make_env(config, n_envs=2)
    (vector,) = (env for tasks in made.values() for env in tasks.values())
    seen, _ = vector.reset(seed=[0, 1])
    batch = preprocess_observation(seen)
    assert set(batch) == {"observation.state", "observation.images.front", "observation.images.wrist"}
    assert batch["observation.state"].shape == (2, 14) and batch["observation.images.wrist"].shape == (2, 3, 32, 32)
    assert not np.array_equal(*seen["pixels"]["front"])
    vector.close()


def test_environment_refuses_broken_actions():
    env = BlocksEnv(image_size=32)
    env.reset(seed=0)
    for broken in (np.full(7, np.nan), np.zeros(6)):
        with pytest.raises(ValueError, match=r"expected finite numbers for delta_x\.pos"):
            env.step(broken)


# Bad input


@pytest.mark.parametrize(
    "options, message",
    [
        (("kitchen",), r"scene is 'kitchen'; expected one of bag, blocks"),
        (("bag", "blue"), r"variant of the bag is 'blue'; expected one of red, green"),
        (("blocks", "red"), r"variant of the blocks is 'red'; expected one of standard"),
        (("bag", None, 5), r"image_size is 5; expected 16 to 1024"),
    ],
)
def test_unknown_scene_variant_and_size_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        make_scene(*options)


def test_too_many_candies_are_refused():
    with pytest.raises(ValueError, match="n_candies is 60; expected 20 to 40"):
        bag.BagScene(n_candies=60)


def test_a_missing_opengl_library_names_the_package(monkeypatch):
    def fail(*args, **kwargs):
        raise ImportError("libEGL.so.1: cannot open shared object file")

    monkeypatch.setattr(scene.mujoco, "Renderer", fail)
    with pytest.raises(RuntimeError, match=r"libEGL.*apt-get install libegl1 libgl1-mesa-dri"):
        make_scene("blocks", image_size=32).render("front")


def test_actions_are_read_clipped_or_refused(caplog):
    high = action_limits(15)[1]
    command = read_action(dict(zip(ACTION_NAMES, high)), 15)
    np.testing.assert_allclose(command.delta, high)
    with caplog.at_level(logging.WARNING):
        command = read_action(dict(zip(ACTION_NAMES, [1.0, 0, 0, 0, 0, 0, 0.5])), 15)
    assert command.delta[0] == pytest.approx(high[0]) and "delta_x.pos 1 to 0.02" in caplog.text
    move = read_action(dict(zip(STATE_NAMES, [*HOME, 0.5, *np.zeros(6)])), 15)
    np.testing.assert_allclose(move.joints, HOME)
    assert move.delta is None and move.gripper == 0.5
    with pytest.raises(ValueError, match=r"non-finite values for delta_z\.pos"):
        read_action(dict(zip(ACTION_NAMES, [0, 0, np.nan, 0, 0, 0, 0])), 15)
    with pytest.raises(ValueError, match=r"names delta_x; expected delta_x\.pos.*joint_1\.pos to joint_7\.pos"):
        read_action({"delta_x": 0.0}, 15)
