import json
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs import make_env, make_env_pre_post_processors
from lerobot.policies.factory import make_policy, make_pre_post_processors
from safetensors.torch import load_file, save_file

from lerobot_latentsafe import LatentSafeConfig, LatentSafeDubinsEnv
from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.configuration_latentsafe import SEALED
from lerobot_latentsafe.datasets.adoption import adopt_dataset
from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, UntrainedFilterError, adopt
from lerobot_latentsafe.runtime.checkpoint import seal
from lerobot_latentsafe.runtime.hub import save_policy
from lerobot_latentsafe.runtime.locations import CheckpointError, resolve_checkpoint
from lerobot_latentsafe.training import train_reachability

load = LatentSafePolicy.from_pretrained


def assert_same_decisions(first, second):
    for a, b in zip(tiny.drive(first), tiny.drive(second)):
        for name in ("action", "value", "margin", "reason"):
            torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=0, atol=0)


@pytest.fixture
def shielded(policy, tiny_diffusion):
    policy.attach(tiny_diffusion)
    return policy


# -- files ---


def test_loaded_filter_decides_as_the_saved_one(policy, tmp_path):
    policy.config.law.epsilon = 0.01
    save_policy(policy, tmp_path / "again")
    again = load(tmp_path / "again")
    assert again.config.law.epsilon == 0.01 and again.config.trained_on.stage == "critic"
    assert_same_decisions(policy, again)


def test_continuous_filter_survives_saving(tiny_continuous_filter, tmp_path):
    policy = load(tiny_continuous_filter)
    save_policy(policy, tmp_path / "again")
    assert_same_decisions(policy, load(tmp_path / "again"))


def test_half_weights_are_half_as_large_and_decide_alike(policy, tmp_path):
    save_policy(policy, tmp_path / "full")
    save_policy(policy, tmp_path / "half", half=True)
    full, half = (tmp_path / name / "model.safetensors" for name in ("full", "half"))
    assert half.stat().st_size < 0.7 * full.stat().st_size
    assert {t.dtype for t in load_file(half).values()} == {torch.float16}
    loaded = load(tmp_path / "half")
    assert next(loaded.parameters()).dtype == torch.float32
    for a, b in zip(tiny.drive(policy), tiny.drive(loaded)):
        torch.testing.assert_close(a.value, b.value, atol=0.01, rtol=0.05)


def test_truncated_weights_are_refused(filter_copy):
    weights = filter_copy / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-50])
    with pytest.raises(CheckpointError, match=r"truncated.*download it again"):
        load(filter_copy)


def test_one_flipped_bit_is_refused(filter_copy):
    weights = filter_copy / "model.safetensors"
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(content)
    with pytest.raises(CheckpointError, match="changed after saving"):
        load(filter_copy)


@pytest.mark.parametrize("name", ["model.safetensors", "integrity.json"])
def test_missing_file_is_named(filter_copy, name):
    (filter_copy / name).unlink()
    with pytest.raises(CheckpointError, match=f"lacks {name}"):
        load(filter_copy)


@pytest.mark.parametrize("content", ["", "{}", '{"sha256": 3', "[]"])
def test_unreadable_seal_is_refused(filter_copy, content):
    (filter_copy / "integrity.json").write_text(content)
    with pytest.raises(CheckpointError, match=r"integrity.json is not readable"):
        load(filter_copy)


@pytest.mark.parametrize("content", [None, "", '{"type": "latentsafe", "wor'], ids=["missing", "empty", "truncated"])
def test_unreadable_config_is_refused(filter_copy, content):
    config = filter_copy / "config.json"
    config.unlink() if content is None else config.write_text(content)
    with pytest.raises(CheckpointError, match=r"config\.json"):
        load(filter_copy)


