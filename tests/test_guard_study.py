"""The study of the guard, on a few episodes of the car."""

import pytest
import tiny

from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.experiments.guard_study import alarms, caught, load_recorded
from lerobot_latentsafe.guarding import new_guard


@pytest.fixture(scope="module")
def study(dataset_root):
    meta = tiny.metadata(dataset_root)
    policy = new_guard(meta, Contract.read(meta))
    return policy, load_recorded(dataset_root, [0, 1, 2, 3], policy.config.trained_on.cameras)


def test_the_episodes_that_a_guard_was_made_of_are_healthy(study):
    policy, episodes = study
    found = alarms(policy, iter(episodes))
    assert found["episodes"] == 4 and found["ticks"] == sum(map(len, episodes))
    assert found["false_alarms"] == 0 and found["reasons"] == {} and found["tick_cpu_ms"] > 0


@pytest.mark.parametrize("fault", ["range", "frozen", "black", "late", "joints swapped"])
def test_faults_are_noticed(study, fault):
    policy, episodes = study
    found = caught(policy, [episode for episode in episodes if len(episode) > 20], fault, 2)
    assert found["injected"] == found["caught"] == 2
