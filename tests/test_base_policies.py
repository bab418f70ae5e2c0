"""Any policy of LeRobot under a filter: it acts as it does bare, replans, is saved, copied and planned ahead."""

import copy
import json
import logging
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import tiny_policies
import torch
from lerobot.configs.policies import PreTrainedConfig
from tiny_policies import COUNTING, STATE, WHOLE, seen

from lerobot_latentsafe._compat import observation_queues, queued_actions
from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.origin import FILE, Origin
from lerobot_latentsafe.runtime.hub import save_policy
from lerobot_latentsafe.runtime.locations import CheckpointError

NO_CHUNKS = {
    "act, averaged": "makes no chunks", "gaussian_actor": "makes no chunks", "tdmpc, repeated": "plans 1 actions",
    "tdmpc, no search": "plans 1 actions",
}  # fmt: skip


class Identity:
    """A pipeline that changes nothing."""

    steps = ()

    def __call__(self, given):
        return given

    def reset(self):
        pass


def base_of(policy, ahead=0, **known):
    return BasePolicy(policy, Identity(), Identity(), ahead, **known)


def test_every_type_of_lerobot_is_tried():
    known = {name for name in PreTrainedConfig.get_known_choices() if not name.startswith("latentsafe")}
    assert known == {*COUNTING, *(kind for kind, *_ in WHOLE.values())}


# -- LeRobot's own queues, with networks that only count ---


@pytest.mark.parametrize("kind", COUNTING)
def test_after_an_override_the_next_action_is_of_what_is_seen_then(kind):
    base = base_of(tiny_policies.counting(kind))
    assert [base.propose(seen(t))[0, 0].item() for t in range(6)] == list(range(6))
    for tick in (106, 207, 308, 309):  # after overrides in mid chunk, and at every tick
        base.replan(torch.zeros(2, 1))
        assert base.propose(seen(tick))[0, 0].item() == tick
    assert [base.propose(seen(t))[0, 0].item() for t in range(310, 320)] == list(range(310, 320))


@pytest.mark.parametrize("kind", COUNTING)
def test_what_was_seen_is_kept_and_what_was_planned_is_not(kind):
    base = base_of(tiny_policies.counting(kind))
    base.reset()
    for tick in range(3):
        base.propose(seen(tick))
    before = {key: list(past) for key, past in observation_queues(base.policy).items()}
    base.replan(torch.zeros(2, 1))
    assert not queued_actions(base.policy)
    after = {key: list(past) for key, past in observation_queues(base.policy).items()}
    assert before.keys() == after.keys() and all(len(before[key]) == len(after[key]) for key in before)


@pytest.mark.parametrize("kind", COUNTING)
def test_chunks_are_made_ahead_of_what_they_are_played_for(kind):
    if kind == "lingbot_va":
        with pytest.raises(ValueError, match="makes no chunks that can be begun ahead"):
            base_of(tiny_policies.counting(kind), ahead=1)
        return
    base = base_of(tiny_policies.counting(kind), ahead=1)
    actions = [base.propose(seen(t)) for t in range(9)]
    assert [tuple(action.shape) for action in actions] == [(2, 1)] * 9
    assert [action[0, 0].item() for action in actions] == list(range(9))
    base.replan(torch.zeros(2, 1))  # begins to plan on tick 8
    assert [base.propose(seen(t))[0, 0].item() for t in range(9, 12)] == [9, 10, 11]
    base.chunks.settle()
    assert base.config.n_action_steps == tiny_policies.PLAYED


def test_a_chunk_of_another_shape_is_refused():
    policy = tiny_policies.counting("act")
    plan = policy.predict_action_chunk
    policy.predict_action_chunk = lambda batch: plan(batch).transpose(0, 1)
    with pytest.raises(ValueError, match=r"chunk of shape \(6, 2, 1\); expected \(2, .*base_ahead=0"):
        base_of(policy, ahead=1).propose(seen(0))


def test_a_policy_that_is_not_lerobots_is_reset_and_that_is_said_once(caplog):
    calls = []
    policy = SimpleNamespace(config=SimpleNamespace(type="theirs"), name="theirs", reset=lambda: calls.append(1))
    base = base_of(policy)
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            base.replan(torch.zeros(1, 2))
    assert len(calls) == 3 and caplog.text.count("how the base policy (theirs) forgets a plan is not known") == 1


# -- whole policies under a filter ---


@pytest.fixture(scope="session", params=WHOLE)
def whole(request, tmp_path_factory):
    """Name and folder of a tiny policy."""
    folder = tmp_path_factory.mktemp("base") / "policy"
    return request.param, tiny_policies.save_whole(request.param, folder)


def bare(folder, ticks=6):
    """What LeRobot's loop would do with the policy: (T, B, A)."""
    base = BasePolicy.load(folder)
    base.policy.reset()
    torch.manual_seed(0)
    states, actions = np.array([(-0.9, 0.1, 0.0), (-0.7, -0.3, 0.5)]), []
    with torch.inference_mode():
        for t in range(ticks):
            batch = base.preprocessor(tiny.observation(states))
            actions.append(base.postprocessor(base.policy.select_action(batch)))
            states = tiny.car.step(states, np.full(2, 0.5 * (-1) ** t))
    return torch.stack(actions)