@pytest.mark.parametrize("content", [None, '{"type": "diffusion", "hor'], ids=["missing", "truncated"])
def test_unreadable_config_of_a_base_policy_is_refused(tmp_path, content):
    if content is not None:
        (tmp_path / "config.json").write_text(content)
    with pytest.raises(CheckpointError, match=r"config\.json"):
        BasePolicy.load(tmp_path)


def test_stage_edited_by_hand_trains_no_critic(tiny_world_model, tmp_path):
    copy = shutil.copytree(tiny_world_model, tmp_path / "copy")
    tiny.rewrite_group(copy, "trained_on", stage="critic")
    with pytest.raises(CheckpointError, match=r"config\.json"):
        load(copy)


def test_units_edited_by_hand_are_refused(filter_copy):
    tiny.rewrite_group(filter_copy, "trained_on", action_high=[12.5, 1.0])
    with pytest.raises(CheckpointError, match=r"config\.json"):
        load(filter_copy)


@pytest.mark.parametrize("change", ["missing", "unexpected"])
def test_weights_that_do_not_fit_the_config_are_refused(filter_copy, change):
    weights = filter_copy / "model.safetensors"
    tensors = load_file(weights)
    if change == "missing":
        tensors = {k: v for k, v in tensors.items() if not k.startswith("model.critic.q.")}
    else:
        tensors["model.critic.q.99.weight"] = torch.zeros(2)
    save_file(tensors, weights, metadata={"format": "pt"})
    seal(filter_copy, SEALED)
    with pytest.raises(CheckpointError, match=r"(?s)do not fit.*critic\.q"):
        load(filter_copy)


def test_policy_of_another_type_is_no_filter(tiny_diffusion):
    with pytest.raises(
        CheckpointError, match=r"'diffusion' policy, expected a 'latentsafe' filter.*--base_policy_path"
    ):
        load(tiny_diffusion)


def test_nowhere_is_no_checkpoint(tmp_path):
    with pytest.raises(CheckpointError, match="expected a folder, one of"):
        load(tmp_path / "nothing" / "here")


def test_no_path_at_all_asks_for_one():
    with pytest.raises(CheckpointError, match=r"--policy.path=<filter>"):
        load(None)


def test_names_resolve_to_committed_folders(tmp_path, monkeypatch):
    monkeypatch.setattr("lerobot_latentsafe.runtime.locations.PRETRAINED", tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "config.json").write_text("{}")
    assert resolve_checkpoint("mine") == tmp_path / "mine"
    with pytest.raises(CheckpointError, match="one of mine, or a Hub id"):
        resolve_checkpoint("yours")


# -- stages ---


def test_critic_that_was_never_trained_does_not_act(tiny_world_model):
    policy = load(tiny_world_model)
    with pytest.raises(UntrainedFilterError, match=r"'world_model', 'critic' is needed.*train-reachability"):
        policy.select_action(tiny.observation([[0.9, 0.0, 0.0]]))
    with pytest.raises(UntrainedFilterError):
        policy.model.value(policy.model.world_model.initial(1))


