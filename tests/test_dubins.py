import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from lerobot.envs import make_env, preprocess_observation

from lerobot_latentsafe import LatentSafeDubinsEnv
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.dubins.ground_truth import exact_value
from lerobot_latentsafe.envs.dubins_env import DubinsEnv


def command(turn_rate=0.0):
    return np.array([turn_rate, car.SPEED], np.float32)


def draw(x, y, heading, size=128):
    return car.Renderer(size)(np.array([[x, y, heading]]))[0]


def pixel_of(x, y, size=128):
    """(row, column) of a point in metres."""
    return int((car.VIEW - y) / (2 * car.VIEW) * size), int((x + car.VIEW) / (2 * car.VIEW) * size)


def test_euler_step_by_hand():
    after = car.step(np.array([0.2, -0.1, np.pi / 2]), 1.0)
    np.testing.assert_allclose(after, [0.2, -0.05, np.pi / 2 + 0.05], atol=1e-12)


def test_step_is_batched():
    states = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, np.pi]])
    expected = [[0.05, 0.0, 0.0625], [0.45, 0.5, np.pi - 0.0625]]
    np.testing.assert_allclose(car.step(states, np.array([1.25, -1.25])), expected, atol=1e-12)


def test_margin_is_squared_distance_beyond_the_radius():
    states = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 1.0], [0.6, 0.8, 1.0]])
    np.testing.assert_allclose(car.margin(states), [-0.25, 0.0, 0.75])


# -- renderer ---


def test_one_image_equals_the_same_image_of_a_batch():
    states = np.random.default_rng(0).uniform(-1.3, 1.3, (37, 3))
    renderer = car.Renderer()
    batch = renderer(states)
    for i in (0, 16, 36):
        np.testing.assert_array_equal(renderer(states[i : i + 1])[0], batch[i])


def test_car_is_blue_where_it_is():
    image = draw(0.7, 0.6, np.pi)
    assert tuple(image[pixel_of(0.7, 0.6)]) == (0, 0, 255)
    assert tuple(image[pixel_of(-0.7, -0.6)]) == (255, 255, 255)


def test_obstacle_is_a_red_ring():
    image = draw(0.9, 0.9, 0.0)
    row, column = pixel_of(-0.5, 0.0)
    assert image[row, column - 2 : column + 3, 1].min() < 80
    assert (image[row, column - 2 : column + 3, 0] == 255).all()
    assert tuple(image[pixel_of(0.0, 0.0)]) == (255, 255, 255)


def test_arrow_shows_the_heading():
    image = draw(0.0, 0.0, np.pi / 2)  # facing up: the first rows are at y = +VIEW
    assert tuple(image[pixel_of(0.0, 0.15)]) == (0, 0, 255)
    assert tuple(image[pixel_of(0.0, -0.15)]) == (255, 255, 255)
    assert np.abs(image.astype(int) - draw(0.0, 0.0, np.pi / 2 + 0.2)).sum() > 1000


def test_edges_are_anti_aliased():
    image = draw(0.813, -0.777, 0.3)
    car = image[..., 0]  # the ring leaves red at 255
    assert ((car > 20) & (car < 235)).sum() > 10


def test_movement_below_a_pixel_shows():
    assert (draw(0.0, 0.0, 0.0) != draw(0.004, 0.0, 0.0)).any()


@pytest.mark.parametrize("position", [(5.0, 0.0), (-3.0, 4.0), (0.0, -100.0), (1.14, 1.14)])
def test_car_out_of_view_is_drawn_without_error(position):
    image = draw(*position, 0.5)
    assert image.shape == (128, 128, 3)
    if max(np.abs(position)) > 2:
        assert (image[..., 0] == 255).all()


@pytest.mark.parametrize("size", [64, 224])
def test_other_sizes(size):
    image = draw(0.7, 0.6, np.pi, size)
    assert image.shape == (size, size, 3)
    assert tuple(image[pixel_of(0.7, 0.6, size)]) == (0, 0, 255)


# -- environment ---


@pytest.mark.parametrize("variant", DubinsEnv.variants)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_env_follows_the_gymnasium_api(variant):
    check_env(DubinsEnv(variant), skip_render_check=True)


def test_env_is_registered():
    env = gym.make("lerobot_latentsafe/Dubins-v0", variant="discrete")
    assert env.unwrapped.variant == "discrete"


