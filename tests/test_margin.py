import pytest
import torch

from lerobot_latentsafe.margin import FailureMargin, MarginConfig, hinge_loss, slope_between


def test_hinge_loss_by_hand():
    margin = torch.tensor([1.0, 0.25, -1.0, 0.5])
    failure = torch.tensor([0, 0, 1, 1])
    # safe: (0 + 0.5) / 2, failing: (0 + 1.25) / 2
    assert hinge_loss(margin, failure, delta=0.75).item() == pytest.approx(0.25 + 0.625)


def test_hinge_loss_vanishes_beyond_delta():
    margin = torch.tensor([0.75, 3.0, -0.75, -9.0])
    assert hinge_loss(margin, torch.tensor([0, 0, 1, 1]), delta=0.75) == 0


def test_each_class_weighs_the_same_however_rare():
    margin = torch.zeros(100)
    failure = torch.zeros(100, dtype=torch.long)
    failure[0] = 1
    assert hinge_loss(margin, failure, delta=0.5).item() == pytest.approx(1.0)


def test_unlabelled_frames_are_ignored():
    margin, failure = torch.tensor([[0.1, 5.0], [-0.2, -5.0]]), torch.tensor([[0, -1], [1, -1]])
    margin.requires_grad_()
    loss = hinge_loss(margin, failure)
    assert loss.item() == pytest.approx(0.65 + 0.55)
    loss.backward()
    assert margin.grad[:, 1].eq(0).all() and margin.grad[:, 0].ne(0).all()


@pytest.mark.parametrize(("label", "expected"), [(0, 0.75 - 0.2), (1, 0.75 + 0.2)])
def test_one_class_alone_gives_its_own_term(label, expected):
    margin = torch.full((4,), 0.2)
    assert hinge_loss(margin, torch.full((4,), label)).item() == pytest.approx(expected)


def test_nothing_labelled_gives_zero_with_a_gradient():
    margin = torch.ones(3, requires_grad=True)
    loss = hinge_loss(margin, torch.full((3,), -1))
    loss.backward()
    assert loss == 0 and margin.grad.eq(0).all()


def test_shapes_and_bounds():
    margin = FailureMargin(7, hidden=8, n_layers=2)
    features = 50 * torch.randn(3, 5, 7)
    assert margin(features).shape == (3, 5)
    assert margin.bounded(features).abs().max() <= 1
    assert (margin.bounded(features).sign() == margin(features).sign()).all()


def test_it_learns_a_disc():
    points = 2 * torch.rand(2000, 2) - 1
    failure = (points.norm(dim=1) < 0.5).long()
    margin = FailureMargin(2)
    optimizer = torch.optim.Adam(margin.parameters(), 1e-2)
    for _ in range(300):
        optimizer.zero_grad()
        hinge_loss(margin(points), failure).backward()
        optimizer.step()
    assert ((margin(points) < 0) == failure.bool()).float().mean() > 0.95


def test_fitted_margin_separates_and_tanh_still_resolves_it():
    from lerobot_latentsafe.training import fit_margin

    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    features = torch.randn(2000, 6) * torch.tensor([100.0, 1, 1, 1, 1, 1e-2]) + 5
    failure = (features[:, 0] < 5).long()
    margin = FailureMargin(6, hidden=16, n_layers=1)
    fit_margin(margin, features, failure, MarginConfig(), generator, steps=300)
    with torch.no_grad():
        l = margin(features)
    assert ((l < 0) == (failure == 1)).float().mean() > 0.95
    assert l.abs().median().item() == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("noise", [-0.1, float("inf"), float("nan")])
def test_noise_that_is_none_is_refused(noise):
    with pytest.raises(ValueError, match=r"--policy.margin.noise is .*standard deviations, 0 or more"):
        MarginConfig(noise=noise)


def test_the_slope_of_a_linear_margin_is_that_of_its_weights():
    features, failure = torch.randn(40, 3, generator=torch.Generator().manual_seed(0)), torch.arange(40) % 2
    margin = torch.nn.Sequential(torch.nn.Linear(3, 1), torch.nn.Flatten(0))
    slope = slope_between(margin, features, failure, torch.Generator().manual_seed(0))
    assert slope.item() == pytest.approx(margin[0].weight.square().sum().item(), rel=1e-5)


def test_a_margin_with_a_gradient_penalty_is_another_and_separates():
    from lerobot_latentsafe.training import fit_margin

    heap = torch.randn(2000, 4, generator=torch.Generator().manual_seed(1)) * 0.2
    failure = (torch.arange(2000) % 2).long()
    features, found = heap + torch.tensor([1.0, 0, 0, 0]) * (1 - failure[:, None]), []
    for penalty in (0.0, 1.0):
        torch.manual_seed(0)
        margin, generator = FailureMargin(4), torch.Generator().manual_seed(0)
        fit_margin(margin, features, failure, MarginConfig(noise=0.0, gradient_penalty=penalty), generator, steps=300)
        found.append(margin(features).detach())
        assert ((found[-1] < 0) == failure.bool()).float().mean() > 0.95
    assert not torch.allclose(*found, atol=1e-2)


def test_features_of_one_kind_have_no_slope_between_them():
    generator = torch.Generator().manual_seed(0)
    for failure in (torch.zeros(5), torch.ones(5)):
        assert slope_between(FailureMargin(3), torch.randn(5, 3), failure, generator).item() == 0


@pytest.mark.parametrize("penalty", [-0.1, float("inf"), float("nan")])
def test_a_penalty_that_is_none_is_refused(penalty):
    with pytest.raises(ValueError, match=r"--policy.margin.gradient_penalty is .*a weight, 0 or more"):
        MarginConfig(gradient_penalty=penalty)
