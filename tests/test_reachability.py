import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import tiny
import torch

from lerobot_latentsafe.critic import HINGE_ABOVE, ReachabilityConfig, SafetyCritic, safety_bellman_target
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.dubins.ground_truth import exact_value
from lerobot_latentsafe.evaluation.statistics import confusion
from lerobot_latentsafe.experiments.dubins.monitor import PrivilegedMonitor
from lerobot_latentsafe.experiments.dubins.privileged import DubinsImagination, train_privileged
from lerobot_latentsafe.latent import FRAME, Recorded
from lerobot_latentsafe.reachability import LatentReachability, discount, look_ahead

MARGIN, NEXT = torch.tensor([0.5, 0.5, -0.2]), torch.tensor([0.1, 0.9, 0.3])


class WindyChain:
    """x in [-1, 1] with failure x < 0. Below x = 0.4 a wind that no action can resist blows into it.

    So exactly the states with x >= 0.4 can be kept safe, by not moving left.
    """

    threshold, sampled = 0.4, False

    def step(self, latent, action):
        x = latent["x"]
        wind = torch.where(x < self.threshold, -1.0, 0.0)
        return {"x": (x + 0.1 * (wind + 0.5 * action)).clamp(-1, 1)}

    follow = step

    def features(self, latent):
        return latent["x"]

    def margin(self, latent):
        return latent["x"].squeeze(-1)

    def judged(self, latent):
        return self.features(latent), self.margin(latent)

    def ended(self, latent):
        return torch.zeros(len(latent["x"]), dtype=torch.bool)

    def complete(self, latent, action):
        return action


CHAIN = ReachabilityConfig(
    critic_hidden=(48, 48), actor_hidden=(32,), steps=900, batch_size=256, pool=8192, horizon=10, refresh=100, lr=3e-3
)


@pytest.fixture(scope="module", params=["discrete", "continuous", "through the world model"])
def learned(request):
    torch.manual_seed(0)
    candidates = torch.tensor([[-1.0], [0.0], [1.0]]) if request.param == "discrete" else None
    config = replace(CHAIN, actor_through="world_model") if request.param == "through the world model" else CHAIN
    critic = SafetyCritic(1, 1, candidates, config)
    learner = LatentReachability(WindyChain(), critic, lambda n: {"x": 2 * torch.rand(n, 1) - 1}, config)
    for _ in range(config.steps):
        learner.update()
    return critic


def test_gamma_zero_gives_the_margin():
    torch.testing.assert_close(safety_bellman_target(MARGIN, NEXT, 0.0), MARGIN)


def test_gamma_one_gives_the_minimum_over_time():
    torch.testing.assert_close(safety_bellman_target(MARGIN, NEXT, 1.0), torch.tensor([0.1, 0.5, -0.2]))


def test_target_between():
    expected = torch.tensor([0.25 * 0.5 + 0.75 * 0.1, 0.5, -0.2])
    torch.testing.assert_close(safety_bellman_target(MARGIN, NEXT, 0.75), expected)


@pytest.mark.parametrize("gamma", [0.0, 0.5, 0.99, 1.0])
def test_backup_is_a_contraction_that_never_exceeds_the_margin(gamma):
    l, v, w = torch.randn(3, 200)
    backed, other = safety_bellman_target(l, v, gamma), safety_bellman_target(l, w, gamma)
    assert (backed <= l + 1e-6).all()
    assert (backed - other).abs().max() <= gamma * (v - w).abs().max() + 1e-6


def test_discount_rises_from_zero_to_gamma():
    config = ReachabilityConfig()
    values = [discount(p, config) for p in np.linspace(0, 1, 201)]
    assert values[0] == 0.0 and values[-1] == pytest.approx(config.gamma)
    assert all(later >= earlier for earlier, later in pairwise(values))
    assert discount(config.warmup, config) == pytest.approx(config.gamma_start)
    assert discount(config.warmup + config.anneal, config) == pytest.approx(config.gamma)


def test_value_has_the_sign_of_the_analytic_one(learned):
    x = torch.linspace(-0.95, 0.95, 191)[:, None]
    x = x[(x - WindyChain.threshold).abs().squeeze() > 0.03]
    with torch.no_grad():
        value = learned.value(x, x.squeeze(-1))
    safe = x.squeeze(-1) >= WindyChain.threshold
    assert ((value > 0) == safe).float().mean() > 0.97
    doomed = (x.squeeze(-1) > 0.1) & ~safe
    assert (value[doomed] < 0).float().mean() > 0.9  # not failing yet, but bound to