def driven(policy, ticks=6):
    torch.manual_seed(0)
    return tiny.executed(tiny.drive(policy, ticks))


@pytest.mark.filterwarnings("ignore:To evaluate in the environment")
def test_watched_it_acts_as_it_does_bare_saved_copied_and_pickled(policy, whole, tmp_path):
    _, folder = whole
    policy.attach(folder)
    policy.config.law.mode, policy.config.law.epsilon = "monitor", 2.0
    expected = bare(folder)
    assert torch.equal(driven(policy), expected)
    save_policy(policy, tmp_path / "wrapped")
    for again in (
        LatentSafePolicy.from_pretrained(tmp_path / "wrapped"),
        copy.deepcopy(policy),
        pickle.loads(pickle.dumps(policy)),
    ):
        assert torch.equal(driven(again), expected)


@pytest.mark.filterwarnings("ignore:To evaluate in the environment")
def test_it_plans_anew_after_every_override(policy, whole, monkeypatch):
    name, folder = whole
    policy.attach(folder)
    policy.config.law.epsilon = 2.0
    planned, policy_class = [], type(policy.base.policy)
    entry = "select_action" if name == "gaussian_actor" else "predict_action_chunk"
    plan = getattr(policy_class, entry)
    monkeypatch.setattr(policy_class, entry, lambda *a, **k: planned.append(1) or plan(*a, **k))
    decisions = tiny.drive(policy, 6)
    assert all(decision.intervened.all() for decision in decisions) and len(planned) == 6


@pytest.mark.filterwarnings("ignore:To evaluate in the environment")
def test_it_is_planned_ahead_or_refused(policy, whole):
    name, folder = whole
    policy.config.base_ahead = 1
    if name in NO_CHUNKS:
        with pytest.raises(ValueError, match=NO_CHUNKS[name]):
            policy.attach(folder)
        return
    policy.attach(folder)
    policy.config.law.mode = "monitor"  # in which a failure is raised
    assert all(decision.proposed.shape == (2, tiny.ACTION_DIM) for decision in tiny.drive(policy, 8))
    again = pickle.loads(pickle.dumps(policy))
    assert len(tiny.drive(copy.deepcopy(again), 3)) == 3


# -- names, order, rate ---

NAMES = ["turn_rate.vel", "speed.vel"]


def trained_on(folder, tmp_path, how, **features):
    """Say in some way that a policy was trained on data of such features."""
    names = features.pop("action_names", NAMES)
    if how == FILE:
        (folder / FILE).write_text(json.dumps({"action_names": names, **features}))
        return
    info = {
        "fps": features.get("fps", 20),
        "features": {
            "action": {"shape": [2], "names": {"list": names, "dict": {"motors": names}, "nested": [names]}[how]},
            STATE: {"shape": [2], "names": features.get("state_names")},
        },
    }
    root = tmp_path / "data"
    (root / "meta").mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(info))
    (folder / "train_config.json").write_text(json.dumps({"dataset": {"repo_id": "me/data", "root": str(root)}}))


@pytest.fixture
def act(tmp_path):
    return tiny_policies.save_whole("act", tmp_path / "act")


@pytest.mark.parametrize("how", [FILE, "list", "nested"])
def test_numbers_in_another_order_are_put_in_order(policy, act, tmp_path, how, caplog):
    bare_actions = bare(act)
    heading = ["heading_cos.pos", "heading_sin.pos"]
    trained_on(act, tmp_path, how, action_names=NAMES[::-1], state_names=heading)
    policy.config.law.mode = "monitor"
    policy.attach(act)
    assert "put in order" in caplog.text
    assert torch.equal(driven(policy), bare_actions.flip(-1))
    save_policy(policy, tmp_path / "wrapped")
    (act / "train_config.json").unlink(missing_ok=True)
    again = LatentSafePolicy.from_pretrained(tmp_path / "wrapped")
    assert torch.equal(driven(again), bare_actions.flip(-1)), "the order is known wherever the folder is"


def test_a_state_in_another_order_is_put_in_order(policy, act, tmp_path):
    trained_on(act, tmp_path, "list", state_names=["heading_sin.pos", "heading_cos.pos"])
    policy.attach(act)
    read = []
    policy.base.policy.select_action = lambda batch: read.append(batch[STATE]) or torch.zeros(1, 2)
    observation = tiny.observation([[-0.9, 0.1, 0.5]])
    policy.decide(observation)
    assert torch.allclose(read[0], observation[STATE].flip(-1) / 1.1, atol=1e-5)


def test_what_was_executed_is_told_in_the_policys_own_order():
    told = []
    policy = SimpleNamespace(config=SimpleNamespace(type="theirs"), name="theirs", was_overridden=told.append)
    base = base_of(policy, origin=Origin(action_names=["c", "a", "b"]))
    base.speak(["a", "b", "c"], None)
    base.replan(torch.tensor([[1.0, 2.0, 3.0]]))
    assert told[0].tolist() == [[3.0, 1.0, 2.0]]


