"""Frames that stand in for what a world model cannot draw."""

import numpy as np
import pytest
import tiny
import torch

from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.evaluation.nearest_frames import Album

CAMERA = "observation.image"


@pytest.fixture(params=[tiny.gru_config, tiny.dino_wm_config], ids=["gru", "dino_wm"])
def policy(request, token_root):
    made = tiny.new_policy(tiny.metadata(token_root), world_model=request.param(), action_candidates=None)
    made.config.stage = "world_model"
    return made.eval()


@torch.no_grad()
def test_the_frame_nearest_to_what_was_seen_is_that_frame(policy, dataset_meta):
    album, frames = Album(policy), DatasetFrames(dataset_meta)
    album.add_dataset(frames)
    assert len(album) == dataset_meta.total_frames
    pictures, state = frames.images(CAMERA, 3), frames.columns(3, ["observation.state"])["observation.state"]
    for t in (0, 4):
        image = torch.from_numpy(pictures[t : t + 1]).permute(0, 3, 1, 2)
        percepts = policy.world_model.perceive({CAMERA: policy.model_images(image)})
        seen = policy.normalise_state(torch.from_numpy(state[t : t + 1]))
        assert np.array_equal(album.nearest(policy.world_model.observe(None, None, percepts, seen)), pictures[t])


def test_large_datasets_are_sampled(policy, dataset_meta, monkeypatch):
    monkeypatch.setattr("lerobot_latentsafe.evaluation.nearest_frames.EPISODES", 3)
    monkeypatch.setattr("lerobot_latentsafe.evaluation.nearest_frames.FRAMES", 30)
    album = Album(policy)
    album.add_dataset(DatasetFrames(dataset_meta))
    assert 3 <= len(album) <= 60


def test_dataset_of_another_robot_is_refused(policy, dataset_meta):
    policy.config.fps = 10
    with pytest.raises(ValueError, match="fps"):
        Album(policy).add_dataset(DatasetFrames(dataset_meta))


def test_empty_album_is_a_message(policy):
    with pytest.raises(ValueError, match="no frames to choose from"):
        Album(policy).nearest(policy.world_model.initial(1))
