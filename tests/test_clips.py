"""Alignment of actions, images and labels, on a dataset whose entries count the frames."""

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.constraint_training import numbered
from lerobot_latentsafe.datasets.build_cache import build_frame_cache
from lerobot_latentsafe.datasets.labels import UnlabelledDatasetError
from lerobot_latentsafe.modeling_latentsafe import adopt

LENGTHS = (11, 9)
N = sum(LENGTHS)
FIRST = np.cumsum((0, *LENGTHS))


def record_counting(root, width=2):
    """Frame i shows the grey level 10 i, has state (i, -i), and the action taken after it is (100 + i, -i)."""
    names = ["count", "back"][:width]
    features = {
        "observation.image": {"dtype": "image", "shape": (8, 8, 3), "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": (width,), "names": [f"{name}.pos" for name in names]},
        "action": {"dtype": "float32", "shape": (width,), "names": [f"{name}.vel" for name in names]},
        "failure": {"dtype": "int64", "shape": (1,), "names": None},
        "next.done": {"dtype": "bool", "shape": (1,), "names": None},
    }
    dataset = LeRobotDataset.create("me/counting", 10, features, root=root, use_videos=False)
    i = 0
    for length in LENGTHS:
        for t in range(length):
            image = np.full((8, 8, 3), 10 * i, np.uint8)
            image[0, 0] = 255 - image[0, 0]
            dataset.add_frame(
                {
                    "observation.image": image,
                    "observation.state": np.array([i, -i][:width], np.float32),
                    "action": np.array([100 + i, -i][:width], np.float32),
                    "failure": np.array([i % 2]),
                    "next.done": np.array([t == length - 1]),
                    "task": "count",
                }
            )
            i += 1
        dataset.save_episode()
    dataset.finalize()
    return root


def reading(root, **sizes):
    """Reads clips of a counting dataset by the frame they start at; `.policy` is whom they are read for."""
    meta = tiny.metadata(root, "me/counting")
    world_model = tiny.rssm_config(image_size=8, **sizes)
    policy = tiny.new_policy(meta, world_model=world_model, fallback_action_candidates=None)
    windows = resolve_delta_timestamps(policy.config, meta)
    dataset = LeRobotDataset("me/counting", root=root, delta_timestamps=windows)

    def read(*starts):
        return policy.reader.read(torch.utils.data.default_collate([dataset[i] for i in starts]), policy.model)

    read.policy = policy
    return read


@pytest.fixture(scope="module")
def counting_root(tmp_path_factory):
    return record_counting(tmp_path_factory.mktemp("data") / "counting")


@pytest.fixture(scope="module", params=["decoded", "cached"])
def clip_at(request, counting_root, tmp_path_factory):
    root = counting_root
    if request.param == "cached":
        root = tmp_path_factory.mktemp("data") / "counting_cache"
        build_frame_cache(LeRobotDataset("me/counting", root=counting_root), root, 8)
    read = reading(root)
    assert (read.policy.reader.cache is not None) == (request.param == "cached")
    return read


def test_action_is_the_one_that_led_to_each_frame(clip_at):
    starts = [0, 2, FIRST[1], FIRST[1] + 1]
    clip, policy = clip_at(*starts), clip_at.policy
    for row, start in enumerate(starts):
        stored = 100.0 + start + np.arange(clip.action.shape[1]) - 1  # frame t + k comes after the action of t + k - 1
        expected = 2 * (stored - 100) / (N - 1) - 1
        np.testing.assert_allclose(clip.action[row, 1:, 0], expected[1:], atol=1e-5)
        np.testing.assert_allclose(clip.action[row, 1:, 1], -expected[1:], atol=1e-5)
        assert (clip.action[row, 0] == 0).all()
    taken = policy.model.units.denormalise_action(clip.action[0])[1:, 0]
    np.testing.assert_allclose(taken, 100 + np.arange(clip.action.shape[1] - 1), atol=1e-4)


def test_only_the_first_frame_of_a_clip_has_no_past(clip_at):
    clip = clip_at(0, 3)
    assert clip.is_first[:, 0].all() and not clip.is_first[:, 1:].any()


def test_images_states_and_labels_belong_to_the_same_frames(clip_at):
    clip, policy = clip_at(2, FIRST[1]), clip_at.policy
    for row, start in enumerate((2, FIRST[1])):
        frames = start + np.arange(8)
        np.testing.assert_allclose(clip.percepts["observation.image"][row, :, 0, 4, 4] * 255, 10 * frames, atol=1e-3)
        state = clip.state[row] * policy.model.units.state_std + policy.model.units.state_mean
        np.testing.assert_allclose(state[:, 0], frames, atol=1e-4)
        np.testing.assert_array_equal(clip.failure[row], frames % 2)
        np.testing.assert_array_equal(clip.terminal[row], np.isin(frames, FIRST[1:] - 1))


@pytest.mark.parametrize(("start", "inside"), [(0, 8), (3, 8), (4, 7), (10, 1), (N - 8, 8), (N - 3, 3), (N - 1, 1)])
def test_nothing_past_the_episodes_end_is_valid(clip_at, start, inside):
    clip = clip_at(start)
    assert clip.valid[0].tolist() == [True] * inside + [False] * (8 - inside)
    if inside < 8:  # padded with the last frame, not with the next episode
        last = start + inside - 1
        np.testing.assert_allclose(clip.percepts["observation.image"][0, inside:, 0, 4, 4] * 255, 10 * last, atol=1e-3)


