"""What machines other than this one ask for: a lock that they can install, and no 64-bit floats, which mps lacks."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from test_decisions import FILE, FILTERS, decide_all
from test_ranks import ACTIONS, WORLD_MODELS, learn_reachability, train_world_model
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.reachability import LatentReachability
from lerobot_latentsafe.shield import Shield

LOCK = Path(__file__).parents[1] / "requirements.lock"


class NoDoubles(TorchDispatchMode):
    """Raises where a tensor of 64-bit floats is computed."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        for made in tree_leaves(result):
            assert not isinstance(made, torch.Tensor) or made.dtype != torch.float64, f"{function} makes 64-bit floats"
        return result


@pytest.fixture
def watched(monkeypatch):
    """What a device computes in a decision and in a training step; loading weights and statistics is the host's."""

    def watch(owner, name):
        inner = getattr(owner, name)

        def run(*args, **kwargs):
            with NoDoubles():
                return inner(*args, **kwargs)

        monkeypatch.setattr(owner, name, run)

    for owner, name in (
        (Shield, "__call__"), (LatentSafePolicy, "forward"), (torch.Tensor, "backward"), (torch.optim.SGD, "step"),
        (LatentReachability, "__init__"), (LatentReachability, "update"),
    ):  # fmt: skip
        watch(owner, name)


def test_doubles_are_noticed():
    with NoDoubles(), pytest.raises(AssertionError, match="64-bit"):
        torch.zeros(2).double()


@pytest.mark.parametrize("name", FILTERS)
def test_no_decision_needs_doubles(name, watched):
    with np.load(FILE) as recorded:
        keys = [key for key in recorded if key.startswith(f"{name}/") and key.count("/") == 1]
        decide_all(name, "committed", {key.removeprefix(f"{name}/"): recorded[key][:4] for key in keys})
    assert not [key for key, value in load_filter(name).state_dict().items() if value.dtype == torch.float64]


@pytest.mark.parametrize("name", WORLD_MODELS)
def test_no_step_of_a_world_model_needs_doubles(name, watched, cache_root, token_root):
    train_world_model(cache_root if name == "rssm" else token_root, name)


@pytest.mark.parametrize("actions", ACTIONS)
def test_no_step_of_a_critic_needs_doubles(actions, watched, cache_root):
    learn_reachability(cache_root, actions)


def test_the_lock_holds_names_versions_and_markers_and_says_what_is_for_linux_alone():
    lines = LOCK.read_text().splitlines()
    assert [line for line in lines if not re.fullmatch(r"[a-z0-9-]+==[\w.]+( ; sys_platform [!=]= '\w+')?", line)] == []
    only_linux = [line for line in lines if re.match("nvidia-|cuda-|triton", line)]
    assert only_linux and all(line.endswith(" ; sys_platform == 'linux'") for line in only_linux)