def test_world_model_that_was_never_trained_gets_no_critic(cache_meta, tmp_path):
    save_policy(tiny.new_policy(cache_meta), tmp_path / "fresh")
    with pytest.raises(UntrainedFilterError, match=r"'untrained', 'world_model' is needed.*lerobot-train"):
        train_reachability(tmp_path / "fresh", cache_meta, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_policy_from_nothing_says_how_to_train_one():
    with pytest.raises(UntrainedFilterError, match="lerobot-train"):
        LatentSafePolicy(tiny.config())


def test_loaded_filter_cannot_be_trained_without_labels(policy):
    with pytest.raises(UntrainedFilterError, match="needs the dataset's labels"):
        policy.forward({"index": torch.arange(4)})


def test_filter_of_another_checkpoint_is_not_overwritten(tiny_world_model, tiny_filter, cache_meta):
    before = (tiny_filter / "model.safetensors").read_bytes()
    with pytest.raises(FileExistsError, match="another --output_dir"):
        train_reachability(tiny_world_model, cache_meta, tiny_filter, seed=1)
    assert (tiny_filter / "model.safetensors").read_bytes() == before


def test_second_stage_leaves_world_model_and_margin_alone(tiny_world_model, tiny_filter):
    before, after = (load_file(folder / "model.safetensors") for folder in (tiny_world_model, tiny_filter))
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed and all(name.startswith("model.critic.") for name in changed)


def test_equal_seeds_train_equal_filters(tiny_world_model, tiny_filter, cache_meta, tmp_path):
    train_reachability(tiny_world_model, cache_meta, tmp_path / "same", seed=0)
    train_reachability(tiny_world_model, cache_meta, tmp_path / "other", seed=1)
    reference, same, other = (
        load_file(f / "model.safetensors") for f in (tiny_filter, tmp_path / "same", tmp_path / "other")
    )
    assert all(torch.equal(reference[name], same[name]) for name in reference)
    assert not torch.equal(reference["model.critic.q.0.weight"], other["model.critic.q.0.weight"])


def test_second_stage_needs_a_cache(tiny_world_model, dataset_meta, tmp_path):
    with pytest.raises(ValueError, match="run latentsafe cache"):
        train_reachability(tiny_world_model, dataset_meta, tmp_path / "out")


# -- another robot, another dataset ---


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fps": 30}, "fps = 30, this filter was trained with 20"),
        ({"action_names": ["a.vel", "b.vel"]}, r"action_names = \['a.vel', 'b.vel'\].*turn_rate.vel"),
    ],
    ids=["rate", "action names"],
)
@pytest.mark.parametrize("use", ["fine-tuning", "reachability"])
def test_dataset_of_another_robot_is_refused(tiny_world_model, cache_root, tmp_path, use, changes, message):
    other = tiny.altered_dataset(cache_root, tmp_path / "other", **changes)
    with pytest.raises(ValueError, match=message):
        if use == "fine-tuning":
            config = PreTrainedConfig.from_pretrained(tiny_world_model)
            config.frame_cache = None
            load(tiny_world_model, config=config, dataset_meta=other)
        else:
            train_reachability(tiny_world_model, other, tmp_path / "out")


@pytest.mark.parametrize(("low", "high"), [(-71.6, 71.6), (-1.25, 2.0)], ids=["degrees", "faster"])
def test_dataset_of_another_action_range_is_refused(tiny_world_model, cache_meta, low, high):
    config = PreTrainedConfig.from_pretrained(tiny_world_model)
    contract = Contract.read(cache_meta)
    action = contract.action.copy()
    action[:2, 0] = low, high
    with pytest.raises(ValueError, match=r"turn_rate.vel of me/car.*trained on -1\.25 to 1\.25.*unit"):
        adopt_dataset(config.trained_on, replace(contract, action=action))


def test_dataset_of_other_pictures_is_refused(tiny_world_model, dataset_meta):
    config = PreTrainedConfig.from_pretrained(tiny_world_model)
    config.frame_cache, config.input_features["observation.image"].shape = None, (3, 96, 128)
    with pytest.raises(ValueError, match=r"observation\.image has shape \(3, \d+, \d+\).*trained on \(3, 96, 128\)"):
        adopt(config, dataset_meta)


@pytest.mark.parametrize("candidates", [[[9.0, 1.0]], [[0.0, 1.0], [-1.3, 1.0]], [[0.0]], [[0.0, 1.0, 0.0]]])
def test_action_candidates_outside_of_the_data_are_refused(cache_meta, candidates):
    with pytest.raises(ValueError, match=r"action candidate \[.*outside of what me/car covers"):
        tiny.new_policy(cache_meta, fallback_action_candidates=candidates)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trained_on_stage": "done"}, "'done'.*untrained"),
        ({"law_mode": "watch"}, "'watch'.*monitor"),
        ({"margin_delta": 0.0}, "positive"),
    ],
)
def test_bad_options_list_the_good_ones(changes, message):
    with pytest.raises(ValueError, match=message):
        tiny.config(**changes)


