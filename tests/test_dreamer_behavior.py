"""The maths of learning in imagination."""

import pytest
import torch

from lerobot_latentsafe.policies.dreamer.behavior import (
    TERMS,
    Actor,
    BehaviorConfig,
    ReturnRange,
    RewardWeights,
    TwoHotHead,
    imagine,
    lambda_returns,
    symexp,
    symlog,
    two_hot,
)

CONFIG = BehaviorConfig(hidden=32, bins=41)


def test_symlog_is_inverted():
    x = torch.tensor([-300.0, -1.0, -0.01, 0.0, 0.3, 20.0, 700.0])
    torch.testing.assert_close(symexp(symlog(x)), x)
    assert symlog(torch.tensor(0.01)).item() == pytest.approx(0.01, rel=0.01)


def test_two_hot_has_the_number_as_its_mean():
    bins, x = torch.linspace(-2, 2, 9), torch.tensor([-2.0, -0.3, 0.0, 1.1, 2.0])
    weights = two_hot(x, bins)
    assert ((weights > 0).sum(-1) <= 2).all()
    torch.testing.assert_close(weights.sum(-1), torch.ones(5))
    torch.testing.assert_close(weights @ bins, x)
    assert two_hot(torch.tensor(7.0), bins) @ bins == 2  # beyond the last bin


def test_head_learns_a_number_and_starts_at_none():
    head, features = TwoHotHead(3, CONFIG), torch.randn(64, 3)
    assert head(features).abs().max() < 1e-4
    target = 20 * (features[:, 0] > 0).float() + 0.5
    optimizer = torch.optim.Adam(head.parameters(), 1e-2)
    for _ in range(200):
        loss = head.loss(features, target).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert (head(features) - target).abs().mean() < 2


def test_returns_without_trace_look_one_step_ahead():
    reward, value = torch.randn(2, 4, 3)
    torch.testing.assert_close(lambda_returns(reward, value, 0.9, 0.0), reward + 0.9 * value)


def test_returns_with_full_trace_are_discounted_sums():
    reward, value, gamma = *torch.randn(2, 4, 3), 0.9
    returns = lambda_returns(reward, value, gamma, 1.0)
    expected = sum(gamma**t * reward[t] for t in range(4)) + gamma**4 * value[-1]
    torch.testing.assert_close(returns[0], expected)
    torch.testing.assert_close(returns[-1], reward[-1] + gamma * value[-1])


def test_returns_by_hand():
    reward, value = torch.tensor([[1.0], [2.0]]), torch.tensor([[10.0], [20.0]])
    last = 2 + 0.5 * 20
    first = 1 + 0.5 * (0.25 * 10 + 0.75 * last)
    assert lambda_returns(reward, value, 0.5, 0.75).squeeze(1).tolist() == [first, last]


def test_range_is_that_of_percentiles_and_never_divides_by_less_than_one():
    tracked = ReturnRange(1.0)
    returns = torch.linspace(0, 100, 101)
    assert tracked.update(returns).item() == pytest.approx(90)
    assert tracked.update(returns / 1000).item() == 1
    slow = ReturnRange(0.1)
    slow.update(returns)
    assert slow.range.item() == pytest.approx(9)


def test_reward_is_the_weighted_sum_of_its_terms():
    terms = torch.tensor([0.5, 1.0, 1.0, 4.0, 2.0])
    assert TERMS == ("reach", "lifted", "failure", "joint_speed", "action_rate")
    weights = RewardWeights(reach=2, lift=20, topple=10, joint_speed=0.1, action_rate=0.5)
    assert weights.reward(terms).item() == pytest.approx(2 * 0.5 + 20 - 10 - 0.1 * 4 - 0.5 * 2)


@pytest.fixture
def actor():
    return Actor(3, torch.tensor([True, False]), CONFIG)


def test_actor_moves_only_what_varies_and_its_mode_stays_in_range(actor):
    features = 10 * torch.randn(200, 3)
    assert actor.mode(features).abs().max() <= 1
    for action in (actor.mode(features), actor.sample(features)):
        assert action.shape == (200, 2)
        assert action[:, 1].eq(0).all() and action[:, 0].ne(0).any()


def test_commands_that_never_vary_have_no_say(actor):
    features, action = torch.randn(5, 3), torch.rand(5, 2)
    other = torch.stack([action[:, 0], torch.rand(5)], 1)
    torch.testing.assert_close(actor.log_prob(features, action), actor.log_prob(features, other))
    spread = actor.distribution(features).stddev
    assert (spread >= CONFIG.min_std).all() and (spread <= CONFIG.max_std).all()
    torch.testing.assert_close(actor.entropy(features), actor.distribution(features).entropy()[:, 0])


class Counter:
    """A world whose only number counts steps, plus the action."""

    def features(self, latent):
        return latent["x"]

    def sample_step(self, latent, action):
        return {"x": latent["x"] + 1 + action[:, :1] * 0}


def test_imagination_pairs_actions_with_the_latents_they_lead_to(actor):
    features, actions = imagine(Counter(), actor, {"x": torch.zeros(4, 3)}, 5)
    assert features.shape == (6, 4, 3) and actions.shape == (5, 4, 2)
    assert features[:, 0, 0].tolist() == [0, 1, 2, 3, 4, 5]


def test_what_is_imagined_to_be_executed_is_in_range():
    actor = Actor(3, torch.tensor([True, True]), BehaviorConfig(hidden=32, bins=41, min_std=1.0))

    class Recorder(Counter):
        executed = ()

        def sample_step(self, latent, action):
            self.executed += (action,)
            return super().sample_step(latent, action)

    world = Recorder()
    _, drawn = imagine(world, actor, {"x": 10 * torch.randn(200, 3)}, 2)
    torch.testing.assert_close(torch.stack(world.executed), drawn.clamp(-1, 1))
    assert drawn.abs().max() > 1