def test_fallback_keeps_safe_what_can_be_kept_safe(learned):
    world, latent = WindyChain(), {"x": torch.linspace(0.45, 0.95, 50)[:, None]}
    with torch.no_grad():
        for _ in range(60):
            latent = world.step(latent, learned.fallback(world.features(latent)))
    assert (world.margin(latent) > 0).float().mean() > 0.95


def test_an_actor_climbs_only_what_is_known():
    with pytest.raises(ValueError, match="actor_through is 'reward'; expected critic or world_model"):
        ReachabilityConfig(actor_through="reward")


def test_value_never_exceeds_the_margin(learned):
    features, margin = torch.rand(100, 1), 2 * torch.rand(100) - 1
    with torch.no_grad():
        assert (learned.value(features, margin) <= margin).all()


def test_best_q_is_that_of_the_fallback_action(learned):
    x = torch.randn(50, 1)
    with torch.no_grad():
        action = learned.act(x)
        if learned.discrete:
            index = (action[:, None] == learned.candidates).all(-1).long().argmax(-1)
            best = learned.q(x).gather(1, index[:, None]).squeeze(1)
        else:
            best = learned.q_of(x, action)
    torch.testing.assert_close(learned.best_q(x), best)
    assert action.shape == (50, 1) and action.abs().max() <= 1


def small_learner(imagination, candidates, seed=0, **changes):
    config = tiny.reachability_config(**changes)
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    critic = SafetyCritic(1, 1, candidates, config)
    return LatentReachability(
        imagination, critic, lambda n: {"x": torch.rand(n, 1, generator=generator)}, config, generator
    )


@pytest.mark.parametrize("candidates", [torch.tensor([[-1.0], [1.0]]), None], ids=["discrete", "continuous"])
def test_equal_seeds_learn_equal_critics(candidates):
    first, second = (small_learner(WindyChain(), candidates, seed=3) for _ in range(2))
    for _ in range(15):
        assert first.update() == second.update()


@pytest.mark.parametrize("candidates", [torch.tensor([[-1.0], [1.0]]), None], ids=["discrete", "continuous"])
def test_where_recordings_succeed_a_hinge_raises_v_and_lowers_none(candidates):
    lacks = []
    for hinge in (0.0, 10.0):
        learner = small_learner(WindyChain(), candidates, hinge=hinge, lr=1e-2)
        learner.succeeding = torch.tensor([[0.2], [0.3]])  # which the wind blows into failure
        for _ in range(60):
            learner.update()
        lacks.append(learner._hinge(learner.succeeding).item())
    assert lacks[1] < 0.8 * lacks[0]
    learner.optimizer.zero_grad()
    with torch.no_grad():
        learner.critic.q[-1].bias.fill_(-5.0)
    learner._hinge(learner.succeeding).backward()
    assert (learner.critic.q[-1].bias.grad <= 0).all()  # a step of descent raises V
    assert learner.critic.actor is None or all(p.grad is None for p in learner.critic.actor.parameters())
    with torch.no_grad():
        learner.critic.q[-1].bias.fill_(HINGE_ABOVE + 5)
    assert learner._hinge(learner.succeeding).item() == 0


@pytest.mark.parametrize("hinge", [-1.0, float("inf"), float("nan")])
def test_a_hinge_that_is_none_is_refused(hinge):
    with pytest.raises(ValueError, match=r"--policy.reachability.hinge is .*a weight, 0 or more"):
        ReachabilityConfig(hinge=hinge)


@pytest.mark.parametrize("candidates", [torch.tensor([[-1.0], [1.0]]), None], ids=["discrete", "continuous"])
def test_trajectories_go_on_as_recorded_and_learn_of_what_was_tried(candidates):
    config = tiny.reachability_config(recorded=1.0, horizon=4, learned_steps=4)
    critic = SafetyCritic(1, 1, candidates, config)
    recorded = Recorded(torch.tensor([[1.0], [-1.0], [0.0]]), torch.tensor([1, 2, 2]))
    start = lambda n: {"x": torch.full((n, 1), 0.6), FRAME: torch.zeros(n, dtype=torch.long)}  # noqa: E731
    learner = LatentReachability(WindyChain(), critic, start, config, recorded=recorded)
    visited = learner.pool["x"] / critic.projection + critic.feature_mean
    torch.testing.assert_close(visited.view(4, -1)[:, 0], torch.tensor([0.6, 0.65, 0.6, 0.6]))
    tried = learner.pool["action"] if candidates is None else candidates.T.expand(len(visited), -1)
    torch.testing.assert_close(learner.pool["next_l"], visited + 0.05 * tried)
    assert (learner.pool["worst"] == -1).all()  # what was tried and not done bounds nothing
    assert math.isfinite(learner.update()["critic_loss"])


