"""The GRU on whole frames: the contract, open-loop learning, and the control that is blind."""

from dataclasses import replace

import pytest
import tiny
import torch

from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.latent import select

STATE_DIM, ACTION_DIM = 2, 2


@pytest.fixture
def model():
    return tiny.gru_config().build(["observation.image"], STATE_DIM, ACTION_DIM).eval()


def random_clip(batch=32, length=8):
    """Frames that move where the action says: vector and state are the summed actions."""
    action = 2 * torch.rand(batch, length, ACTION_DIM) - 1
    is_first = torch.zeros(batch, length, dtype=torch.bool)
    is_first[:, 0] = True
    place = torch.where(is_first[..., None], torch.randn(batch, length, ACTION_DIM), action).cumsum(1)
    vector = torch.cat([place, torch.zeros(batch, length, tiny.COMPONENTS - ACTION_DIM)], -1)
    valid = torch.ones_like(is_first)
    nothing = torch.full((batch, length), -1)
    return Clip({"vector": vector}, place.clone(), action, is_first, valid, nothing, nothing)


def filtered(model, clip, n):
    latent = None
    for t in range(n):
        latent = model.observe(latent, clip.action[:, t], {"vector": clip.percepts["vector"][:, t]}, clip.state[:, t])
    return latent


def test_latent_is_batch_first_and_remembers_the_action(model):
    latent = filtered(model, random_clip(), 3)
    assert all(len(value) == 32 for value in latent.values())
    action = torch.rand(32, ACTION_DIM)
    assert torch.equal(model.step(latent, action)["action"], action)
    assert model.features(latent).shape == (32, model.feature_dim)
    assert not model.ended(latent).any()


def test_rows_do_not_see_each_other(model):
    clip = random_clip()
    together = model.step(filtered(model, clip, 3), clip.action[:, 3])
    alone = model.step(select(filtered(model, clip, 3), slice(4, 5)), clip.action[4:5, 3])
    for name, value in alone.items():
        torch.testing.assert_close(together[name][4:5], value)


def test_correcting_takes_over_what_was_seen(model):
    clip = random_clip()
    latent = filtered(model, clip, 2)
    assert torch.equal(latent["vector"], clip.percepts["vector"][:, 1]) and torch.equal(
        latent["state"], clip.state[:, 1]
    )


def test_gradients_reach_the_action(model):
    action = torch.zeros(4, ACTION_DIM, requires_grad=True)
    latent = model.step(select(filtered(model, random_clip(), 2), slice(4)), action)
    model.features(latent).square().sum().backward()
    assert action.grad.isfinite().all() and (action.grad != 0).any()


def test_a_summary_sees_what_is_small_and_the_margin_alone_teaches_it():
    torch.manual_seed(0)
    model = tiny.gru_config(summary=4).build(["observation.image"], STATE_DIM, ACTION_DIM)
    n_patches, token_dim = model.perception.n_patches, model.perception.token_dim
    assert model.percept_names == ["vector", "tokens"] and model.sizes["vector"] == tiny.COMPONENTS + 8

    def clip_with_a_spot():
        clip = random_clip()
        spot = torch.rand(len(clip.state), n_patches).argsort(-1) < torch.randint(2, (len(clip.state), 1))
        tokens = torch.randn(*clip.state.shape[:2], n_patches, token_dim)
        tokens[..., 0] += 6 * spot[:, None]
        return replace(clip, percepts={**clip.percepts, "tokens": tokens}), spot.any(-1)

    head = torch.nn.Linear(model.feature_dim, 1)
    optimizer = torch.optim.Adam([*model.parameters(), *head.parameters()], 1e-2)
    for step in range(150):
        clip, there = clip_with_a_spot()
        loss, features, _ = model.loss(clip)
        if step == 0:
            loss.backward(retain_graph=True)
            assert all(weight.grad is None for weight in model.summary.parameters())
        verdict = head(features[:, 0])[:, 0] * (2.0 * there - 1)
        margin = torch.nn.functional.softplus(verdict).mean()
        optimizer.zero_grad()
        (0.01 * loss + margin).backward()
        optimizer.step()
    clip, there = clip_with_a_spot()
    latent = model.eval().observe(None, None, {k: v[:, 0] for k, v in clip.percepts.items()}, clip.state[:, 0])
    found = head(model.features(latent))[:, 0] < 0
    assert (found == there).float().mean() > 0.9


