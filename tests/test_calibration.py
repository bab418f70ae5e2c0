import numpy as np
import pytest
import tiny
import torch

from lerobot_latentsafe.calibration import calibrate, episode_values, store
from lerobot_latentsafe.cli import train
from lerobot_latentsafe.cli.options import DatasetSource, PolicySource
from lerobot_latentsafe.cli.train import Calibrate
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.safety_model import UntrainedFilterError
from lerobot_latentsafe.training import load_with_cache


def failing(values, first_failure):
    """An episode that fails from a frame on."""
    failure = np.zeros(len(values), int)
    failure[first_failure:] = 1
    return {"value": np.array(values), "failure": failure}


def safe(*values):
    return {"value": np.array(values), "failure": np.zeros(len(values), int)}


FAILING = failing([0.9, 0.5, 0.3, 0.1, -0.4, -0.5], first_failure=4)


def test_epsilon_is_the_smallest_that_warns_in_time():
    # with two frames of warning, frames 0 to 2 count: V falls to 0.3 there
    found = calibrate([FAILING, safe(0.2, 0.31, 0.8, 0.9)], lead_steps=2)
    assert found.epsilon == pytest.approx(0.3)
    assert (found.missed, found.false_alarms) == (0.0, 0.25)
    assert (found.failing_episodes, found.safe_frames, found.lead_steps) == (1, 4, 2)


def test_longer_warning_asks_for_a_larger_epsilon():
    rows = [FAILING, safe(1.0)]
    assert [calibrate(rows, lead_steps=n).epsilon for n in (1, 2, 3)] == pytest.approx([0.1, 0.3, 0.5])


def test_epsilon_is_never_negative():
    assert calibrate([failing([0.2, -0.3, -0.4], 2), safe(0.5)], lead_steps=1).epsilon == 0.0


def test_allowed_misses_leave_the_hardest_episodes_out():
    rows = [failing([v, v, v, v, -1.0], 4) for v in np.linspace(0.1, 1.0, 10)]
    found = calibrate([*rows, safe(2.0)], max_missed=0.2, lead_steps=1)
    assert found.epsilon == pytest.approx(0.8) and found.missed == pytest.approx(0.2)


def test_episodes_that_fail_at_once_do_not_count():
    at_once = failing([0.9, 0.9, 0.9, 0.9], first_failure=1)
    found = calibrate([at_once, FAILING, safe(1.0)], lead_steps=3)
    assert found.failing_episodes == 1


@pytest.mark.parametrize("rows", [[FAILING], [safe(1.0)], []], ids=["no safe", "no failing", "none"])
def test_one_kind_of_episode_is_not_enough(rows):
    with pytest.raises(ValueError, match=r"calibration needs both.*--n_episodes"):
        calibrate(rows)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("which", [0, 1], ids=["failing", "safe"])
@pytest.mark.fault("N05", "calibrate on values that are NaN", "Refused, with how many")
def test_a_value_that_is_not_finite_is_no_warning_and_no_silence(value, which):
    rows = [FAILING, safe(0.2, 0.9), safe(0.5)]
    rows[which] = {**rows[which], "value": np.append(rows[which]["value"][:-1], value)}
    with pytest.raises(ValueError, match="V is not finite in 1 of 3 held-out episodes"):
        calibrate(rows)


NONSENSE = [
    *(({"max_missed": value}, f"--max_missed is {value}; expected a share") for value in (1, 1.0, 1.5, -0.1, np.nan)),
    *(({"lead_steps": value}, f"--lead_steps is {value}; expected at least 1") for value in (0, -3)),
]


@pytest.mark.parametrize("options, message", NONSENSE)
@pytest.mark.fault("N05", "calibrate with nonsensical options", "Refused, with what was expected")
def test_options_that_mean_nothing_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        calibrate([FAILING, safe(1.0)], **options)
    with pytest.raises(ValueError, match=message):
        Calibrate(PolicySource("no/such"), "out", **options)