def test_dataset_without_actions_is_refused():
    config = tiny.config()
    config.output_features = {}
    with pytest.raises(ValueError, match="needs an action feature"):
        config.validate_features()


def test_units_round_trip(policy):
    action = torch.tensor([[-1.25, 1.0], [0.3, 1.0]])
    torch.testing.assert_close(
        policy.model.units.denormalise_action(policy.model.units.normalise_action(action)), action
    )
    torch.testing.assert_close(policy.model.units.normalise_action(action)[:, 0], torch.tensor([-1.0, 0.24]))
    assert policy.model.units.normalise_action(action)[:, 1].abs().max() < 1e-5  # a constant command sits in the middle


# -- wrapped ---


def test_alone_it_is_the_fallback_policy(policy):
    policy.config.law.lookahead = 0
    batch = tiny.observation([[-0.9, 0.0, 0.0], [0.2, 0.9, 1.0]])
    action = policy.select_action(batch)
    with torch.no_grad():
        expected = policy.model.critic.fallback(policy.model.world_model.features(policy.shield.latent))
    torch.testing.assert_close(action, policy.model.units.denormalise_action(expected))
    policy.reset()
    assert policy.predict_action_chunk(batch).shape == (2, 1, 2)


def test_lookahead_outside_of_what_imagination_can_is_refused():
    for steps in (-1, 26):
        with pytest.raises(ValueError, match=rf"lookahead is {steps}; expected 0"):
            tiny.config(law_lookahead=steps)


def test_proposal_of_no_steps_is_refused():
    with pytest.raises(ValueError, match=r"proposal_steps is 0; expected 1"):
        tiny.config(law_proposal_steps=0)


def test_epsilon_above_everything_always_overrides(shielded):
    shielded.config.law.epsilon = math.inf
    assert all(d.intervened.all() and d.reason.eq(Reason.UNSAFE_VALUE).all() for d in tiny.drive(shielded))


def test_epsilon_below_everything_is_the_bare_policy(shielded):
    shielded.config.law.epsilon = -math.inf
    torch.manual_seed(0)
    decisions = tiny.drive(shielded)
    shielded.base.reset()
    torch.manual_seed(0)
    states = np.array([(-0.9, 0.1, 0.0), (-0.7, -0.3, 0.5)])
    for t, decision in enumerate(decisions):
        torch.testing.assert_close(decision.action, shielded.base.propose(tiny.observation(states)))
        states = tiny.car.step(states, np.full(2, 0.5 * (-1) ** t))
    assert not any(d.intervened.any() for d in decisions)


def test_monitor_mode_is_the_bare_policy_with_verdicts(shielded):
    shielded.config.law.mode, shielded.config.law.epsilon = "monitor", math.inf
    for decision in tiny.drive(shielded):
        torch.testing.assert_close(decision.action, decision.proposed)
        assert decision.unsafe.all() and not decision.intervened.any()


def test_base_policy_replans_after_an_intervention_and_only_then(shielded):
    shielded.config.law.epsilon = -math.inf
    tiny.drive(shielded, n_steps=2)
    planned = list(shielded.base.policy._queues["action"])
    assert len(planned) == 2
    here = tiny.observation([(-0.9, 0.1, 0.0), (-0.7, -0.3, 0.5)])
    assert torch.equal(shielded.decide(here).action[:, 0], shielded.base.postprocessor(planned[0])[:, 0])
    assert len(shielded.base.policy._queues["action"]) == 1
    shielded.config.law.epsilon = math.inf
    shielded.base.policy._queues["action"].append(planned[0])
    shielded.decide(here)
    assert len(shielded.base.policy._queues["action"]) == 0


