"""SQRL: the same learner with another target, and a filter that never takes one value for the other."""

import json
import math
import shutil

import draccus
import pytest
import tiny
import torch
from test_reachability import CHAIN, WindyChain

from lerobot_latentsafe.configuration_latentsafe import CriticTargetError
from lerobot_latentsafe.critic import SafetyCritic, risk_bellman_target
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.reachability import LatentReachability
from lerobot_latentsafe.runtime.locations import CheckpointError
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.training import train_reachability


def test_target_is_the_papers_with_the_sign_of_a_value():
    margin, next_risk, gamma = torch.tensor([0.5, 0.5, -0.1]), torch.tensor([0.0, 0.4, 0.4]), 0.9
    c = (margin < 0).float()
    expected = c + (1 - c) * gamma * next_risk
    torch.testing.assert_close(-risk_bellman_target(margin, -next_risk, gamma), expected)


def test_nothing_ahead_is_no_risk_and_no_number_is_a_failure():
    margin = torch.tensor([0.5, -0.5, math.nan])
    target = risk_bellman_target(margin, torch.full((3,), torch.inf), 0.9)
    assert target.tolist() == [0.0, -1.0, -1.0]


@pytest.mark.parametrize("gamma", [0.0, 0.5, 0.99])
def test_backup_is_a_contraction_onto_risks(gamma):
    l, v, w = torch.randn(200), -torch.rand(200), -torch.rand(200)
    backed, other = risk_bellman_target(l, v, gamma), risk_bellman_target(l, w, gamma)
    assert (backed >= -1).all() and (backed <= 0).all()
    assert (backed - other).abs().max() <= gamma * (v - w).abs().max() + 1e-6


@pytest.fixture(scope="module")
def risk_critic():
    torch.manual_seed(0)
    critic = SafetyCritic(1, 1, torch.tensor([[-1.0], [0.0], [1.0]]), CHAIN, target="risk")
    learner = LatentReachability(WindyChain(), critic, lambda n: {"x": 2 * torch.rand(n, 1) - 1}, CHAIN)
    for _ in range(CHAIN.steps):
        learner.update()
    return critic


def test_learned_risk_is_high_where_failure_is_bound_to_come(risk_critic):
    x = torch.linspace(-0.95, 0.95, 191)[:, None]
    x = x[(x - WindyChain.threshold).abs().squeeze() > 0.05]
    with torch.no_grad():
        risk = -risk_critic.value(x, x.squeeze(-1))
    doomed = x.squeeze(-1) < WindyChain.threshold
    assert (risk[x.squeeze(-1) < 0] == 1).all()
    assert risk[doomed].mean() > 0.7 and risk[~doomed].mean() < 0.1


@pytest.fixture(scope="module")
def risk_filter(tiny_world_model, cache_meta, tmp_path_factory):
    folder = tmp_path_factory.mktemp("risk") / "filter"
    train_reachability(tiny_world_model, cache_meta, folder, target="risk")
    return folder


def test_trained_target_is_kept_and_read_as_risk(risk_filter):
    policy = LatentSafePolicy.from_pretrained(risk_filter)
    law = policy.config.law
    assert policy.config.trained_on.target == law.name == "risk" and law.lookahead == 0
    for decision in tiny.drive(policy):
        assert (decision.value >= -1).all() and (decision.value <= 0).all()


def test_law_intervenes_at_the_threshold_of_risk(risk_filter, tiny_diffusion, monkeypatch):
    policy = LatentSafePolicy.from_pretrained(risk_filter)
    policy.attach(tiny_diffusion)
    # Margins are positive, and the fallback's risk is 0.3 everywhere.
    monkeypatch.setattr(type(policy.model.margin), "bounded", lambda self, z: torch.full(z.shape[:-1], 0.5))
    monkeypatch.setattr(policy.model.critic, "best_q", lambda x: torch.full(x.shape[:-1], -0.3))
    for threshold, acts in ((0.29, True), (0.3, True), (0.31, False)):
        policy.config.law.epsilon = -threshold
        assert all(d.intervened.all() == acts and d.intervened.any() == acts for d in tiny.drive(policy, 2))


def test_risk_is_not_read_as_a_safety_value(risk_filter):
    policy = LatentSafePolicy.from_pretrained(risk_filter)
    policy.config.law.name = "reachability"
    wrong = r"law\.name is 'reachability'.*trained for 'risk'.*--policy\.law\.name=risk"
    with pytest.raises(CriticTargetError, match=wrong):
        tiny.drive(policy)


def test_safety_value_is_not_read_as_a_risk(policy):
    policy.config.law.name, policy.config.law.lookahead = "risk", 0
    with pytest.raises(CriticTargetError, match=r"law\.name is 'risk'.*trained for 'reachability'"):
        tiny.drive(policy)


def test_law_on_the_command_line_is_refused_when_loading(risk_filter):
    from lerobot.configs.policies import PreTrainedConfig

    with pytest.raises(draccus.ParsingError) as refused:
        PreTrainedConfig.from_pretrained(risk_filter, cli_overrides=["--law.name=reachability"])
    assert "trained for 'risk'" in str(refused.value.__cause__)


def test_baselines_without_a_critic_go_with_either(risk_filter):
    policy = LatentSafePolicy.from_pretrained(risk_filter)
    for law in ("plan", "margin"):
        policy.config.law.name = law
        tiny.drive(policy, 2)


def test_target_edited_by_hand_is_refused(risk_filter, tmp_path):
    copy = shutil.copytree(risk_filter, tmp_path / "copy")
    config = json.loads((copy / "config.json").read_text())
    groups = {"trained_on": {"target": "reachability"}, "law": {"name": "reachability"}}
    tiny.rewrite_json(copy / "config.json", **{name: config[name] | edit for name, edit in groups.items()})
    with pytest.raises(CheckpointError, match="was edited"):
        LatentSafePolicy.from_pretrained(copy)


def test_unknown_target_lists_the_known_ones(tiny_world_model, cache_meta, tmp_path):
    with pytest.raises(ValueError, match="target is 'cost'; expected one of reachability, risk"):
        train_reachability(tiny_world_model, cache_meta, tmp_path / "filter", target="cost")


def test_risk_has_no_lookahead():
    with pytest.raises(ValueError, match="lookahead is 15; a risk"):
        tiny.config(law_name="risk")


def test_the_worst_of_the_samples_counts(policy):
    start = policy.model.world_model.initial(2)
    policy.config.law.samples, policy.config.law.lookahead = 6, 0
    policy.shield.reset()
    latents, least = policy.model.go_on(start, torch.zeros(2, 1, tiny.ACTION_DIM))
    assert len(least) == 12 and len(latents["h"]) == 12
    torch.manual_seed(4)
    decision = tiny.drive(policy, 1)[0]
    torch.manual_seed(4)
    values = []
    original = SafetyModel.plan

    def plan(self, latent):
        value, action = original(self, latent)
        values.append(value)
        return value, action

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SafetyModel, "plan", plan)
        again = tiny.drive(policy, 1)[0]
    torch.testing.assert_close(again.value, decision.value)
    worst = values[0][:12].view(6, 2).amin(0)
    assert (again.value <= worst + 1e-6).all()


def test_no_samples_is_what_it_was(policy):
    one = tiny.executed(tiny.drive(policy))
    torch.testing.assert_close(one, tiny.executed(tiny.drive(policy)))
    with pytest.raises(ValueError, match="samples is -1"):
        policy.config.law.changed(LawOptions(samples=-1))
