"""What a filter would have decided by along recordings is what a shield in monitor mode decides by there."""

from functools import partial

import numpy as np
import pytest
import tiny
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.evaluation.along_episodes import values_along
from lerobot_latentsafe.evaluation.decision_values import decision_values
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.safety_model import UntrainedFilterError
from lerobot_latentsafe.shield import Shield
from lerobot_latentsafe.training import load_with_cache

WORLD_MODELS = {"rssm": tiny.rssm_config, "gru": tiny.gru_config, "dino_wm": tiny.dino_wm_config}
EPISODES = np.array([5, 2])


@pytest.fixture(scope="module")
def pictures(dataset_root):
    return LeRobotDataset(tiny.REPO_ID, root=dataset_root)


@pytest.fixture(params=[(kind, skip) for kind in WORLD_MODELS for skip in (1, 3)], ids=lambda p: f"{p[0]}, {p[1]}")
def untrained(request, cache_root, token_root):
    """A filter of each kind with random weights, as if trained, and the reader of a cache that it reads."""
    kind, skip = request.param
    meta = tiny.metadata(cache_root if kind == "rssm" else token_root)
    law = dict(law_proposal_steps=2, law_lookahead=3, law_history_frames=8, law_epsilon=0.1)
    policy = tiny.new_policy(meta, world_model=WORLD_MODELS[kind](frame_skip=skip, clip_length=5), **law).eval()
    policy.config.trained_on.stage = "critic"
    return policy.model, policy.reader


def test_they_are_those_of_a_shield_in_monitor_mode(untrained, pictures, dataset_meta, monkeypatch):
    model, reader = untrained
    found = decision_values(model, reader, EPISODES)
    assert [row.episode for row in found] == EPISODES.tolist()
    model.config.change(law=model.config.law.changed(LawOptions(mode="monitor")))
    shield, names = Shield(model, clock=standing_still), model.world_model.percept_names
    for row in found:
        shield.reset()
        start = dataset_meta.episodes[row.episode]["dataset_from_index"]
        for t, (value, margin) in enumerate(zip(row.value, row.margin)):
            frame = pictures[start + t]
            cached, _ = reader.cache.frames(np.array([start + t]), names)
            # an encoder's tokens and pictures of 8 bits are a little rounded in a cache
            monkeypatch.setattr(model.world_model, "perceive", lambda _, cached=cached: cached)
            decision = shield({k: frame[k][None] for k in ("observation.image", "observation.state")},
                              frame["action"][None])  # fmt: skip
            assert decision.reason.item() <= 1 and not decision.intervened.any()  # no fault is in the way
            np.testing.assert_allclose(decision.value.item(), value, atol=1e-5)
            np.testing.assert_allclose(decision.margin.item(), margin, atol=1e-5)
        np.testing.assert_array_equal(row.failure, reader.labels.failure[reader.labels.episode == row.episode])
    assert len({len(row.value) for row in found}) > 1  # of different lengths, side by side


def test_it_does_not_matter_what_is_judged_side_by_side(tiny_filter, cache_meta):
    policy, reader = load_with_cache(tiny_filter, cache_meta)
    judged = partial(decision_values, policy.model, reader)
    together = judged(EPISODES)
    for row in together:
        (alone,) = judged(np.array([row.episode]))
        np.testing.assert_allclose(alone.value, row.value, atol=1e-5)


def test_the_margin_is_that_of_decoded_pictures(tiny_filter, cache_meta, dataset_meta):
    policy, reader = load_with_cache(tiny_filter, cache_meta)
    (row,) = decision_values(policy.model, reader, EPISODES[:1])
    seen = values_along(policy.model, DatasetFrames(dataset_meta, [row.episode]), row.episode)
    np.testing.assert_allclose(row.margin, seen.margin, atol=1e-2)


def test_what_was_done_is_remembered_whatever_the_filter_would_do(tiny_filter, cache_meta):
    """A filter that would override everything foresees the same of a recording."""
    policy, reader = load_with_cache(tiny_filter, cache_meta)
    (passes,) = decision_values(policy.model, reader, EPISODES[:1])
    policy.config.change(law=policy.config.law.changed(LawOptions(epsilon=0.99, resume_above=0.999)))
    (overrides,) = decision_values(policy.model, reader, EPISODES[:1])
    np.testing.assert_array_equal(passes.value, overrides.value)


def test_numbers_that_mean_nothing_give_no_value(tiny_filter, cache_meta):
    policy, reader = load_with_cache(tiny_filter, cache_meta)
    torch.nn.init.constant_(policy.model.margin.net[-1].bias, torch.nan)
    (row,) = decision_values(policy.model, reader, EPISODES[:1])
    assert np.isnan(row.value).all()


def test_a_guard_has_no_value(tiny_filter, cache_meta):
    policy, reader = load_with_cache(tiny_filter, cache_meta)
    policy.config.change(law=policy.config.law.changed(LawOptions(name="guard")))
    with pytest.raises(ValueError, match="law has no V"):
        decision_values(policy.model, reader, EPISODES[:1])


def test_an_untrained_critic_has_no_value(tiny_world_model, cache_meta):
    policy, reader = load_with_cache(tiny_world_model, cache_meta)
    with pytest.raises(UntrainedFilterError, match="train-reachability"):
        decision_values(policy.model, reader, EPISODES[:1])
