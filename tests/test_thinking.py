"""Compiled graphs decide as torch does; and wherever there is none, or it fails, torch decides, and that is said."""

import sys
import time

import numpy as np
import pytest
import tiny
import torch
from test_decisions import FILE, FILTERS

from lerobot_latentsafe.decision import LawOptions, Reason
from lerobot_latentsafe.encoders.perception import Perception
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.runtime.hub import save_policy
from lerobot_latentsafe.runtime.onnx_graph import Graph
from lerobot_latentsafe.shield import Shield

PICTURE, STATE = "observation.images.front", "observation.state"
WORLD_MODELS = {
    "rssm": lambda: tiny.rssm_config(),
    "categorical rssm": lambda: tiny.rssm_config(classes=4),
    "gru": lambda: tiny.gru_config(summary=4),
    "gru of every third frame": lambda: tiny.gru_config(frame_skip=3),
    "dino_wm": lambda: tiny.dino_wm_config(),
    "dino_wm, action beside tokens": lambda: tiny.dino_wm_config(conditioning="concat"),
    "dino_wm that remembers": lambda: tiny.dino_wm_config(
        frame_skip=3,
        frame_token=True,
        memory=16,
        merge_patches=2,
        perception=tiny.perception_config(token_components=4),
    ),
}
LAWS = {
    "critic alone": {"lookahead": 0},
    "look ahead": {"lookahead": 4, "proposal_steps": 2},
    "plan": {"name": "plan", "lookahead": 3},
    "margin": {"name": "margin"},
    "nearest": {"name": "nearest", "epsilon": 0.99, "kappa": 2.0},
    "short history": {"history_frames": 4, "lookahead": 2},
}