def test_policy_without_a_known_queue_is_reset_to_replan(shielded, monkeypatch):
    calls = []
    monkeypatch.setattr(shielded.base.policy, "_queues", None)
    monkeypatch.setattr(shielded.base.policy, "reset", lambda: calls.append("reset"))
    shielded.base.replan(torch.zeros(2, tiny.ACTION_DIM))
    assert calls == ["reset"]


def test_base_policy_that_fails_is_replaced_by_the_fallback(shielded, monkeypatch, caplog):
    shielded.config.law.epsilon = -math.inf
    monkeypatch.setattr(shielded.base.policy, "select_action", lambda *_: 1 / 0)
    decision = shielded.decide(tiny.observation([[-0.9, 0.1, 0.0]]))
    assert decision.intervened.all() and decision.reason.eq(Reason.BASE_POLICY_FAILED).all()
    assert decision.action.isfinite().all()
    assert "base policy failed" in caplog.text


def test_base_policy_that_fails_is_an_error_in_monitor_mode(shielded, monkeypatch):
    shielded.config.law.mode = "monitor"
    monkeypatch.setattr(shielded.base.policy, "select_action", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        shielded.decide(tiny.observation([[-0.9, 0.1, 0.0]]))


def test_nan_from_the_base_policy_falls_back(shielded, monkeypatch):
    shielded.config.law.epsilon = -math.inf
    monkeypatch.setattr(shielded.base, "propose", lambda _: torch.tensor([[math.nan, 1.0]]))
    decision = shielded.decide(tiny.observation([[-0.9, 0.1, 0.0]]))
    assert decision.reason.item() == Reason.ACTION_NOT_FINITE and decision.action.isfinite().all()


def test_shields_do_not_nest(policy, tiny_filter):
    with pytest.raises(ValueError, match=r"shields do not nest.*--base_policy_path"):
        policy.attach(tiny_filter)
    assert policy.base is None


def test_base_policy_of_another_action_space_is_refused(policy, tmp_path):
    with pytest.raises(ValueError, match=r"acts in \(3,\), the filter in \(2,\) \(turn_rate.vel, speed.vel\)"):
        policy.attach(tiny.save_diffusion(tmp_path / "three", action_dim=3))
    assert policy.base is None


def test_truncated_base_policy_is_refused(policy, tiny_diffusion, tmp_path):
    base = shutil.copytree(tiny_diffusion, tmp_path / "base")
    weights = base / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-50])
    with pytest.raises(CheckpointError, match=str(base)):
        policy.attach(base)
    assert policy.base is None and policy.config.base_policy_path is None


def test_base_policys_weights_are_not_the_filters(shielded, policy):
    assert not [name for name in shielded.state_dict() if "diffusion" in name]


def test_wrapped_folder_is_self_contained(tiny_filter, tiny_diffusion, tmp_path):
    base = shutil.copytree(tiny_diffusion, tmp_path / "base")
    policy = load(tiny_filter)
    policy.attach(base)
    save_policy(policy, tmp_path / "wrapped")
    shutil.rmtree(base)
    moved = shutil.move(tmp_path / "wrapped", tmp_path / "elsewhere")
    assert json.loads((moved / "config.json").read_text())["base_policy_path"] == "base_policy"
    decisions = []
    for p in (policy, load(moved)):
        torch.manual_seed(0)
        decisions.append(tiny.executed(tiny.drive(p)))
    torch.testing.assert_close(*decisions, rtol=0, atol=0)
    assert policy.config.base_policy_path == str(base)  # saving does not rewrite the policy in memory


def test_wrapped_folder_can_be_wrapped_again(shielded, tmp_path):
    save_policy(shielded, tmp_path / "first", half=True)
    again = load(tmp_path / "first")
    again.config.law.epsilon = 0.25
    save_policy(again, tmp_path / "second")
    third = load(tmp_path / "second")
    assert third.config.law.epsilon == 0.25 and third.base.config.type == "diffusion"


