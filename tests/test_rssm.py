import pytest
import tiny
import torch

from lerobot_latentsafe.latent import map_latent

KEY = "observation.image"


@pytest.fixture
def model():
    return tiny.rssm_config().build([KEY], 2, tiny.ACTION_DIM).eval()


def assert_same(latent, other):
    assert latent.keys() == other.keys()
    for key in latent:
        torch.testing.assert_close(latent[key], other[key])


def test_shapes(model):
    clip = tiny.random_clip(batch=3, length=5)
    latents = model.encode(clip)
    assert latents["h"].shape == (3, 5, 16) and latents["x"].shape == (3, 5, 4)
    features = model.features(latents)
    assert features.shape == (3, 5, model.feature_dim)
    assert model.ended(latents).shape == (3, 5)
    after = model.step(map_latent(latents, lambda t: t[:, -1]), torch.zeros(3, tiny.ACTION_DIM))
    assert after["h"].shape == (3, 16)
    assert model.decode(features[:, 0])[KEY].shape == (3, 3, 32, 32)


def test_loss_returns_features_for_the_margin_and_finite_metrics(model):
    loss, features, metrics = model.loss(tiny.random_clip(batch=3, length=5))
    assert loss.isfinite() and features.shape == (3, 5, model.feature_dim)
    assert all(v.isfinite() for v in metrics.values())


def test_loss_decreases_on_one_batch():
    model = tiny.rssm_config().build([KEY], 2, tiny.ACTION_DIM).train()
    clip = tiny.random_clip(batch=4, length=6, size=32)
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    losses = []
    for _ in range(30):
        loss, *_ = model.loss(clip)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.9 * losses[0]


def test_without_its_decoders_it_imagines_the_same_but_neither_draws_nor_learns(model):
    clip = tiny.random_clip(batch=2, length=4)
    before = model.encode(clip)
    assert model.draws
    model.stop_drawing()
    assert_same(model.encode(clip), before)
    assert not model.draws and not any("decoders" in name for name, _ in model.named_parameters())
    error = model.error(map_latent(before, lambda t: t[:, 0]), {KEY: clip.percepts[KEY][:, 1]}, clip.state[:, 1])
    assert error.shape == (2,) and (error > 0).all()
    with pytest.raises(ValueError, match=r"decoder is false.*train the one that it was wrapped from"):
        model.loss(clip)


def test_every_parameter_learns_but_the_continuation_until_ends_are_known():
    model = tiny.rssm_config(free_nats=0.0).build([KEY], 2, tiny.ACTION_DIM).train()
    clip = tiny.random_clip(batch=2, length=6)
    clip.terminal[:] = -1
    model.loss(clip)[0].backward()
    idle = {name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()}
    assert idle and all(name.startswith("continues.") for name in idle)


def test_encode_is_repeated_observe(model):
    clip = tiny.random_clip(batch=2, length=5)
    encoded, latent = model.encode(clip), None
    for t in range(5):
        latent = model.observe(
            latent, clip.action[:, t] if t else None, {KEY: clip.percepts[KEY][:, t]}, clip.state[:, t]
        )
        assert_same(latent, map_latent(encoded, lambda z, t=t: z[:, t]))


def test_imagination_is_deterministic(model):
    latent = map_latent(model.encode(tiny.random_clip()), lambda t: t[:, -1])
    action = 2 * torch.rand(3, tiny.ACTION_DIM) - 1
    assert_same(model.step(latent, action), model.step(latent, action))
    assert not torch.equal(model.step(latent, action)["h"], model.step(latent, -action)["h"])


def test_rows_of_a_batch_do_not_mix(model):
    clip = tiny.random_clip(batch=3)
    alone = tiny.random_clip(batch=1)
    for name in ("state", "action", "is_first"):
        setattr(alone, name, getattr(clip, name)[1:2])
    alone.percepts = {KEY: clip.percepts[KEY][1:2]}
    together = map_latent(model.encode(clip), lambda t: t[1:2])
    assert_same(model.encode(alone), together)


