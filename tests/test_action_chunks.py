"""Chunks of actions made off the control thread."""

import threading
from collections import deque
from types import SimpleNamespace

import pytest
import torch

from lerobot_latentsafe.action_chunks import ChunksAhead
from lerobot_latentsafe.base_policy import BasePolicy

STATE = "observation.state"


class Clock:
    """Plans to do at each tick what the time will be then."""

    def __init__(self, length=6, **further):
        self.config = SimpleNamespace(type="clock", n_action_steps=length, **further)
        self.threads, self.planned = set(), []
        self.reset()

    def reset(self):
        self._queues = {STATE: deque(maxlen=2), "action": deque(maxlen=self.config.n_action_steps)}

    def select_action(self, batch):
        self._queues[STATE].append(batch[STATE])
        if not self._queues["action"]:
            self._queues["action"].extend(self.predict_action_chunk(batch).unbind(1))
        return self._queues["action"].popleft()

    def predict_action_chunk(self, batch):
        assert not torch.is_grad_enabled()
        self.threads.add(threading.current_thread())
        now = self._queues[STATE][-1]
        self.planned.append(now[0].item())
        return torch.stack([now + i for i in range(self.config.n_action_steps)], 1)


def seen(tick):
    return {STATE: torch.full((2, 1), float(tick))}


@pytest.mark.parametrize("ahead", [1, 2, 4])
def test_every_action_is_of_its_tick(ahead):
    policy = Clock()
    chunks = ChunksAhead(policy, ahead)
    assert [chunks.act(seen(t))[0].item() for t in range(20)] == list(range(20))
    assert threading.main_thread() not in policy.threads


def test_after_an_override_the_next_chunk_is_of_what_is_seen_then():
    policy = Clock()
    chunks = ChunksAhead(policy, 2)
    for t in range(3):
        chunks.act(seen(t))
    chunks.replan()
    assert [chunks.act(seen(t))[0].item() for t in range(3, 12)] == list(range(3, 12))
    assert policy.planned[:2] == [0, 2]
    for t in range(12, 15):  # and again, at every tick
        assert chunks.act(seen(t))[0].item() == t
        chunks.replan()


def test_an_episode_starts_anew():
    chunks = ChunksAhead(Clock(), 2)
    for t in range(4):
        chunks.act(seen(t))
    chunks.policy.reset()
    chunks.reset()
    assert chunks.act(seen(100))[0].item() == 100


def test_what_goes_wrong_in_the_other_thread_is_raised_in_this_one():
    policy = Clock()
    policy.predict_action_chunk = lambda batch: 1 / 0
    chunks = ChunksAhead(policy, 2)
    with pytest.raises(ZeroDivisionError):
        chunks.act(seen(0))
    del policy.predict_action_chunk
    assert chunks.act(seen(1))[0].item() == 1  # once


@pytest.mark.parametrize("further", [{"horizon": 8, "n_obs_steps": 2}, {"chunk_size": 7}], ids=["diffusion", "act"])
def test_a_policy_that_plays_little_of_its_plan_plays_later_parts_of_it(further):
    policy = Clock(2, **further)
    chunks = ChunksAhead(policy, 1)
    assert [chunks.act(seen(t))[0].item() for t in range(9)] == list(range(9))
    chunks._next.result()
    assert policy.planned == [0, 0, 2, 4, 6, 8], "a chunk is played for two ticks"
    assert policy.config.n_action_steps == 2


def test_plans_must_be_long_enough():
    with pytest.raises(ValueError, match=r"base_ahead is 5.*plans 6 actions.*at most 4"):
        ChunksAhead(Clock(), 5)


def test_a_diffusion_policy_plans_the_same_in_the_other_thread():
    observation = {STATE: torch.zeros(1, 2), "observation.environment_state": torch.tensor([[-0.9, 0.1]])}
    observation["observation.image"] = torch.zeros(1, 3, 128, 128)
    actions = []
    for ahead in (0, 2):
        base = BasePolicy.load("dubins_diffusion_reckless", ahead=ahead)
        torch.manual_seed(0)
        actions.append(torch.cat([base.propose(observation) for _ in range(4)]))
    assert torch.allclose(*actions, atol=1e-6)
