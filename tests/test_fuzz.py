"""Random observations, actions, base policies and settings: nothing unusable passes, every error says what is wrong.

Some hundred examples in the test suite; `scripts/fuzz.py` tries ten thousand.
"""

import json
import shutil
from collections import Counter

import faulty
import fuzzing
import pytest
import torch
from draccus.utils import DecodingError
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from test_faults_base_policies import UNKNOWN, Pipeline, Policy, raises

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.configuration_latentsafe import SEALED
from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.guard import UnknownPoseError
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.runtime.locations import CheckpointError

OUTCOMES: Counter[str] = Counter()
"""What came of the examples, for `scripts/fuzz.py`."""
NAMES = st.sampled_from(["car that forgets", "two cameras", "joint targets"])
some = settings(deadline=None, suppress_health_check=list(HealthCheck), phases=[Phase.generate])


def note(outcome):
    OUTCOMES[outcome] += 1


def assert_harmless(bench, decision, usable):
    """What is executed is finite and in the data's range; what is unusable does not pass."""
    units = bench.policy.model.units
    within = 1e-4 + (torch.tensor(bench.policy.config.trained_on.displacement_high) if bench.targets else 0.0)
    assert decision.action.shape == bench.wanted.shape and decision.action.isfinite().all()
    assert ((decision.action >= units.action_low - within) & (decision.action <= units.action_high + within)).all()
    passed = decision.reason == Reason.PASSED
    assert not (passed & decision.intervened).any()
    if usable is False:  # of several robots one may be broken
        assert not passed.all()
    if usable is True:
        assert passed.all()
    note("passed" if passed.any() else Reason(decision.reason.max().item()).name)


def assert_typed(bench, error, first):
    """An error is one of ours, and says what is wrong."""
    assert isinstance(error, KeyError | ValueError | UnknownPoseError), repr(error)
    assert first or isinstance(error, UnknownPoseError) or "within an episode" in str(error), repr(error)
    assert len(str(error)) > 40, repr(error)
    note(type(error).__name__)


@some
@given(data=st.data(), name=NAMES, healthy_before=st.integers(0, 2))
def test_no_observation_passes_that_is_not_usable(benches, data, name, healthy_before):
    bench = benches[name].begin(healthy_before)
    for t in range(healthy_before, healthy_before + data.draw(st.integers(1, 3))):
        seen, usable = data.draw(fuzzing.observations(bench.see(t)))
        try:
            decision = bench.shield(seen, bench.wanted.clone())
        except Exception as e:
            assert_typed(bench, e, first=not bench.shield.guard.begun)
        else:
            assert_harmless(bench, decision, usable)


@some
@given(data=st.data(), name=NAMES, epsilon=st.sampled_from([faulty.PASSES_ALL, faulty.PASSES_NOTHING]))
def test_no_action_passes_that_is_none(benches, data, name, epsilon):
    bench = benches[name].begin(1)
    bench.policy.config.law.epsilon = epsilon
    proposed, usable = data.draw(fuzzing.actions(bench.wanted))
    usable = False if epsilon == faulty.PASSES_NOTHING else usable
    assert_harmless(bench, bench.shield(bench.see(1), proposed), usable)


@some
@given(data=st.data(), name=NAMES)
def test_no_answer_of_a_base_policy_gets_through(benches, data, name):
    bench = benches[name].begin()
    policy = Policy(bench.wanted)
    bench.policy._base = [BasePolicy(policy, Pipeline(), Pipeline(), origin=UNKNOWN)]
    bench.policy._base_lost = False
    try:
        bench.policy.reset()
        for t in range(3):
            answer, usable = data.draw(fuzzing.actions(bench.wanted))
            policy.act = lambda batch, answer=answer: answer
            if data.draw(st.booleans()):
                policy.act, usable = raises(data.draw(fuzzing.ERRORS)), False
            usable = None if t and usable else usable  # to come back may be a jump
            assert_harmless(bench, bench.policy.decide(bench.see(t)), usable)
    finally:
        bench.policy._base = []


@pytest.fixture(scope="module")
def folder(tiny_filter, tmp_path_factory):
    return shutil.copytree(tiny_filter, tmp_path_factory.mktemp("fuzzed") / "filter")


@some
@given(data=st.data())
def test_no_edited_setting_lets_a_filter_pass_what_is_unusable(benches, folder, tiny_filter, data):
    config = json.loads((tiny_filter / "config.json").read_text())
    where, key = config, data.draw(st.sampled_from(sorted(config)))
    if isinstance(config[key], dict) and config[key] and data.draw(st.integers(0, 3)):
        where, group = config[key], key
        key = data.draw(st.sampled_from(sorted(where)))
    else:
        group = key
    before, where[key] = where[key], data.draw(fuzzing.JSON)
    (folder / "config.json").write_text(json.dumps(config))
    try:
        policy = load_filter(folder).eval()
    except (CheckpointError, ValueError, DecodingError) as e:
        assert len(str(e)) > 20
        return note(f"config: {type(e).__name__}")
    assert group not in SEALED or json.dumps(where[key]) == json.dumps(before), "what is sealed was changed"
    bench = faulty.Bench(policy, benches["car"].see, benches["car"].wanted, benches["car"].stay)
    bench.shield.clock = faulty.standing_still
    seen = bench.see(0)
    policy.shield(seen, bench.wanted)
    seen["observation.state"][:] = torch.nan
    decision = policy.shield(seen, bench.wanted)
    assert not decision.reason.eq(Reason.PASSED).any()
    note("config: accepted")