def test_what_is_not_valid_is_not_learned_from(clip_at, monkeypatch):
    policy, clip = clip_at.policy.eval(), clip_at(int(FIRST[1]) - 3)
    losses = []
    for garbage in (0, 1):
        clip.failure = torch.where(clip.valid, clip.failure, garbage)
        clip.terminal = torch.where(clip.valid, clip.terminal, garbage)
        clip.state = torch.where(clip.valid[..., None], clip.state, float(garbage))
        monkeypatch.setattr(policy.reader, "read", lambda *_: clip)
        torch.manual_seed(0)
        losses.append(policy.forward({})[0].item())
    assert not clip.valid.all() and losses[0] == losses[1]


@pytest.mark.parametrize("cached", [False, True])
def test_every_third_frame_is_led_to_by_three_actions(counting_root, tmp_path, cached):
    root = counting_root
    if cached:
        root = tmp_path / "cache"
        build_frame_cache(LeRobotDataset("me/counting", root=counting_root), root, 8)
    read = reading(root, frame_skip=3, clip_length=4)
    clip, units = read(0, 1, int(FIRST[1]) + 3), read.policy.model.units
    assert clip.action.shape == (3, 4, 6) and clip.state.shape == (3, 4, 2)
    for row, start in enumerate((0, 1, int(FIRST[1]) + 3)):
        frames = [start + 3 * t for t in range(4)]
        inside = [f for f in frames if f < (FIRST[1] if start < FIRST[1] else N)]
        assert clip.valid[row].tolist() == [f in inside for f in frames]
        state = (clip.state[row] * units.state_std + units.state_mean)[: len(inside), 0]
        np.testing.assert_allclose(state, inside, atol=1e-4)
        pictures = clip.percepts["observation.image"][row, : len(inside), 0, 4, 4] * 255
        np.testing.assert_allclose(pictures, [10 * f for f in inside], atol=1e-3)
        for t, frame in enumerate(inside[1:], 1):  # the actions of the three frames before, the earliest first
            taken = units.denormalise_action(clip.action[row, t].view(3, 2))[:, 0]
            np.testing.assert_allclose(taken, [100 + frame - 3, 100 + frame - 2, 100 + frame - 1], atol=1e-4)
    assert (clip.action[:, 0] == 0).all()


def test_what_was_done_after_each_frame_stays_in_its_episode(counting_root):
    read = reading(counting_root, frame_skip=3, clip_length=4)
    recorded, units, end = read.policy.reader.recorded(), read.policy.model.units, int(FIRST[1])
    taken = units.denormalise_action(recorded.action.view(N, 3, 2))[..., 0]
    for frame, ticks, following in (
        (0, [0, 1, 2], 3),
        (end - 4, [end - 4, end - 3, end - 2], end - 1),
        (end - 2, [end - 2, end - 1, end - 1], end - 2),
        (end, [end, end + 1, end + 2], end + 3),
        (N - 1, [N - 1] * 3, N - 1),
    ):
        np.testing.assert_allclose(taken[frame], [100 + t for t in ticks], atol=1e-4)
        assert recorded.following[frame] == following


def test_a_failure_between_two_frames_counts(counting_root, tmp_path):
    build_frame_cache(LeRobotDataset("me/counting", root=counting_root), tmp_path / "cache", 8)
    reader = reading(tmp_path / "cache", frame_skip=3, clip_length=3).policy.reader
    failing = np.zeros(N, np.int64)
    failing[4] = 1  # between frames 3 and 6
    reader.labels = replace(reader.labels, failure=failing)
    clip = reader.cut(np.array([0, 1, 3, 5]))
    assert clip.failure.tolist() == [[0, 0, 1], [0, 1, 0], [0, 1, 0], [0, 0, 0]]


def test_numbers_in_place_of_labels_stay_those_of_their_frames(counting_root, tmp_path):
    build_frame_cache(LeRobotDataset("me/counting", root=counting_root), tmp_path / "cache", 8)
    reader = numbered(reading(tmp_path / "cache", frame_skip=3, clip_length=3).policy.reader)
    assert reader.cut(np.array([0, 1])).failure.tolist() == [[0, 3, 6], [1, 4, 7]]


def test_actions_and_states_are_scaled_by_the_datasets_range(clip_at):
    config = clip_at.policy.config
    assert (config.trained_on.action_low, config.trained_on.action_high) == ([100.0, 1.0 - N], [100.0 + N - 1, 0.0])
    assert config.trained_on.state_mean[0] == pytest.approx((N - 1) / 2)
    assert (config.trained_on.fps, config.trained_on.action_names, config.trained_on.state_names) == (
        10,
        ["count.vel", "back.vel"],
        ["count.pos", "back.pos"],
    )


def test_missing_camera_names_those_there_are(counting_root):
    meta = tiny.metadata(counting_root, "me/counting")
    config = tiny.config(trained_on_cameras=["observation.images.wrist"])
    with pytest.raises(ValueError, match=r"lacks the camera observation.images.wrist.*observation.image"):
        adopt(config, meta)


def test_robot_with_a_single_joint_is_decoded_too(tmp_path):
    """LeRobot drops the last axis of features of a single number."""
    clip = reading(record_counting(tmp_path / "single", width=1))(0, 2)
    assert clip.action.shape == clip.state.shape == (2, 8, 1)
    np.testing.assert_allclose(clip.action[1, 1:, 0], 2 * np.arange(2, 9) / (N - 1) - 1, atol=1e-5)


def test_unlabelled_dataset_is_refused_before_training(counting_root):
    meta = tiny.metadata(counting_root, "me/counting")
    with pytest.raises(UnlabelledDatasetError, match="column 'spilled'"):
        tiny.new_policy(meta, margin_failure_specification="spilled")