@pytest.mark.parametrize("recorded", [-0.1, 1.1, float("nan")])
def test_a_share_as_recorded_that_is_none_is_refused(recorded):
    with pytest.raises(ValueError, match=r"--policy.reachability.recorded is .*a share, 0 to 1"):
        ReachabilityConfig(recorded=recorded)


def test_fewer_than_one_local_update_are_refused():
    with pytest.raises(ValueError, match=r"--policy.reachability.local_updates is 0; expected at least 1"):
        ReachabilityConfig(local_updates=0)


def test_q_is_the_value_after_the_action():
    learner = small_learner(WindyChain(), torch.tensor([[-1.0], [1.0]]))
    pool = learner.pool
    x = pool["x"] / learner.critic.projection + learner.critic.feature_mean  # one feature, one component
    for k, action in enumerate((-1.0, 1.0)):
        after = WindyChain().step({"x": x}, torch.full_like(x, action))["x"]
        torch.testing.assert_close(pool["next_l"][:, k], after.squeeze(-1))
    target = learner._td_target(pool, 0.0)  # gamma 0: Q(z, a) = l(z')
    torch.testing.assert_close(target, pool["next_l"])


def untrained_critic(bias=0.0):
    critic = SafetyCritic(1, 1, torch.tensor([[-1.0], [1.0]]), ReachabilityConfig(critic_hidden=(8,)))
    with torch.no_grad():
        critic.q[-1].weight.zero_()
        critic.q[-1].bias.fill_(bias)
    return critic


def test_look_ahead_finds_the_exact_safe_set_without_a_trained_critic():
    x = torch.linspace(-0.9, 0.9, 37)[:, None]
    value, action = look_ahead(WindyChain(), {"x": x}, torch.tensor([[-1.0], [1.0]]), 20)
    assert torch.equal(value > 0, x[:, 0] >= WindyChain.threshold)
    assert (action[value > 0] == 1).all()


def test_look_ahead_of_nothing_is_the_critic():
    critic, latent = untrained_critic(0.3), {"x": torch.linspace(-0.9, 0.9, 7)[:, None]}
    value, action = look_ahead(WindyChain(), latent, critic.held_actions(), 0, critic)
    torch.testing.assert_close(value, latent["x"][:, 0].clamp(max=0.3))
    torch.testing.assert_close(action, critic.fallback(latent["x"]))


@pytest.mark.parametrize(("bias", "safe"), [(0.9, True), (-0.9, False)])
def test_look_ahead_leaves_what_comes_after_to_the_critic(bias, safe):
    latent = {"x": torch.tensor([[0.8]])}
    critic = untrained_critic(bias)
    value, _ = look_ahead(WindyChain(), latent, critic.held_actions(), 2, critic)
    assert (value > 0).item() == safe


def test_look_ahead_keeps_what_is_not_finite():
    value, _ = look_ahead(WindyChain(), {"x": torch.tensor([[math.nan], [0.8]])}, torch.tensor([[-1.0], [1.0]]), 3)
    assert value.isnan().tolist() == [True, False]


def test_held_actions_move_only_what_varies():
    config = ReachabilityConfig(critic_hidden=(8,), actor_hidden=(8,))
    critic = SafetyCritic(4, 3, None, config, torch.tensor([-0.5, 0, -1]), torch.tensor([1.0, 0, 0.25]))
    assert critic.held_actions().tolist() == [[0, 0, 0], [1, 0, 0], [0, 0, 0.25], [-0.5, 0, 0], [0, 0, -1]]


def test_critic_reads_principal_components_on_one_scale():
    torch.manual_seed(0)
    features = torch.randn(500, 6) * torch.tensor([10.0, 5.0, 1e-3, 1e-3, 1e-3, 1e-3]) + 7
    critic = SafetyCritic(6, 1, torch.tensor([[-1.0], [1.0]]), ReachabilityConfig(components=3))
    critic.set_projection(features)
    x = critic.project(features)
    assert x.shape == (500, 3) and x.mean(0).abs().max() < 1e-4
    assert x[:, 0].std() > 1.5 * x[:, 1].std() > 1000 * x[:, 2].std()  # noise is not blown up
    torch.testing.assert_close(x.square().mean(), torch.tensor(1.0), rtol=0.02, atol=0.0)


def test_what_has_ended_cannot_fail_any_more():
    class EndingChain(WindyChain):
        def ended(self, latent):
            return latent["x"].squeeze(-1) > 0.5

    learner = small_learner(EndingChain(), torch.tensor([[-1.0], [1.0]]))
    pool, over = learner.pool, learner.pool["ended"]
    assert over.any() and not over.all()
    with torch.no_grad():  # a critic that calls everything doomed
        learner.target.q[-1].weight.zero_()
        learner.target.q[-1].bias.fill_(-5.0)
    target = learner._td_target(pool, 0.99)
    torch.testing.assert_close(target[over], pool["next_l"][over])
    not_taken = torch.ones_like(over).scatter(1, pool["choice"][:, None], False)
    doomed = target[~over & not_taken]
    assert (doomed < -0.9).all() and (doomed >= -1).all()  # no margin is lower than -1


