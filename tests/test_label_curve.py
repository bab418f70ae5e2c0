"""The study behind the curve of margin quality against labels: its rounds, and what it calls all labels."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from lerobot_latentsafe.experiments import label_curve
from lerobot_latentsafe.training import fit_margin, load_with_cache


@pytest.fixture(scope="module")
def study(tiny_world_model, cache_meta):
    policy, reader = load_with_cache(tiny_world_model, cache_meta)
    policy.config.change(margin=replace(policy.config.margin, clips=128))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(label_curve, "BLOCK", 1)  # 14 episodes only
        patch.setattr(label_curve, "fit_margin", partial(fit_margin, steps=30))
        yield label_curve.Study(policy.model, reader)


def test_held_out_episodes_are_never_labelled(study):
    assert study.pool.tolist() == [e for e in range(14) if e % 5 != 4]
    assert set(study.episode[study.held_out]) == {4, 9}


def test_orders_differ_only_in_between(study, monkeypatch):
    """What is labelled first is the same, and so is everything in the end."""
    labelled, fit = [], type(study).fit

    def noted(self, episodes, seed):
        labelled.append(list(episodes))
        return fit(self, episodes, seed)

    monkeypatch.setattr(type(study), "fit", noted)
    random, suggested = (study.curve(order, seed=0) for order in (False, True))
    rounds = len(random)
    assert labelled[0] == labelled[rounds] and set(labelled[rounds - 1]) == set(labelled[-1]) == set(study.pool)
    assert all(set(a) <= set(b) for a, b in zip(labelled[rounds:], labelled[rounds + 1 :]))
    assert all(np.isfinite(list(curve.values())).all() for curve in (random, suggested))
    assert random["0.02"] == suggested["0.02"]
