import json

import numpy as np
import pyarrow.parquet as pq
import pytest
import tiny
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_latentsafe.collection.dubins import SOURCES, WITH_POSITION, collect_dubins
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.dubins.ground_truth import exact_value
from lerobot_latentsafe.envs.dubins_env import DubinsEnv


def episodes(source, n=6, seed=0):
    return list(SOURCES[source](n, np.random.default_rng(seed)))


@pytest.fixture(scope="module")
def frames(dataset_root):
    files = sorted(dataset_root.glob("data/*/*.parquet"))
    return {
        name: np.concatenate([np.asarray(pq.read_table(f)[name].to_pylist()) for f in files])
        for name in ("observation.state", "action", "failure", "next.done", "episode_index", "index")
    }


@pytest.fixture(scope="module")
def recorded():
    """The episodes that `dataset_root` was recorded from."""
    return episodes("random", 14, seed=3)


def test_labels_are_the_sign_of_the_margin(frames, recorded):
    states = np.concatenate([e.states for e in recorded])
    np.testing.assert_array_equal(frames["failure"].reshape(-1), car.margin(states) < 0)
    assert 0 < frames["failure"].mean() < 1


def test_frames_hold_headings_and_the_action_taken_after_them(frames, recorded):
    states = np.concatenate([e.states for e in recorded])
    headings = np.stack([np.cos(states[:, 2]), np.sin(states[:, 2])], -1)
    np.testing.assert_allclose(frames["observation.state"], headings, atol=1e-6)
    np.testing.assert_allclose(frames["action"][:, 0], np.concatenate([e.turn_rates for e in recorded]))
    for episode in recorded:
        np.testing.assert_allclose(car.step(episode.states[:-1], episode.turn_rates[:-1]), episode.states[1:])


def test_images_are_what_the_environment_shows(dataset_root, recorded):
    dataset = LeRobotDataset(tiny.REPO_ID, root=dataset_root)
    states = np.concatenate([e.states for e in recorded])
    for i in (0, len(states) // 2):
        env = DubinsEnv()
        seen, _ = env.reset(options={"state": states[i]})
        stored = (dataset[i]["observation.image"] * 255).round().numpy().astype(np.uint8)
        np.testing.assert_array_equal(stored.transpose(1, 2, 0), seen["pixels"])


def test_done_marks_the_last_frame_of_episodes_that_end_by_themselves(frames, recorded):
    last = np.cumsum([len(e.states) for e in recorded]) - 1
    assert set(np.flatnonzero(frames["next.done"])) == {int(i) for i, e in zip(last, recorded) if e.ended}


def test_labels_are_no_policy_feature(dataset_meta):
    assert set(dataset_to_policy_features(dataset_meta.features)) == {
        "observation.image",
        "observation.state",
        "action",
    }


@pytest.mark.parametrize("policy_type", ["diffusion", "act", "latentsafe"])
def test_no_policy_reads_or_writes_the_labels(dataset_meta, policy_type):
    from lerobot.datasets.factory import resolve_delta_timestamps
    from lerobot.policies.factory import make_policy, make_policy_config

    options = {"diffusion": {"down_dims": (16, 32)}, "act": {"dim_model": 32, "dim_feedforward": 32, "n_heads": 2}}
    config = make_policy_config(policy_type, device="cpu", push_to_hub=False, **options.get(policy_type, {}))
    if policy_type == "latentsafe":
        config = tiny.config()
    else:
        config.pretrained_backbone_weights = None
    make_policy(config, ds_meta=dataset_meta)
    read = {*config.input_features, *config.output_features, *resolve_delta_timestamps(config, dataset_meta)}
    assert read == {"observation.image", "observation.state", "action"}


def test_labels_do_not_pass_a_policys_preprocessor(dataset_root):
    from lerobot_latentsafe.processor_latentsafe import make_latentsafe_pre_post_processors

    item = LeRobotDataset(tiny.REPO_ID, root=dataset_root)[0]
    assert "failure" in item
    preprocessor, _ = make_latentsafe_pre_post_processors(tiny.config())
    assert not [key for key in preprocessor(item) if "failure" in key]


def test_random_source_uses_the_three_actions():
    rates = np.concatenate([e.turn_rates for e in episodes("random")])
    assert set(rates) == set(car.TURN_RATES)


def test_left_only_source_never_turns_right():
    rates = np.concatenate([e.turn_rates for e in episodes("random_left_only")])
    assert set(rates) == {0.0, car.MAX_TURN_RATE}


def test_continuous_source_covers_the_range():
    rates = np.concatenate([e.turn_rates for e in episodes("random_continuous", 20)])
    assert len(np.unique(rates)) > 50
    assert rates.min() < -1.0 and rates.max() > 1.0 and np.abs(rates).max() <= car.MAX_TURN_RATE


def test_careful_source_stays_safe_and_reckless_does_not():
    careful, reckless = episodes("careful", 15), episodes("reckless", 15)
    assert not any((car.margin(e.states) < 0).any() for e in careful)
    assert np.mean([(car.margin(e.states) < 0).any() for e in reckless]) > 0.3
    assert all(exact_value(e.states[:1])[0] > 0 for e in careful + reckless)


def test_equal_seeds_record_equal_episodes():
    for source in SOURCES:
        first, second = episodes(source, 2, seed=5), episodes(source, 2, seed=5)
        for a, b in zip(first, second):
            np.testing.assert_array_equal(a.states, b.states)


def test_names_of_sources():
    assert list(SOURCES) == [
        "random", "random_located", "random_continuous", "random_left_only", "careful", "reckless",
    ]  # fmt: skip


def test_demonstrations_also_store_the_position(tmp_path):
    dataset = collect_dubins("reckless", "me/demo", tmp_path / "demo", n_episodes=1, seed=0)
    assert "reckless" in WITH_POSITION
    assert dataset.features["observation.environment_state"]["names"] == ["x.pos", "y.pos"]
    info = json.loads((tmp_path / "demo" / "meta" / "info.json").read_text())
    assert info["fps"] == car.FPS and info["robot_type"] == "latentsafe_dubins"


def test_unknown_source_lists_the_known_ones(tmp_path):
    with pytest.raises(ValueError, match=r"--source is 'brave'.*random.*careful.*reckless"):
        collect_dubins("brave", "me/x", tmp_path / "x", 1, 0)


def test_existing_folder_is_left_alone(tmp_path):
    (tmp_path / "precious").write_text("data")
    with pytest.raises(FileExistsError, match=r"another --dataset\.root"):
        collect_dubins("random", "me/x", tmp_path, 1, 0)
    assert (tmp_path / "precious").read_text() == "data"
