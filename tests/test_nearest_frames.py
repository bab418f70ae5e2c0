"""Frames that stand in for what a world model cannot draw."""

import numpy as np
import pytest
import tiny
import torch

from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.evaluation.nearest_frames import NearestFrames

CAMERA = "observation.image"


@pytest.fixture(params=[tiny.gru_config, tiny.dino_wm_config], ids=["gru", "dino_wm"])
def policy(request, token_root):
    made = tiny.new_policy(tiny.metadata(token_root), world_model=request.param(), fallback_action_candidates=None)
    made.config.trained_on.stage, made.model.has_fresh_weights = "world_model", False
    return made.eval()


@torch.no_grad()
def test_the_frame_nearest_to_what_was_seen_is_that_frame(policy, dataset_meta):
    frames_seen, frames = NearestFrames(policy.model), DatasetFrames(dataset_meta)
    frames_seen.add_dataset(frames)
    assert len(frames_seen) == dataset_meta.total_frames
    pictures, state = frames.images(CAMERA, 3), frames.columns(3, ["observation.state"])["observation.state"]
    for t in (0, 4):
        image = torch.from_numpy(pictures[t : t + 1]).permute(0, 3, 1, 2)
        percepts = policy.model.world_model.perceive({CAMERA: policy.model.images(image)})
        seen = policy.model.units.normalise_state(torch.from_numpy(state[t : t + 1]))
        assert np.array_equal(
            frames_seen.nearest(policy.model.world_model.observe(None, None, percepts, seen)), pictures[t]
        )


def test_large_datasets_are_sampled(policy, dataset_meta, monkeypatch):
    monkeypatch.setattr("lerobot_latentsafe.evaluation.nearest_frames.EPISODES", 3)
    monkeypatch.setattr("lerobot_latentsafe.evaluation.nearest_frames.FRAMES", 30)
    frames_seen = NearestFrames(policy.model)
    frames_seen.add_dataset(DatasetFrames(dataset_meta))
    assert 3 <= len(frames_seen) <= 60


def test_dataset_of_another_robot_is_refused(policy, dataset_meta):
    policy.config.trained_on.fps = 10
    with pytest.raises(ValueError, match="fps"):
        NearestFrames(policy.model).add_dataset(DatasetFrames(dataset_meta))


def test_empty_frames_seen_is_a_message(policy):
    with pytest.raises(ValueError, match="no frames to choose from"):
        NearestFrames(policy.model).nearest(policy.model.world_model.initial(1))