def test_equal_seeds_give_equal_starts():
    first, second = DubinsEnv(), DubinsEnv("discrete")
    for seed in range(3):
        observation, info = first.reset(seed=seed)
        other, other_info = second.reset(seed=seed)
        np.testing.assert_array_equal(info["state"], other_info["state"])
        np.testing.assert_array_equal(observation["pixels"], other["pixels"])
    assert not np.array_equal(first.reset(seed=0)[1]["state"], first.reset(seed=1)[1]["state"])


@pytest.mark.parametrize("variant", DubinsEnv.variants)
def test_every_start_can_be_kept_safe(variant):
    env = DubinsEnv(variant)
    states = np.array([env.reset(seed=seed)[1]["state"] for seed in range(10)])
    assert (exact_value(states) > 0).all()


def test_discrete_variant_snaps_to_three_turn_rates():
    env = DubinsEnv("discrete")
    for asked, taken in ((0.6, 0.0), (0.7, 1.25), (-9.0, -1.25)):
        env.reset(seed=0, options={"state": (-0.9, 0.0, 0.0)})
        env.step(command(asked))
        assert env.state[2] == pytest.approx(taken * car.DT)


def test_continuous_variant_takes_any_turn_rate_within_limits():
    env = DubinsEnv()
    for asked, taken in ((0.6, 0.6), (3.0, 1.25)):
        env.reset(seed=0, options={"state": (-0.9, 0.0, 0.0)})
        env.step(command(asked))
        assert env.state[2] == pytest.approx(taken * car.DT)


def test_speed_is_held_whatever_is_asked():
    env = DubinsEnv()
    env.reset(options={"state": (-0.9, 0.0, 0.0)})
    env.step(np.array([0.0, 7.0]))
    assert env.state[0] == pytest.approx(-0.9 + car.DT * car.SPEED)


def test_unknown_variant_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"'sideways'.*continuous, discrete, anywhere"):
        DubinsEnv("sideways")


@pytest.mark.parametrize("action", [[np.nan, 1.0], [0.0, np.inf], [0.0], [0.0, 1.0, 0.0], []])
def test_bad_action_is_refused(action):
    env = DubinsEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="expected a finite turn rate"):
        env.step(np.array(action))


def test_success_is_arriving_without_a_violation():
    env = DubinsEnv()
    env.reset(options={"state": (0.87, 0.8, 0.0)})
    _, reward, terminated, truncated, info = env.step(command())
    assert (reward, terminated, truncated, info["is_success"], info["failure"]) == (1.0, True, False, True, False)


def test_a_violation_is_remembered_and_rules_success_out():
    env = DubinsEnv()
    env.reset(options={"state": (0.0, 0.45, 0.0)})
    violated, over = [], False
    while not over:
        _, reward, terminated, truncated, info = env.step(command())
        violated.append(info["failure"])
        over = terminated or truncated
    assert env.state[0] >= 0.9 and terminated
    assert all(violated) and not info["is_success"] and reward == 0.0
    assert info["margin"] > 0  # it has long left the disc


def test_leaving_the_view_ends_without_success():
    env = DubinsEnv()
    env.reset(options={"state": (-1.08, 0.0, np.pi)})
    _, reward, terminated, truncated, info = env.step(command())
    assert terminated and not truncated and reward == 0.0 and not info["is_success"]


def test_episode_is_truncated_at_its_length():
    env = DubinsEnv(episode_length=3)
    env.reset(options={"state": (-0.9, 0.8, 0.0)})
    assert [env.step(command())[3] for _ in range(3)] == [False, False, True]


def test_lerobot_makes_it_in_batches():
    config = LatentSafeDubinsEnv(variant="discrete", episode_length=5, image_size=64)
    env = next(iter(make_env(config, n_envs=2).values()))[0]
    observation, _ = env.reset(seed=[0, 1])
    batch = preprocess_observation(observation)
    assert batch["observation.image"].shape == (2, 3, 64, 64)
    assert batch["observation.image"].max() <= 1.0
    assert batch["observation.state"].shape == (2, 2)
    assert batch["observation.environment_state"].shape == (2, 2)
    env.step(np.stack([command(0.5), command(1.0)]))
    assert list(env.call("variant")) == ["discrete", "discrete"]
    assert set(config.features_map.values()) == {"action", *batch} - {"task"}
    env.close()