@pytest.mark.parametrize(
    ("features", "words"),
    [
        ({"action_names": ["turn_rate.vel", "lift.vel"]}, r"commands turn_rate\.vel, lift\.vel, the filter turn_rate"),
        ({"state_names": ["x.pos", "y.pos"]}, r"reads the state x\.pos, y\.pos, the filter heading_cos"),
        ({"fps": 30}, r"has fps = 30, the filter 20"),
    ],
)
@pytest.mark.parametrize("how", [FILE, "list", "dict"])
def test_a_policy_of_other_data_is_refused(policy, act, tmp_path, how, features, words):
    trained_on(act, tmp_path, how, **features)
    if how == "dict" and "state_names" in features:
        return
    with pytest.raises(ValueError, match=words):
        policy.attach(act)
    assert policy.base is None


@pytest.mark.parametrize("content", ["{", "[]", '{"action_names": [1]}'])
def test_an_unreadable_origin_is_named(act, content):
    (act / FILE).write_text(content)
    with pytest.raises(ValueError, match=FILE):
        BasePolicy.load(act)


@pytest.mark.parametrize("content", ["", "[]", '{"dataset": null}', '{"dataset": {"repo_id": "me/not_here"}}'])
def test_nothing_is_known_of_a_dataset_that_is_not_here(act, content):
    (act / "train_config.json").write_text(content)
    assert BasePolicy.load(act).origin == Origin()


# -- other forms of a policy ---


def test_an_adapter_needs_peft(act, monkeypatch):
    from lerobot.utils import import_utils

    monkeypatch.setitem(import_utils._require_package_cache, "peft", False)
    (act / "adapter_config.json").write_text(json.dumps({"base_model_name_or_path": str(act)}))
    with pytest.raises(CheckpointError, match=r"needs a package that is not here.*lerobot\[peft\]"):
        BasePolicy.load(act)


def test_an_adapter_is_merged_into_what_it_adapts(policy, act, tmp_path):
    peft = pytest.importorskip("peft")
    base = BasePolicy.load(act)
    base.policy.config.pretrained_path = act
    torch.manual_seed(3)
    adapted = base.policy.wrap_with_peft(
        peft.LoraConfig(target_modules=["linear1"], init_lora_weights=False, base_model_name_or_path=str(act))
    )
    folder = tmp_path / "adapter"
    adapted.save_pretrained(folder)
    adapted.config.save_pretrained(folder)
    base.preprocessor.save_pretrained(folder)
    base.postprocessor.save_pretrained(folder)
    policy.attach(folder)
    policy.config.law.mode = "monitor"
    adapted.eval()
    batch = base.preprocessor(tiny.observation([(-0.9, 0.1, 0.0), (-0.7, -0.3, 0.5)]))
    expected = base.postprocessor(adapted.predict_action_chunk(batch)[:, 0])
    actions = driven(policy, 1)
    assert torch.allclose(actions[0], expected, atol=1e-5) and not torch.allclose(
        actions[0], bare(act, 1)[0], atol=1e-3
    )
    save_policy(policy, tmp_path / "wrapped")
    again = driven(LatentSafePolicy.from_pretrained(tmp_path / "wrapped"), 1)
    torch.testing.assert_close(again, actions, atol=1e-5, rtol=0)


def test_an_adapter_of_something_that_is_not_here_is_named(act):
    (act / "adapter_config.json").write_text(json.dumps({"base_model_name_or_path": "./gone"}))
    with pytest.raises(CheckpointError, match=r"\./gone"):
        BasePolicy.load(act)


def test_weights_that_are_not_there_are_named(act):
    (act / "model.safetensors").unlink()
    with pytest.raises(CheckpointError, match="weights unreadable"):
        BasePolicy.load(act)


def test_real_time_chunking_is_refused_with_the_other_way():
    policy = tiny_policies.counting("pi0")
    policy.config.rtc_config = SimpleNamespace(enabled=True)
    with pytest.raises(ValueError, match=r"rtc_config to null.*shield the robot"):
        base_of(policy)


@pytest.mark.parametrize(
    ("kind", "ahead", "words"), [("groot", 0, "shield the robot"), ("pi0", 1, "base_ahead=0"), ("pi0", 0, None)]
)
def test_actions_relative_to_the_state_are_played_as_lerobot_does_or_refused(kind, ahead, words, caplog):
    from lerobot.processor import RelativeActionsProcessorStep

    before = Identity()
    before.steps = [RelativeActionsProcessorStep(enabled=True)]
    if words:
        with pytest.raises(ValueError, match=words):
            BasePolicy(tiny_policies.counting(kind), before, Identity(), ahead)
    else:
        BasePolicy(tiny_policies.counting(kind), before, Identity(), ahead)
        assert "n_action_steps=1" in caplog.text