def learn(blind):
    torch.manual_seed(0)
    model = tiny.gru_config(hidden=32, units=32, blind=blind).build(["observation.image"], STATE_DIM, ACTION_DIM)
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    for _ in range(250):
        loss, features, metrics = model.loss(random_clip())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert features.shape == (32, 8, model.feature_dim)
    return model.eval(), metrics


def imagined_error(model, clip, action, observed=2):
    latent = filtered(model, clip, observed)
    for t in range(observed, clip.state.shape[1]):
        latent = model.step(latent, action[:, t])
    return model.error(latent, {"vector": clip.percepts["vector"][:, -1]}, clip.state[:, -1]).mean()


def test_it_learns_to_obey_the_action():
    model, metrics = learn(blind=False)
    clip = random_clip()
    shuffled = clip.action[torch.randperm(len(clip.action))]
    assert metrics["loss_vector"] < 1
    with torch.no_grad():
        assert imagined_error(model, clip, shuffled) > 2 * imagined_error(model, clip, clip.action)


def test_blind_control_learns_from_proprioception_and_sees_nothing():
    model, metrics = learn(blind=True)
    assert metrics["loss_state"] < 1 and "loss_vector" not in metrics
    clip, other = random_clip(), random_clip()
    other.state, other.action = clip.state, clip.action
    with torch.no_grad():
        seen, unseen = (model.features(filtered(model, c, 3)) for c in (clip, other))
    torch.testing.assert_close(seen, unseen)


def test_padding_and_first_frames_count_for_nothing():
    model = tiny.gru_config().build(["observation.image"], STATE_DIM, ACTION_DIM)
    clip = random_clip()
    clip.valid[:, 5:] = False
    torch.manual_seed(1)
    loss = model.loss(clip)[0]
    clip.percepts["vector"][:, 5:] += 100
    clip.state[:, 5:] -= 100
    torch.manual_seed(1)
    torch.testing.assert_close(model.loss(clip)[0], loss)


def test_model_without_a_camera_is_refused():
    with pytest.raises(ValueError, match="at least one camera"):
        tiny.gru_config().build([], STATE_DIM, ACTION_DIM)


def test_filter_on_tokens_is_trained_saved_and_loaded(token_root, tmp_path):
    """From a token cache to a shielded action, by the commands' functions; the checkpoint holds no encoder."""
    from safetensors import safe_open

    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
    from lerobot_latentsafe.training import train_margin, train_reachability

    meta = tiny.metadata(token_root)
    options = dict(world_model=tiny.gru_config(), fallback_action_candidates=None, margin_weight=0.0, margin_clips=64)
    stage_one = tiny.train_stage_one(meta, tmp_path / "one", **options)
    train_margin(stage_one, meta, tmp_path / "two")
    train_reachability(tmp_path / "two", meta, tmp_path / "three")
    policy = LatentSafePolicy.from_pretrained(tmp_path / "three")
    decisions = tiny.drive(policy)
    assert all(d.action.isfinite().all() and d.value.isfinite().all() for d in decisions)
    with safe_open(tmp_path / "three" / "model.safetensors", "pt") as file:
        assert not [name for name in file.keys() if "encoder" in name]  # noqa: SIM118
    low, high = policy.model.critic.low, policy.model.critic.high
    for d in decisions:
        action = policy.model.units.normalise_action(d.action)
        assert ((action >= low - 1e-5) & (action <= high + 1e-5))[:, 0].all()
