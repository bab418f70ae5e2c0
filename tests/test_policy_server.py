"""LeRobot's asynchronous policy server: our types are on its list, and one of them acts there."""

import pickle
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import tiny

from lerobot_latentsafe.franka.actions import ACTION_NAMES, STATE_NAMES
from lerobot_latentsafe.runtime.policy_server import serve_types


@pytest.fixture
def known(monkeypatch):
    """The list of a server whose packages are installed."""
    constants = ModuleType("lerobot.async_inference.constants")
    constants.SUPPORTED_POLICIES = ["act"]
    monkeypatch.setitem(sys.modules, "lerobot.async_inference", ModuleType("lerobot.async_inference"))
    monkeypatch.setitem(sys.modules, constants.__name__, constants)
    return constants.SUPPORTED_POLICIES


def test_types_are_served_once(known):
    for _ in range(2):
        serve_types(["latentsafe", "latentsafe_dreamer"])
    assert known == ["act", "latentsafe", "latentsafe_dreamer"]


def test_without_its_packages_there_is_no_server(monkeypatch):
    monkeypatch.setitem(sys.modules, "lerobot.async_inference", None)
    monkeypatch.delitem(sys.modules, "lerobot.async_inference.constants", raising=False)
    serve_types(["latentsafe"])


def test_a_filter_acts_on_the_server(tmp_path, monkeypatch):
    pytest.importorskip("grpc")
    monkeypatch.chdir(tmp_path)  # the server logs into a folder of where it is imported
    from lerobot.async_inference.configs import PolicyServerConfig
    from lerobot.async_inference.helpers import RemotePolicyConfig, TimedObservation
    from lerobot.async_inference.policy_server import PolicyServer
    from lerobot.policies.factory import make_pre_post_processors

    from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

    folder = tiny.save_franka_filter(tmp_path / "filter")
    for pipeline in make_pre_post_processors(LatentSafePolicy.from_pretrained(folder).config):
        pipeline.save_pretrained(folder)
    state = {"dtype": "float32", "shape": (len(STATE_NAMES),), "names": STATE_NAMES}
    picture = {"dtype": "image", "shape": (32, 32, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": state, **{f"observation.images.{name}": picture for name in ("front", "wrist")}}
    server, client = PolicyServer(PolicyServerConfig()), SimpleNamespace(peer=lambda: "robot")
    server.Ready(None, client)
    wanted = RemotePolicyConfig("latentsafe", str(folder), features, 5, "cpu")
    server.SendPolicyInstructions(SimpleNamespace(data=pickle.dumps(wanted)), client)
    image = np.random.default_rng(0).integers(0, 255, (32, 32, 3), dtype=np.uint8)
    seen = {**dict.fromkeys(STATE_NAMES, 0.1), "front": image, "wrist": image, "task": "pluck"}
    (action,) = server._predict_action_chunk(TimedObservation(0.0, 0, seen, must_go=True))
    assert action.get_action().shape == (len(ACTION_NAMES),) and action.get_action().isfinite().all()
