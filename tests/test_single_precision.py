"""Apple's GPUs have no 64-bit floats: nothing on the way of a decision or a training step may need them."""

import numpy as np
import pytest
import tiny
import torch
from test_decisions import FILE, FILTERS, decide_all
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.reachability import LatentReachability
from lerobot_latentsafe.shield import Shield
from lerobot_latentsafe.training import encoded_starts

MODELS = {"rssm": tiny.rssm_config, "gru": tiny.gru_config, "dino_wm": tiny.dino_wm_config}


class NoDoubles(TorchDispatchMode):
    """Notes operations that give 64-bit floats."""

    def __init__(self):
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        out = function(*args, **(kwargs or {}))
        if any(isinstance(t, torch.Tensor) and t.dtype in (torch.float64, torch.complex128) for t in tree_leaves(out)):
            self.found.append(str(function))
        return out


@pytest.fixture(params=MODELS)
def trainable(request, cache_meta, token_root):
    meta = cache_meta if request.param == "rssm" else tiny.metadata(token_root)
    return tiny.new_policy(meta, world_model=MODELS[request.param](), fallback_action_candidates=None).train()


def test_world_model_and_margin_are_trained_in_single_precision(trainable):
    with NoDoubles() as seen:
        loss, _ = trainable.forward({"index": torch.arange(8)})
        loss.backward()
    assert seen.found == []


def test_reachability_is_learned_in_single_precision(trainable):
    trainable.eval()
    config = tiny.reachability_config()
    with NoDoubles() as seen:
        starts = encoded_starts(trainable.model, trainable.reader, torch.Generator().manual_seed(0))
        learner = LatentReachability(trainable.model.imagination, trainable.model.critic, starts, config)
        for _ in range(3):
            learner.update()
    assert seen.found == []


@pytest.mark.parametrize("law", ["reachability", "plan", "margin"])
def test_decisions_are_made_in_single_precision_whatever_the_robot_sends(tiny_continuous_filter, law):
    policy = load_filter(tiny_continuous_filter)
    policy.config.law.name = law
    seen = tiny.observation([[-0.9, 0.1, 0.0]])
    seen = {key: value.double() for key, value in seen.items()}
    proposed = torch.tensor([[0.3, 1.0]], dtype=torch.float64)
    with NoDoubles() as doubles:
        for action in (proposed, None):
            assert policy.shield(seen, action).action.dtype == torch.float32
    assert doubles.found == []


@pytest.mark.parametrize("name", FILTERS)
def test_committed_filters_decide_in_single_precision(name, monkeypatch):
    doubles = NoDoubles()
    decide = Shield.__call__

    def watched(*args, **kwargs):
        with doubles:
            return decide(*args, **kwargs)

    monkeypatch.setattr(Shield, "__call__", watched)
    with np.load(FILE) as recorded:
        keys = [key for key in recorded if key.startswith(f"{name}/") and key.count("/") == 1]
        decide_all(name, "committed", {key.removeprefix(f"{name}/"): recorded[key][:4] for key in keys})
    assert doubles.found == []
    assert not [key for key, value in load_filter(name).state_dict().items() if value.dtype == torch.float64]
