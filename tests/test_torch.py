"""The filter among torch's own ways: precision, autocast, copies, compilation, weights that were never loaded."""

import copy
import io
import logging
import pickle

import numpy as np
import pytest
import tiny
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import make_policy

from lerobot_latentsafe import LatentSafeDubinsEnv
from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, UntrainedFilterError


@pytest.fixture
def shielded(policy, tiny_diffusion):
    policy.attach(tiny_diffusion)
    policy.config.law.epsilon = 0.0
    return policy


def decided(policy):
    torch.manual_seed(0)
    return tiny.drive(policy)


def assert_same(first, second):
    for a, b in zip(first, second, strict=True):
        for name in ("action", "value", "margin", "reason"):
            torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=0, atol=0)


def by_torch_save(policy):
    file = io.BytesIO()
    torch.save(policy, file)
    file.seek(0)
    return torch.load(file, weights_only=False)


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda policy: pickle.loads(pickle.dumps(policy)), by_torch_save],
    ids=["deepcopy", "pickle", "torch.save"],
)  # fmt: skip
def test_a_copy_decides_alike_and_shares_nothing(shielded, copied):
    expected = decided(shielded)
    again = copied(shielded)
    assert_same(decided(again), expected)
    again.config.law.epsilon = 2.0
    next(again.parameters()).data.add_(1.0)
    assert_same(decided(shielded), expected)
    assert again.shield.adopt({}, torch.zeros(1, 2)) is None  # it compares weights anew


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_under_autocast_it_decides_alike(policy, dtype):
    expected = decided(policy)
    with torch.autocast("cpu", dtype=dtype):
        assert_same(decided(policy), expected)


def test_under_autocast_a_base_policy_runs_mixed_and_is_judged_in_single_precision(shielded):
    with torch.autocast("cpu", dtype=torch.bfloat16):
        decisions = decided(shielded)
    assert all(decision.value.dtype == decision.action.dtype == torch.float32 for decision in decisions)
    assert not any(decision.reason.eq(Reason.BASE_POLICY_FAILED).any() for decision in decisions)


@pytest.mark.parametrize("kind", ["rssm", "categorical rssm", "gru", "dino_wm"])
def test_it_trains_in_mixed_precision_under_autocast(kind, cache_meta, token_root):
    """As lerobot-train asks for by --policy.use_amp=true, and accelerate by --mixed_precision=bf16."""
    changes = {
        "rssm": {}, "categorical rssm": {"world_model": tiny.rssm_config(classes=4)},
        "gru": {"world_model": tiny.gru_config()}, "dino_wm": {"world_model": tiny.dino_wm_config()},
    }[kind]  # fmt: skip
    losses, slopes = [], []
    for mixed in (False, True):
        torch.manual_seed(0)
        meta = cache_meta if "rssm" in kind else tiny.metadata(token_root)
        policy = tiny.new_policy(meta, **changes).train()
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=mixed):
            torch.manual_seed(1)
            loss, _ = policy.forward({"index": torch.arange(8)})
        loss.backward()
        losses.append(loss)
        slopes.append(torch.cat([p.grad.flatten() for p in policy.get_optim_params() if p.grad is not None]))
    assert losses[1].dtype == torch.float32
    assert not torch.equal(*losses)
    torch.testing.assert_close(losses[1], losses[0], rtol=0.05, atol=0)
    assert torch.nn.functional.cosine_similarity(*slopes, dim=0) > 0.95


@pytest.mark.parametrize(
    "convert",
    [lambda p: p.to(torch.bfloat16), lambda p: p.half(), lambda p: p.double(), lambda p: p.to("cpu", torch.float16)],
)
def test_another_precision_is_refused(policy, convert):
    expected = decided(policy)
    with pytest.raises(TypeError, match=r"single precision.*Leave the dtype out"):
        convert(policy)
    assert_same(decided(policy), expected)


def test_to_a_device_it_goes(policy):
    expected = decided(policy)
    assert_same(decided(policy.to("cpu").float()), expected)


def test_compiled_it_decides_alike(policy):
    """lerobot-rollout --use_torch_compile=true compiles `predict_action_chunk`."""
    batch = tiny.observation([[-0.9, 0.1, 0.0]])
    policy.reset()
    expected = policy.predict_action_chunk(batch)
    policy.reset()
    compiled = torch.compile(policy.predict_action_chunk, backend="eager")
    assert torch.equal(compiled(batch), expected)
    policy.reset()
    assert torch.equal(torch.compile(policy, backend="eager").predict_action_chunk(batch), expected)


def test_random_weights_never_decide(tiny_filter):
    """LeRobot makes random weights of a configuration that was read by itself."""
    config = PreTrainedConfig.from_pretrained(tiny_filter)
    policy = make_policy(config, env_cfg=LatentSafeDubinsEnv())
    for decide in (policy.select_action, policy.decide, policy.predict_action_chunk):
        with pytest.raises(UntrainedFilterError, match=r"random weights.*from_pretrained.*pretrained_path"):
            decide(tiny.observation([[-0.9, 0.1, 0.0]]))
    config.pretrained_path = tiny_filter
    assert_same(
        decided(make_policy(config, env_cfg=LatentSafeDubinsEnv())),
        decided(LatentSafePolicy.from_pretrained(tiny_filter)),
    )


def test_an_evaluation_in_mid_training_stands_still_and_says_so_once(cache_meta, caplog):
    policy = tiny.new_policy(cache_meta)
    with caplog.at_level(logging.WARNING):
        actions = [policy.select_action(tiny.observation([[-0.9, 0.1, 0.0]] * 3)) for _ in range(2)]
    assert all(np.array_equal(action, policy.model.limits.hold(np.zeros((3, 2), np.float32))) for action in actions)
    assert caplog.text.count("the robot stands still") == 1 and "--env_eval_freq=0" in caplog.text


def test_real_time_chunking_is_refused_with_the_other_way(policy, caplog):
    assert policy.supports_rtc() is False
    assert "--robot.type=latentsafe_shielded" in caplog.text