def test_nothing_before_the_first_frame_matters(model):
    clip, other = tiny.random_clip(length=6), tiny.random_clip(length=6)
    clip.is_first[:, 3] = True
    for old, new in ((other.percepts[KEY], clip.percepts[KEY]), (other.state, clip.state), (other.action, clip.action)):
        old[:, 3:] = new[:, 3:]
    other.is_first = clip.is_first
    assert_same(*(map_latent(model.encode(c), lambda t: t[:, 3:]) for c in (clip, other)))
    clip.is_first[:, 3] = False
    remembers = model.encode(clip)["h"][:, 3:]
    assert not torch.allclose(remembers, model.encode(other)["h"][:, 3:])


def test_training_also_forgets_at_the_first_frame():
    model = tiny.rssm_config().build([KEY], 2, tiny.ACTION_DIM).eval()
    clip, other = tiny.random_clip(length=6), tiny.random_clip(length=6)
    for c in (clip, other):
        c.is_first[:, 3] = True
        c.valid[:, :3] = False
    for old, new in ((other.percepts[KEY], clip.percepts[KEY]), (other.state, clip.state), (other.action, clip.action)):
        old[:, 3:] = new[:, 3:]
    losses = []
    for c in (clip, other):
        torch.manual_seed(0)
        losses.append(model.loss(c)[0].item())
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)


def test_nothing_has_ended_before_an_end_was_ever_seen():
    model = tiny.rssm_config().build([KEY], 2, tiny.ACTION_DIM).train()
    with torch.no_grad():
        model.continues[-1].bias.fill_(-100.0)  # the head says that every episode is over
    clip = tiny.random_clip()
    assert not model.ended(model.encode(clip)).any()
    model.loss(clip)
    assert not model.ended(model.encode(clip)).any()
    clip.terminal[0, -1] = 1
    model.loss(clip)
    assert model.ended(model.encode(clip)).all()


def test_padding_is_no_end():
    model = tiny.rssm_config().build([KEY], 2, tiny.ACTION_DIM).train()
    clip = tiny.random_clip()
    clip.terminal[:, -1], clip.valid[:, -1] = 1, False
    model.loss(clip)
    assert model.ends_seen == 0


def test_mean_image_is_learned_in_training_only():
    model = tiny.rssm_config().build([KEY], 2, tiny.ACTION_DIM)
    clip = tiny.random_clip()
    model.eval().loss(clip)
    assert model.mean_observation_image.eq(0).all()
    model.train().loss(clip)
    torch.testing.assert_close(model.mean_observation_image, clip.percepts[KEY].mean((0, 1)))
    learned = model.mean_observation_image.clone()
    model.eval().loss(tiny.random_clip())
    torch.testing.assert_close(model.mean_observation_image, learned)


def test_two_cameras_are_both_read():
    keys = ["observation.images.wrist", "observation.images.front"]
    model = tiny.rssm_config().build(keys, 2, tiny.ACTION_DIM).eval()
    images = {key: torch.rand(2, 3, 32, 32) for key in keys}
    state = torch.randn(2, 2)
    latent = model.observe(None, None, images, state)
    for key in keys:
        changed = model.observe(None, None, {**images, key: 1 - images[key]}, state)
        assert not torch.allclose(latent["x"], changed["x"])


def test_unknown_encoder_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"'vit'.*'mlp' or 'cnn'"):
        tiny.rssm_config(encoder="vit").build([KEY], 2, 1)


@pytest.mark.parametrize("size", [48, 100])
def test_sizes_the_cnn_cannot_read_are_refused(size):
    with pytest.raises(ValueError, match=f"image_size is {size}.*power of two"):
        tiny.rssm_config(encoder="cnn", image_size=size).build([KEY], 2, 1)


def test_no_camera_is_refused():
    with pytest.raises(ValueError, match="at least one camera"):
        tiny.rssm_config().build([], 2, 1)


def test_the_papers_sizes_train():
    config = tiny.rssm_config(
        image_size=128, clip_length=4, encoder="cnn", deterministic=512, stochastic=32, hidden=512, cnn_depth=32
    )
    model = config.build([KEY], 2, tiny.ACTION_DIM).train()
    assert model.feature_dim == 544
    loss, *_ = model.loss(tiny.random_clip(batch=1, length=4, size=128))
    loss.backward()
    assert loss.isfinite()
    assert all(p.grad.isfinite().all() for p in model.parameters() if p.grad is not None)
