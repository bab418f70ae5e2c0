"""World models whose step is several ticks: what is judged along episodes, and remembered at deployment, agree."""

import numpy as np
import pytest
import tiny
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.evaluation.along_episodes import encode_episodes, values_along
from lerobot_latentsafe.evaluation.decision_values import decision_values
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.shield import Shield
from lerobot_latentsafe.training import load_with_cache, train_margin, train_reachability

SKIP, EPISODE = 3, 2


@pytest.fixture(scope="module")
def skipping(cache_meta, tmp_path_factory):
    """Folder of a filter whose world model sees every third frame, trained by all stages."""
    folder = tmp_path_factory.mktemp("skipping")
    tiny.train_stage_one(
        cache_meta, folder / "world_model", world_model=tiny.rssm_config(frame_skip=SKIP, clip_length=5)
    )
    train_margin(folder / "world_model", cache_meta, folder / "margin")
    train_reachability(folder / "margin", cache_meta, folder / "filter")
    return folder / "filter"


def test_the_filter_remembers_what_episodes_are_judged_by(skipping, dataset_root, dataset_meta):
    """The beliefs of a shield, tick by tick, are the latents along the episode, whichever frame they began with."""
    model = load_filter(skipping).model
    encoded, (length,) = encode_episodes(model, DatasetFrames(dataset_meta, [EPISODE]), [EPISODE])
    shield = Shield(model, clock=standing_still)
    dataset = LeRobotDataset(tiny.REPO_ID, root=dataset_root)
    start = dataset_meta.episodes[EPISODE]["dataset_from_index"]
    for t in range(length):
        frame = dataset[start + t]
        seen = {key: frame[key][None] for key in ("observation.image", "observation.state")}
        shield(seen, frame["action"][None])
        shield.was_executed(frame["action"][None])
        for name, values in encoded.items():
            torch.testing.assert_close(shield.latent[name][0], values[0, t], atol=1e-4, rtol=1e-4)
    assert encoded["action"].shape[-1] == SKIP * tiny.ACTION_DIM and length > 2 * SKIP


def test_margins_of_cached_and_of_decoded_episodes_agree(skipping, cache_meta, dataset_meta):
    policy, reader = load_with_cache(skipping, cache_meta)
    (row,) = decision_values(policy.model, reader, np.array([EPISODE]))
    found = values_along(policy.model, DatasetFrames(dataset_meta, [EPISODE]), EPISODE)
    assert len(row.margin) == dataset_meta.episodes[EPISODE]["length"]
    np.testing.assert_allclose(row.margin, found.margin, atol=1e-4)


@pytest.mark.parametrize(("ticks", "steps"), [(1, 1), (3, 1), (4, 2), (15, 5)])
def test_ticks_of_the_law_are_steps_of_the_model(skipping, monkeypatch, ticks, steps):
    policy = load_filter(skipping, law=LawOptions(proposal_steps=ticks, lookahead=0))
    taken, step = [], policy.model.world_model.step
    monkeypatch.setattr(policy.model.world_model, "step", lambda z, a: (taken.append(a.shape[1]), step(z, a))[1])
    Shield(policy.model, clock=standing_still)(tiny.observation([[-0.9, 0.1, 0.0]]), torch.tensor([[0.3, 1.0]]))
    assert taken == [SKIP * tiny.ACTION_DIM] * (1 + steps)  # one to take in what is seen


def test_a_step_hears_what_is_to_come_and_holds_what_is_not_known(skipping, monkeypatch):
    """Of a chunk two actions are heard beside the proposal, of a shorter one the last for the rest of the step."""
    policy = load_filter(skipping, law=LawOptions(proposal_steps=SKIP, lookahead=0))
    seen, heard, step = tiny.observation(np.array([[-0.9, 0.1, 0.0]])), [], type(policy.model.world_model).step
    monkeypatch.setattr(type(policy.model.world_model), "step", lambda self, z, a: heard.append(a) or step(self, z, a))
    first, second, third = (torch.tensor([[turn, 1.0]]) for turn in (0.1, -0.2, 0.3))
    unknown, far = torch.full_like(first, torch.nan), torch.full_like(first, 99.0)
    table = (
        (None, (first, first, first)),
        ([second, third, far], (first, second, third)),
        ([second], (first, second, second)),
        ([unknown, third], (first, first, first)),
    )
    for coming, expected in table:
        policy.reset()
        heard[:] = []
        coming = None if coming is None else torch.stack(coming, 1)
        policy.shield(seen, first, coming=coming)
        wanted = policy.model.units.heard_action(torch.stack(expected, 1)).flatten(1)
        torch.testing.assert_close(heard[1][:1], wanted)
    for wrong in (torch.zeros(1, 2, 7), torch.zeros(2, 2, tiny.ACTION_DIM), first, [[0.0, 1.0]]):
        policy.reset()
        heard[:] = []
        policy.shield(seen, first, coming=wrong)
        torch.testing.assert_close(heard[1][:1], policy.model.units.heard_action(first).repeat(1, SKIP))
    policy.reset()
    heard[:] = []
    policy.shield(seen, far, coming=torch.stack([second, third], 1))  # what is wrong is not judged, but to stay
    assert torch.equal(heard[1][0, : tiny.ACTION_DIM], heard[1][0, -tiny.ACTION_DIM :])


def test_episodes_shorter_than_a_step_are_refused(cache_meta):
    with pytest.raises(ValueError, match=r"frame_skip is 1000, and the longest episode has \d+ frames"):
        tiny.new_policy(cache_meta, world_model=tiny.rssm_config(frame_skip=1000))


def test_no_skip_below_one_tick():
    with pytest.raises(ValueError, match="frame_skip is 0; expected at least 1"):
        tiny.rssm_config(frame_skip=0)