@pytest.fixture(autouse=True)
def compiling():
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    yield
    Perception.use_graphs(False)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Name of a world model -> folder of a filter with random weights."""
    made = {}

    def folder(name):
        if name not in made:
            folder = tmp_path_factory.mktemp("arm")
            tiny.save_arm_filter(folder / "raw", world_model=WORLD_MODELS[name]())
            policy = LatentSafePolicy.from_pretrained(folder / "raw")
            fit(policy.model.world_model.frozen_perception())
            save_policy(policy, folder / "filter")
            made[name] = folder / "filter"
        return made[name]

    return folder


def fit(perception):
    """Principal components of noise."""
    if perception is not None:
        generator = torch.Generator().manual_seed(0)
        images = {key: torch.rand(40, 3, 32, 32, generator=generator) for key in perception.image_keys}
        perception.fit(perception.see(images))


def load(folder, **law):
    policy = load_filter(folder)
    policy.config.change(law=policy.config.law.changed(LawOptions(**law)))
    return policy


def decide(policy, n=6, robots=1):
    """Decisions of a new shield on noise."""
    shield = Shield(policy.model, clock=standing_still)
    shield.warm_up()
    return shield, [shield(seen(t, robots), proposed(robots)) for t in range(n)]


def seen(t=0, robots=1):
    generator = torch.Generator().manual_seed(t)
    return {
        PICTURE: torch.rand(robots, 3, 32, 32, generator=generator),
        STATE: torch.tensor([tiny.ARM_POSE]).repeat(robots, 1),
    }


def proposed(robots=1):
    return torch.tensor([tiny.ARM_POSE]).repeat(robots, 1) + torch.tensor([[2.0, -1.0, 0.5]])


def same(one, other, tolerance=1e-4):
    for a, b in zip(one, other, strict=True):
        for name in ("value", "margin", "action"):
            torch.testing.assert_close(getattr(a, name), getattr(b, name), atol=tolerance, rtol=0, equal_nan=True)
        assert torch.equal(a.reason, b.reason) and torch.equal(a.intervened, b.intervened)


# -- equal decisions ---

CASES = [(name, "look ahead") for name in WORLD_MODELS] + [("rssm", law) for law in LAWS if law != "look ahead"]
CASES += [("dino_wm that remembers", "nearest"), ("dino_wm that remembers", "short history")]


@pytest.mark.parametrize(("name", "law"), CASES)
def test_graphs_decide_as_torch_does(folders, name, law):
    _, expected = decide(load(folders(name), **LAWS[law]))
    shield, decided = decide(load(folders(name), **LAWS[law], engine="onnx"))
    assert shield.nearest.thinking.compiled
    same(decided, expected)


def test_what_the_law_nearest_asks_is_compiled(folders, monkeypatch):
    policy = load(folders("rssm"), **LAWS["nearest"], engine="onnx")
    shield, _ = decide(policy, 1)
    assert [hold.roughly for hold in shield.nearest.thinking.holds] == [True, False]
    monkeypatch.setattr(
        type(policy.model), "value_of_holding", lambda *given, **options: pytest.fail("torch was asked")
    )
    assert shield(seen(7), proposed()).unsafe


@pytest.mark.parametrize("name", FILTERS)
def test_graphs_decide_on_recorded_episodes_as_torch_does(name):
    with np.load(FILE) as file:
        inputs = [key for key in file if key.startswith(f"{name}/") and key.count("/") == 1]
        rows = {key.removeprefix(f"{name}/"): file[key][:, :1] for key in inputs}
    said = {}
    for engine in ("torch", "onnx"):
        policy = load_filter(name, law=LawOptions(engine=engine, samples=0))  # a graph draws nothing
        shield = Shield(policy.model, clock=standing_still)
        shield.warm_up()
        assert shield.nearest.thinking.compiled == (engine == "onnx")
        said[engine] = []
        for t, action in enumerate(torch.from_numpy(rows["action"])):
            scale = {key: 255 if value.dtype == np.uint8 else 1 for key, value in rows.items()}
            shown = {key: torch.from_numpy(value[t]).float() / scale[key] for key, value in rows.items()}
            said[engine].append(shield({key: value for key, value in shown.items() if key != "action"}, action))
    for one, other in zip(said["torch"], said["onnx"]):
        assert torch.equal(one.reason, other.reason)
        torch.testing.assert_close(one.value, other.value, atol=1e-4, rtol=0)


# -- what is no number stays none ---


def test_numbers_that_are_none_go_through_a_graph_as_through_torch():
    def function(module, x, y):
        largest, place = x.max(0)
        return {
            "amax": x.amax(1), "amin": x.amin(0), "max": largest, "place": place, "both": torch.minimum(x, y),
            "either": torch.maximum(x, y), "clamped": x.clamp(-1, 1), "summed": torch.tanh(x).sum(0),
            "known": torch.where(x.abs() <= 2, x, torch.nan), "any": torch.max(x, y),
        }  # fmt: skip

    x, y = torch.rand(5, 4), torch.rand(5, 4)
    graph = Graph(torch.nn.Identity(), function, {"x": x, "y": y})
    for i, j in ((0, 0), (2, 1), (4, 3)):
        x[i, j] = torch.nan
        expected, said = function(None, x, y), graph({"x": x, "y": y})
        for name in expected.keys() - {"place"}:
            torch.testing.assert_close(said[name], expected[name], equal_nan=True, msg=name)


def test_an_absurd_critic_is_no_number_in_a_graph_either(folders):
    policy = load(folders("rssm"), **LAWS["look ahead"], engine="onnx")
    with torch.no_grad():
        policy.model.critic.q[-1].bias.fill_(100.0)
    shield, decided = decide(policy, 2)
    assert shield.nearest.thinking.compiled
    assert all(d.reason == Reason.VALUE_NOT_FINITE and d.intervened for d in decided)


# -- torch decides instead ---


def missing(policy, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    return "onnxruntime is missing: pip install"


def lies(policy, monkeypatch):
    truth = Graph.__call__
    monkeypatch.setattr(Graph, "__call__", lambda self, given: {k: v + 1 for k, v in truth(self, given).items()})
    return "it says another"


def draws(policy, monkeypatch):
    policy.config.law.samples = 2
    return "law.samples is 2"


@pytest.mark.parametrize("happens", [missing, lies, draws])
def test_where_no_graph_can_be_had_torch_decides_and_that_is_said_once(folders, monkeypatch, caplog, happens):
    policy = load(folders("rssm"), engine="onnx")
    said = happens(policy, monkeypatch)
    torch.manual_seed(0)
    shield, decided = decide(policy, 3)
    assert not shield.nearest.thinking.compiled
    assert [said in record.message for record in caplog.records if "NOT USED" in record.message] == [True]
    monkeypatch.undo()
    policy.config.law.engine = "torch"
    torch.manual_seed(0)
    same(decided, decide(policy, 3)[1], 0)


def other_law(policy, monkeypatch):
    policy.config.law.lookahead = 1


def other_weights(policy, monkeypatch):
    with torch.no_grad():
        policy.model.margin.net[-1].bias.add_(0.3)


def fails(policy, monkeypatch):
    def raises(self, given):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(Graph, "__call__", raises)


@pytest.mark.parametrize("happens", [other_law, other_weights, fails])
def test_a_graph_that_does_not_hold_any_more_is_left_at_once(folders, monkeypatch, caplog, happens):
    policy = load(folders("rssm"), **LAWS["look ahead"], engine="onnx")
    shield, _ = decide(policy, 0)
    happens(policy, monkeypatch)
    decided = [shield(seen(t), proposed()) for t in range(3)]
    assert sum("NOT USED" in record.message for record in caplog.records) == 1
    monkeypatch.undo()
    policy.config.law.engine = "torch"
    same(decided, decide(policy, 3)[1], 0)


def test_other_weights_are_compiled_when_the_next_episode_begins(folders):
    policy = load(folders("rssm"), engine="onnx")
    shield, _ = decide(policy, 0)
    other_weights(policy, None)
    shield.reset()
    shield.warm_up()
    decided = [shield(seen(t), proposed()) for t in range(3)]
    assert shield.nearest.thinking.compiled
    policy.config.law.engine = "torch"
    same(decided, decide(policy, 3)[1])


def test_several_robots_are_decided_for_by_torch(folders, caplog):
    policy = load(folders("rssm"), engine="onnx")
    _, decided = decide(policy, 3, robots=2)
    assert sum("it decides for one robot" in record.message for record in caplog.records) == 1
    policy.config.law.engine = "torch"
    same(decided, decide(policy, 3, robots=2)[1], 0)


def test_who_sees_nothing_imagines_by_torch_and_nothing_passes(folders):
    policy = load(folders("dino_wm that remembers"), engine="onnx")
    shield, _ = decide(policy, 3)
    dark = seen(3)
    dark[PICTURE][0, 0, 0, 0] = torch.nan
    blind = shield(dark, proposed())
    assert blind.reason == Reason.OBSERVATION_NOT_FINITE and blind.intervened
    assert shield.nearest.thinking.compiled


def test_an_encoder_that_fails_as_a_graph_is_torchs_from_then_on(folders, monkeypatch, caplog):
    policy = load(folders("gru"), engine="onnx")
    decide(policy, 1)
    perception = policy.model.world_model.frozen_perception()
    images = {key: torch.rand(1, 3, 32, 32) for key in perception.image_keys}
    expected = perception.encoder(images[PICTURE]).tokens
    monkeypatch.setattr(Graph, "__call__", lambda self, given: (_ for _ in ()).throw(RuntimeError("gone")))
    torch.testing.assert_close(perception.see(images).tokens, expected)
    assert "THE COMPILED ENCODER FAILED" in caplog.text


# -- late robots ---


@pytest.mark.parametrize(("took", "told"), [(0.001, False), (1.0, True)])
def test_a_robot_that_will_be_late_is_told_before_it_moves(folders, monkeypatch, caplog, took, told):
    shield = Shield(load(folders("rssm")).model, clock=time.perf_counter)
    shield.pace.strict = True
    monkeypatch.setattr(shield, "_rehearse", lambda shade: took)
    shield.warm_up()
    shield.warm_up()
    assert sum("WILL BE LATE" in record.message for record in caplog.records) == told


def test_simulations_wait_and_are_not_told(folders, monkeypatch, caplog):
    shield = Shield(load(folders("rssm")).model, clock=standing_still)
    shield.pace.strict = True
    monkeypatch.setattr(shield, "_rehearse", lambda shade: 1.0)
    shield.warm_up()
    assert "WILL BE LATE" not in caplog.text and np.isfinite(shield.took_s)
