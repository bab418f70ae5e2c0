import pytest
import tiny
import torch

from lerobot_latentsafe.world_models.stochastic import Categorical, Gaussian

KEY = "observation.image"


def test_categorical_probabilities_sum_to_one_and_never_vanish():
    latent = Categorical(3, 4, unimix=0.01)
    (probabilities,) = latent.read(100 * torch.randn(5, latent.n_raw))
    torch.testing.assert_close(probabilities.sum(-1), torch.ones(5, 3))
    assert probabilities.min() >= 0.01 / 4 - 1e-7


def test_categorical_centre_is_the_likeliest_class():
    latent = Categorical(2, 3, unimix=0.0)
    statistics = latent.read(torch.tensor([[0.0, 2.0, 1.0, 5.0, 0.0, 0.0]]))
    assert latent.centre(statistics).tolist() == [[0, 1, 0, 1, 0, 0]]


def test_categorical_samples_are_as_frequent_as_probable():
    latent = Categorical(1, 3, unimix=0.0)
    wanted = torch.tensor([0.2, 0.5, 0.3])
    statistics = latent.read(wanted.log().expand(20_000, 3))
    drawn = latent.sample(statistics)
    assert set(drawn.unique().tolist()) == {0.0, 1.0} and (drawn.sum(-1) == 1).all()
    torch.testing.assert_close(drawn.mean(0), wanted, atol=0.02, rtol=0)


def test_categorical_gradient_goes_straight_through():
    latent = Categorical(2, 3, unimix=0.0)
    raw = torch.randn(4, 6, requires_grad=True)
    weight = torch.randn(4, 6)
    (latent.sample(latent.read(raw)) * weight).sum().backward()
    through = raw.detach().clone().requires_grad_()
    (latent.read(through)[0].flatten(-2) * weight).sum().backward()
    torch.testing.assert_close(raw.grad, through.grad)


@pytest.mark.parametrize("latent", [Gaussian(6, 0.1), Categorical(2, 3, 0.01)], ids=["gaussian", "categorical"])
def test_kl_is_torchs(latent):
    one, two = latent.read(torch.randn(5, latent.n_raw)), latent.read(torch.randn(5, latent.n_raw))
    if isinstance(latent, Gaussian):
        made, axes = [torch.distributions.Normal(*s) for s in (one, two)], (-1,)
    else:
        made, axes = [torch.distributions.Categorical(*s) for s in (one, two)], (-1,)
    torch.testing.assert_close(latent.kl(one, two), torch.distributions.kl_divergence(*made).sum(axes))
    torch.testing.assert_close(latent.kl(one, one), torch.zeros(5), atol=1e-6, rtol=0)


@pytest.fixture
def model():
    return tiny.rssm_config(classes=5).build([KEY], 2, tiny.ACTION_DIM).eval()


def test_categorical_rssm_has_one_hot_latents(model):
    latents = model.encode(tiny.random_clip(batch=3, length=5))
    assert latents["x"].shape == (3, 5, 4 * 5) and model.feature_dim == 16 + 20
    assert latents["x"].unflatten(-1, (4, 5)).sum(-1).eq(1).all()
    features = model.features(latents)[:, 0]
    again = model.latent_of(features, latents["action"][:, 0])
    assert again.keys() == latents.keys()
    torch.testing.assert_close(model.features(again), features)


def test_categorical_rssm_trains():
    model = tiny.rssm_config(classes=5, free_nats=0.0).build([KEY], 2, tiny.ACTION_DIM).train()
    loss, features, _ = model.loss(tiny.random_clip())
    loss.backward()
    idle = {name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()}
    assert loss.isfinite() and features.shape == (3, 5, 36) and all(name.startswith("continues.") for name in idle)


def test_steps_are_deterministic_and_sampled_steps_are_not(model):
    latent, action = model.initial(64), torch.zeros(64, tiny.ACTION_DIM)
    assert torch.equal(model.step(latent, action)["x"], model.step(latent, action)["x"])
    one, two = model.sample_step(latent, action), model.sample_step(latent, action)
    assert not torch.equal(one["x"], two["x"]) and torch.equal(one["h"], two["h"])


def test_a_deterministic_model_samples_the_only_future_it_knows():
    model = tiny.gru_config().build([KEY], 2, tiny.ACTION_DIM).eval()
    latent, action = model.initial(2), torch.rand(2, tiny.ACTION_DIM)
    for key, value in model.step(latent, action).items():
        torch.testing.assert_close(model.sample_step(latent, action)[key], value)


def test_one_class_is_refused():
    with pytest.raises(ValueError, match="classes is 1; expected 0"):
        tiny.rssm_config(classes=1).build([KEY], 2, 1)


def test_the_papers_sizes_train():
    config = tiny.rssm_config(
        image_size=128, clip_length=4, encoder="cnn", deterministic=512, stochastic=32, classes=32, hidden=512
    )
    model = config.build([KEY], 2, tiny.ACTION_DIM).train()
    assert model.feature_dim == 512 + 32 * 32
    loss, *_ = model.loss(tiny.random_clip(batch=1, length=3, size=128))
    loss.backward()
    assert loss.isfinite()