def test_a_calibration_that_breaks_off_leaves_no_filter(tiny_filter, cache_root, tmp_path, monkeypatch):
    def killed(*given):
        raise KeyboardInterrupt

    command = Calibrate(PolicySource(str(tiny_filter)), tmp_path / "out", DatasetSource(tiny.REPO_ID, str(cache_root)))
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(train, "store", killed)
        command.run()
    assert not any(tmp_path.iterdir())


def test_values_along_episodes_are_those_of_filtering(tiny_filter, cache_meta):
    policy, reader = load_with_cache(tiny_filter, cache_meta)
    rows = episode_values(policy.model, reader, np.array([2, 5]))
    length = policy.config.world_model.clip_length
    for episode, row in zip((2, 5), rows):
        index = np.flatnonzero(reader.labels.episode == episode)
        assert len(row["value"]) == len(index)
        np.testing.assert_array_equal(row["failure"], reader.labels.failure[index])
        clip = reader.cut(index[:1], policy.model.world_model)
        encoded = {key: value[0] for key, value in policy.model.world_model.encode(clip).items()}
        np.testing.assert_allclose(row["value"][:length], policy.model.value(encoded).detach(), atol=1e-5)


def test_evidence_is_kept_in_the_config(policy):
    store(policy.config, calibrate([FAILING, safe(1.0)], lead_steps=2))
    assert policy.config.law.epsilon == pytest.approx(0.3)
    assert policy.config.calibration["failing_episodes"] == 1.0


def test_command_writes_a_filter_with_epsilon_and_evidence(tiny_filter, cache_root, tmp_path):
    dataset = DatasetSource(tiny.REPO_ID, str(cache_root))
    Calibrate(PolicySource(str(tiny_filter)), tmp_path / "out", dataset, max_missed=0.99).run()
    config = LatentSafePolicy.from_pretrained(tmp_path / "out").config
    assert config.calibration["epsilon"] == config.law.epsilon and config.trained_on.stage == "critic"
    assert config.frame_cache is None  # a folder of this machine has no business in a checkpoint


def test_dataset_of_another_rate_is_refused(tiny_filter, cache_root, tmp_path):
    other = tiny.altered_dataset(cache_root, tmp_path / "other", fps=30)
    with pytest.raises(ValueError, match="fps = 30, this filter was trained with 20"):
        Calibrate(PolicySource(str(tiny_filter)), tmp_path / "out", DatasetSource("me/other", str(other.root))).run()


def test_dataset_without_a_cache_is_refused(tiny_filter, dataset_root, tmp_path):
    with pytest.raises(ValueError, match="run latentsafe cache"):
        Calibrate(PolicySource(str(tiny_filter)), tmp_path / "o", DatasetSource(tiny.REPO_ID, str(dataset_root))).run()


def test_untrained_critic_cannot_be_calibrated(tiny_world_model, cache_root, tmp_path):
    dataset = DatasetSource(tiny.REPO_ID, str(cache_root))
    with pytest.raises(UntrainedFilterError):
        Calibrate(PolicySource(str(tiny_world_model)), tmp_path / "out", dataset).run()


def test_episodes_start_with_the_grip_they_had(cache_meta):
    """A kept command has no zero to start from: calibration and training begin an episode alike."""
    policy = tiny.new_policy(cache_meta, fallback_action_candidates=None, fallback_frozen_commands=["turn_rate.vel"])
    policy.config.law.name = "margin"
    policy.config.trained_on.stage = "world_model"
    index = np.flatnonzero(policy.reader.labels.episode == 2)
    clip = policy.reader.cut(index[:1], policy.model.world_model, length=len(index))
    assert clip.action[0, 0, 0] == pytest.approx(
        policy.model.units.normalise_action(torch.from_numpy(policy.reader.cache.action[index[:1]]))[0, 0].item()
    )
    margin = policy.model.imagination.margin(policy.model.world_model.encode(clip))[0]
    row = episode_values(policy.model, policy.reader, np.array([2]))[0]
    np.testing.assert_allclose(row["value"], margin.detach(), atol=1e-6)