def trajectory(margins, ended, last_x=7.0):
    """Rows of one imagined trajectory of single actions, as `imagine` collects them."""
    steps = range(len(margins))
    return [
        {
            "choice": torch.zeros(1, dtype=torch.long),
            "next_l": torch.tensor([[margins[t]]]),
            "ended": torch.tensor([[ended[t]]]),
            "next_x": torch.full((1, 1, 1), last_x if t == steps[-1] else float(t)),
        }
        for t in steps
    ]


def test_outcome_of_a_trajectory_is_its_worst_margin_from_there_on():
    rows = trajectory([0.5, -0.1, 0.4, 0.2], [False] * 4)
    LatentReachability._add_outcomes(rows)
    assert [row["worst"].item() for row in rows] == pytest.approx([-0.1, -0.1, 0.2, 0.2])
    assert all(row["end_x"].item() == 7.0 and not row["end_over"].item() for row in rows)


def test_outcome_stops_where_the_episode_is_over():
    rows = trajectory([0.5, 0.3, -0.9, 0.2], [False, True, False, False])  # anew from a fresh start after the second
    LatentReachability._add_outcomes(rows)
    assert [row["worst"].item() for row in rows] == pytest.approx([0.3, 0.3, -0.9, 0.2])
    assert [row["end_over"].item() for row in rows] == [True, True, False, False]
    assert [row["end_x"].item() for row in rows] == [1.0, 1.0, 7.0, 7.0]


def test_what_was_achieved_bounds_the_target_from_below():
    learner = small_learner(WindyChain(), torch.tensor([[-1.0], [1.0]]))
    pool, taken = learner.pool, learner.pool["choice"][:, None]
    with torch.no_grad():
        learner.target.q[-1].weight.zero_()
        learner.target.q[-1].bias.fill_(-0.05)
    target = learner._td_target(pool, 0.999).gather(1, taken).squeeze(1)
    achieved = pool["worst"].clamp(max=-0.05)
    assert (target >= achieved - 1e-6).all() and (target <= pool["next_l"].gather(1, taken).squeeze(1) + 1e-6).all()


def test_overestimates_weigh_more_than_underestimates():
    learner = small_learner(WindyChain(), None, caution=3.0)
    assert learner._cautious_loss(torch.tensor([0.2, -0.2])).item() == pytest.approx((3 + 1) * 0.04 / 2)


def test_frozen_commands_are_never_moved():
    config = tiny.reachability_config()
    critic = SafetyCritic(3, 2, None, config, low=torch.tensor([-1.0, 0.0]), high=torch.tensor([1.0, 0.0]))
    action = critic.fallback(torch.randn(40, 3))
    assert action[:, 1].eq(0).all() and action[:, 0].ne(0).any()


def test_divergence_is_noticed():
    learner = small_learner(WindyChain(), torch.tensor([[-1.0], [1.0]]))
    learner.pool["next_l"].fill_(float("nan"))
    with pytest.raises(FloatingPointError, match="critic loss is nan at step 1"):
        learner.update()


def test_privileged_imagination_is_the_car():
    states = torch.tensor([[0.1, -0.2, 0.4], [0.8, 0.9, -2.0]])
    after = DubinsImagination().step({"state": states}, torch.tensor([[1.0], [-0.4]]))["state"]
    expected = car.step(states.numpy().astype(float), np.array([1.25, -0.5]))
    np.testing.assert_allclose(after, expected, atol=1e-6)
    np.testing.assert_allclose(DubinsImagination().margin({"state": states}), car.margin(states.numpy()), atol=1e-6)


def test_a_short_privileged_run_is_far_better_than_always_safe():
    config = ReachabilityConfig(
        critic_hidden=(64, 64), steps=700, batch_size=256, pool=20_000, refresh=200, gamma=0.999, lr=2e-3
    )
    monitor = PrivilegedMonitor(*train_privileged(config, seed=0))
    rng = np.random.default_rng(0)
    states = rng.uniform([-1.1, -1.1, -np.pi], [1.1, 1.1, np.pi], (3000, 3))
    truth = exact_value(states) > 0
    learned = confusion(monitor.value(states) > 0, truth)["balanced_accuracy"]
    assert confusion(np.ones(3000, bool), truth)["balanced_accuracy"] == pytest.approx(0.5)
    assert learned > 0.85
    margin_alone = confusion(car.margin(states) > 0, truth)["balanced_accuracy"]
    assert learned > margin_alone
