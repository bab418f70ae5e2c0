"""The questions put to a world model, on worlds whose answers are known."""

import numpy as np
import pytest
import tiny
import torch

from lerobot_latentsafe.cli.evaluate import EvalWorldModel
from lerobot_latentsafe.cli.places import PolicySource
from lerobot_latentsafe.evaluation import world_model as questions
from lerobot_latentsafe.evaluation.world_model import balanced_accuracy, evaluate_world_model


@pytest.fixture
def policy(token_root):
    changes = dict(world_model=tiny.gru_config(), fallback_action_candidates=None, margin_weight=0.0)
    return tiny.new_policy(tiny.metadata(token_root), **changes)


def episodes(policy):
    return np.unique(policy.reader.labels.episode)


def test_every_number_is_there_and_finite(policy):
    row = evaluate_world_model(policy.model, policy.reader, episodes(policy), n_windows=32)
    assert set(row["errors"]) == {"step 1", "step 5", "step 10"}
    assert all(np.isfinite(v) for numbers in row["errors"].values() for v in numbers.values())
    assert row["episodes"]["failing"] + row["episodes"]["safe"] <= len(episodes(policy))
    assert row == evaluate_world_model(
        policy.model, policy.reader, episodes(policy), n_windows=32
    )  # equal seed, equal answer


def test_model_that_ignores_the_action_is_found_out(policy):
    with torch.no_grad():
        for weight in policy.model.world_model.action_in.parameters():
            weight.zero_()
    errors = questions.prediction_errors(
        policy.model, policy.reader, episodes(policy), 64, torch.Generator().manual_seed(0)
    )
    assert errors["step 10"]["shuffled / true"] == pytest.approx(1, abs=1e-4)


def test_model_that_copies_is_as_good_as_copying(policy):
    with torch.no_grad():
        policy.model.world_model.change[-1].weight.zero_()
    errors = questions.prediction_errors(
        policy.model, policy.reader, episodes(policy), 64, torch.Generator().manual_seed(0)
    )
    assert errors["step 5"]["copied / true"] == pytest.approx(1, abs=1e-5)


def test_alarmist_has_the_balanced_accuracy_of_chance(policy):
    with torch.no_grad():
        policy.model.margin.net[-1].weight.zero_()
        policy.model.margin.net[-1].bias.fill_(-1.0)
    row = questions.imagined_episodes(
        policy.model, policy.reader, episodes(policy), torch.Generator().manual_seed(0), 30
    )
    assert row["verdicts"] == 0.5 and row["false_alarms"]["k"] == row["safe"]
    assert row["hold_false_alarms"]["k"] == row["failing"] + row["safe"]


def test_failures_are_foreseen_along_the_way_by_who_sees_them(policy, monkeypatch):
    labels = policy.reader.labels
    row = questions.foreseen_along(policy.model, policy.reader, episodes(policy))
    assert row["failing"] > 0 and row["safe"] > 0 and row["missed"]["n"] == row["failing"]
    for says, missed, alarms in ((True, 0, row["safe"]), (False, row["failing"], 0)):
        monkeypatch.setattr(questions, "_fails", lambda p, latent, action, valid: np.full(len(action), says))  # noqa: B023
        told = questions.foreseen_along(policy.model, policy.reader, episodes(policy))
        assert (told["missed"]["k"], told["false_alarms"]["k"]) == (missed, alarms)
    safe = [e for e in episodes(policy) if not (labels.failure[labels.episode == e] == 1).any()]
    assert questions.foreseen_along(policy.model, policy.reader, np.array(safe))["missed"] is None


def test_what_is_foreseen_along_the_way_rests_on_the_filters_memory(policy, monkeypatch):
    heard = []
    monkeypatch.setattr(
        questions, "_fails", lambda p, latent, action, valid: heard.append(latent) or np.zeros(len(action), bool)
    )
    for policy.config.law.history_frames in (0, 8):
        questions.foreseen_along(policy.model, policy.reader, episodes(policy))
    whole, short = heard[: len(heard) // 2], heard[len(heard) // 2 :]
    same = [torch.equal(a["hidden"], b["hidden"]) for a, b in zip(whole, short)]
    assert all(same[:4]) and not any(same[4:])


def test_what_fails_after_the_horizon_counts_as_safe(policy):
    ask = lambda steps: evaluate_world_model(policy.model, policy.reader, episodes(policy), n_windows=8, horizon=steps)  # noqa: E731
    soon, later = ask(1)["episodes"], ask(30)["episodes"]
    assert soon["failing"] < later["failing"] and sum(soon[k] - later[k] for k in ("failing", "safe")) == 0


def test_a_horizon_of_no_step_is_refused_before_anything_is_loaded():
    with pytest.raises(ValueError, match="--horizon is 0; expected at least 1"):
        EvalWorldModel(PolicySource("nowhere"), horizon=0).run()


def test_balanced_accuracy_needs_both_classes():
    predicted = np.array([True, True, False, False])
    assert balanced_accuracy(predicted, np.array([1, 1, 0, 0])) == 1
    assert balanced_accuracy(predicted, np.array([1, 1, 1, 0])) == pytest.approx((2 / 3 + 1) / 2)
    assert np.isnan(balanced_accuracy(predicted, np.ones(4)))


def test_short_episodes_are_named(policy, monkeypatch):
    monkeypatch.setattr(questions, "HORIZONS", (1, 500))
    with pytest.raises(ValueError, match="no episode has 504 frames"):
        questions.prediction_errors(policy.model, policy.reader, episodes(policy), 8, torch.Generator())