def test_wrapped_folder_without_its_base_policy_is_refused(shielded, tmp_path):
    save_policy(shielded, tmp_path / "wrapped")
    shutil.rmtree(tmp_path / "wrapped" / "base_policy")
    with pytest.raises(CheckpointError, match="base_policy"):
        load(tmp_path / "wrapped")


# -- through LeRobot's own commands ---


@pytest.fixture
def wrapped(shielded, tmp_path):
    shielded.config.law.epsilon = 0.0
    save_policy(shielded, tmp_path / "wrapped")
    return tmp_path / "wrapped"


@pytest.mark.parametrize("variant", ["continuous", "discrete"])
def test_lerobot_evaluates_a_wrapped_folder(wrapped, variant):
    from lerobot.scripts.lerobot_eval import eval_policy

    env_config = LatentSafeDubinsEnv(variant=variant, episode_length=5)
    config = PreTrainedConfig.from_pretrained(wrapped)
    config.pretrained_path = wrapped
    policy = make_policy(config, env_cfg=env_config).eval()
    assert isinstance(policy, LatentSafePolicy) and policy.base is not None
    outer = make_pre_post_processors(config, pretrained_path=str(wrapped))
    env = next(iter(make_env(env_config, n_envs=2).values()))[0]
    around_env = make_env_pre_post_processors(env_cfg=env_config, policy_cfg=config)
    result = eval_policy(env, policy, *around_env, *outer, n_episodes=2, start_seed=0)
    assert len(result["per_episode"]) == 2
    assert policy.shield.decision is not None
    env.close()


def test_base_policy_is_chosen_on_the_command_line(tiny_filter, tiny_diffusion):
    config = PreTrainedConfig.from_pretrained(tiny_filter, cli_overrides=[f"--base_policy_path={tiny_diffusion}"])
    config.pretrained_path = tiny_filter
    policy = make_policy(config, env_cfg=LatentSafeDubinsEnv())
    assert policy.base.config.type == "diffusion"
    assert "observation.environment_state" in policy.config.input_features


def test_type_without_a_path_asks_for_a_filter(tiny_diffusion):
    config = LatentSafeConfig(base_policy_path=str(tiny_diffusion), device="cpu")
    with pytest.raises((CheckpointError, UntrainedFilterError), match=r"--policy.path"):
        make_policy(config, env_cfg=LatentSafeDubinsEnv())


def test_outer_processors_change_no_number(tiny_filter):
    config = PreTrainedConfig.from_pretrained(tiny_filter)
    before, after = make_pre_post_processors(config, pretrained_path=str(tiny_filter))
    batch = tiny.observation([[-0.9, 0.1, 0.4]])
    processed = before(dict(batch))
    for key, value in batch.items():
        torch.testing.assert_close(processed[key], value)
    action = torch.tensor([[1.2, 1.0]])
    torch.testing.assert_close(after(action), action)


def test_fallback_moves_only_the_commands_it_may(cache_meta):
    both = tiny.new_policy(cache_meta, fallback_action_candidates=None)
    assert (both.model.critic.high > both.model.critic.low).tolist() == [True, False]  # the speed never varies
    none = tiny.new_policy(cache_meta, fallback_action_candidates=None, fallback_moves=["speed.vel"])
    assert not (none.model.critic.high > none.model.critic.low).any()
    one_way = tiny.new_policy(
        cache_meta, fallback_action_candidates=None, fallback_moves=["-turn_rate.vel"]
    ).model.critic
    assert (one_way.low.tolist(), one_way.high.tolist()) == ([-1, 0], [0, 0])
    assert one_way.held_actions().tolist() == [[0, 0], [-1, 0]]
    with pytest.raises(ValueError, match=r"no action is named lift; there are turn_rate\.vel"):
        tiny.new_policy(cache_meta, fallback_action_candidates=None, fallback_moves=["lift"])
    with pytest.raises(ValueError, match=r"no action is named -turn_rate\.vel"):
        tiny.new_policy(cache_meta, fallback_action_candidates=None, fallback_moves=["--turn_rate.vel"])
