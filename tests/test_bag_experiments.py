"""The scripts of the bag's experiments from end to end, on tiny stand-ins and a few steps."""

import importlib.util
import json
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import tiny
import torch
from lerobot.scripts import lerobot_edit_dataset
from test_train import lerobot_train

from lerobot_latentsafe.cli import main as latentsafe
from lerobot_latentsafe.encoders.patch_encoders import EncoderError, load_encoder
from lerobot_latentsafe.evaluation.rollouts import PolicyActor
from lerobot_latentsafe.experiments.bag import demo, demo_filter, out_of_distribution, policies, runs
from lerobot_latentsafe.experiments.demo import STARTING, Demo, where_the_minutes_went
from lerobot_latentsafe.experiments.scene_world import OperatorActor, SceneWorld
from lerobot_latentsafe.franka.actions import ACTION_NAMES, STATE_NAMES, action_limits
from lerobot_latentsafe.franka.bag import BagScene
from lerobot_latentsafe.franka.scenes import SCENES
from lerobot_latentsafe.guard import standing_still
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.reports.html import PRINTED

STEPS, SEEDS = 4, [runs.FIRST_SEED, runs.FIRST_SEED + 1]


@pytest.fixture(scope="module")
def filter_path(tmp_path_factory):
    """A filter that never lets anything pass."""
    return str(tiny.save_franka_filter(tmp_path_factory.mktemp("filter") / "first", scene="bag", law_epsilon=2.0))


@pytest.fixture(scope="module")
def base_path(tmp_path_factory):
    """A diffusion policy with random weights that reads the arm's state."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
    from lerobot.policies.factory import make_pre_post_processors

    n, folder = len(STATE_NAMES), tmp_path_factory.mktemp("base") / "weak"
    features = {
        "observation.state": PolicyFeature(FeatureType.STATE, (n,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (n,)),
    }
    config = tiny.diffusion_config(len(ACTION_NAMES), input_features=features)
    low, high = (torch.tensor(limit, dtype=torch.float32) for limit in action_limits(15))
    stats = {key: {"min": -4 * torch.ones(n), "max": 4 * torch.ones(n)} for key in features}
    DiffusionPolicy(config).save_pretrained(folder)
    for pipeline in make_pre_post_processors(config, dataset_stats={**stats, "action": {"min": low, "max": high}}):
        pipeline.save_pretrained(folder)
    return str(folder)


@pytest.fixture
def script(monkeypatch):
    """Runs a script with the options of its command line, on small pictures and for a few steps."""
    observe = SceneWorld.observe

    def observe_state(world):
        seen = observe(world)
        return {**seen, "observation.environment_state": seen["observation.state"]}

    monkeypatch.setattr(runs, "STEPS", STEPS)
    monkeypatch.setattr(policies, "STEPS", STEPS)
    monkeypatch.setattr(policies, "MIXED_STEPS", STEPS)
    monkeypatch.setattr(SceneWorld, "observe", observe_state)
    monkeypatch.setattr(runs, "BagScene", partial(BagScene, image_size=32))
    runs.bag_scene.cache_clear()

    def run(name, *options):
        spec = importlib.util.spec_from_file_location(name, Path(__file__).parents[1] / "scripts" / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *options])
        module.main()

    yield run
    runs.bag_scene.cache_clear()


def test_policies_are_compared_operators_traced_and_the_demo_tells(script, filter_path, base_path, tmp_path, capsys):
    table = tmp_path / "policies.json"
    options = [f"--weak={base_path}", "--filters", filter_path, "--laws", "margin", "--n=2", f"--output={table}"]
    script("bag_policies", *options, "--n_videos=1")
    rows = json.loads(table.read_text())
    cell = rows["weak"]["margin"][filter_path]
    assert rows["weak"]["bare"]["spilled"]["n"] == cell["spilled"]["n"] == 2 and rows["seeds"] == SEEDS
    assert cell["overridden_share"] == 1.0 and cell["median_first_override"] == 0
    assert rows["filters"] == {filter_path: {"epsilon": 2.0, "guard": 1, "release": -1.0}}
    kept = table.with_suffix(".jsonl").read_text()
    script("bag_policies", *options)
    assert table.with_suffix(".jsonl").read_text() == kept  # nothing was run again
    rows = json.loads(table.read_text())
    script("bag_policies", f"--mixed={base_path}", *options[1:])
    both = json.loads(table.read_text())
    assert both["weak"] == rows["weak"] and both["mixed"]["bare"]["spilled"]["n"] == 2 and both["mixed"]["commit"]
    (tmp_path / "policies_mixed.png").unlink()

    for operator in ("closed_end", "open_end"):
        given = ["--laws", "margin", "--operators", operator, "--n=1", f"--output={tmp_path / operator}.json"]
        script("bag_operators", "--filters", filter_path, *given)
    traces = json.loads((tmp_path / "closed_end.json").read_text())["closed_end"]["traces"]
    assert len(traces) == 1 and len(traces[0]["value"]) == STEPS

    demo.report(tmp_path, "margin", 90.0, {"policies": 1.25, "closed_end": 0.5})
    page, numbers = (tmp_path / "report.html").read_text(), json.loads((tmp_path / "metrics.json").read_text())
    assert page.count("<video") == 1 and page.count("<img") == 3 + PRINTED and "0/2 = 0.0%" in page
    assert numbers["the same, shielded"]["overridden_share"] == 1.0 and "1.5 minutes" in capsys.readouterr().out
    for file in (table, table.with_suffix(".png"), *tmp_path.glob("videos/*.mp4")):  # without a policy
        file.unlink()
    demo.report(tmp_path, "margin", 90.0, {"policies": 1.25, "closed_end": 0.5})
    assert (tmp_path / "report.html").read_text().count("<img") == 2


def test_a_recording_is_replayed_on_every_variant(script, filter_path, tmp_path, monkeypatch):
    output = tmp_path / "out_of_distribution.json"
    options = ["--filters", filter_path, "--law=margin", "--n=1", f"--output={output}"]
    assert out_of_distribution.UNSEEN == ["green", "purple", "cloth", "stiff", "heavy"]
    monkeypatch.setattr(out_of_distribution, "UNSEEN", ["heavy"])
    out_of_distribution.recording.cache_clear()
    script("bag_out_of_distribution", *options)
    rows = json.loads(output.read_text())
    assert rows["red"]["bare"]["spilled"]["k"] == 0 and rows["heavy"]["pooled"]["overridden_share"] == 1.0
    assert rows["law"] == "margin" and rows["filters"][filter_path]["guard"] == 1
    assert len(out_of_distribution.recording(SEEDS[0])) == STEPS and output.with_suffix(".png").exists()


@pytest.fixture
def encoder(tmp_path):
    """A tiny DINOv2 where transformers is installed."""
    return tiny.save_dino(tmp_path / "dino") if importlib.util.find_spec("transformers") else "efficientnet_lite0"


class InThisThread(ThreadPoolExecutor):
    """A scene that drew in one thread cannot be closed in another."""

    def submit(self, function, /, *arguments):
        done = Future()
        done.set_result(function(*arguments))
        return done


def test_the_demo_trains_a_filter_that_sees_by_an_encoder(script, base_path, encoder, tmp_path, monkeypatch):
    """All of its commands, in this process, on episodes of a second."""

    def run(self, what, program, *options):
        ran.append(what.split(":")[0])
        for option in options:
            if option.startswith("--steps="):
                stepped[ran[-1]] = option
        if program == "python":
            script(Path(options[0]).stem, *options[1:])
        elif program == "latentsafe":
            latentsafe(list(options))
        elif program == "lerobot-train":
            lerobot_train(*options, "--policy.margin.clips=16", "--policy.reachability.pool=512")
        else:
            monkeypatch.setattr(sys, "argv", [program, *options])
            lerobot_edit_dataset.main()

    ran, stepped = [], {}
    monkeypatch.setattr(Demo, "run", run)
    monkeypatch.setitem(SCENES, "bag", replace(SCENES["bag"], episode_seconds=4.0, image_size=56))
    monkeypatch.setattr(demo_filter, "SOURCES", ("bag_mix", "bag_lifts"))
    monkeypatch.setattr(demo, "ThreadPoolExecutor", InThisThread)
    size = 2 * load_encoder(encoder).patch
    options = [f"--out={tmp_path / 'demo'}", f"--encoder={encoder}", "--episodes=2", "--n=1", f"--base={base_path}"]
    script("demo_bag", *options, f"--image_size={size}", "--steps=2", "--critic_steps=3")
    assert stepped == {"world model": "--steps=2", "reachability": "--steps=3"}
    assert ran == [
        "collect bag_mix", "collect bag_lifts", "merge", "cache", "world model", "margin", "reachability", "policies",
        "closed_end", "open_end",
    ]  # fmt: skip
    assert "the same, shielded" in json.loads((tmp_path / "demo" / "metrics.json").read_text())
    perception = load_filter(tmp_path / "demo" / "filter").config.world_model.perception
    assert perception.encoder == encoder and perception.token_components == 16


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (["--encoder=me/nowhere"], EncoderError, "me/nowhere"),
        (["--encoder=efficientnet_lite0", "--image_size=100"], ValueError, "multiple of 16 pixels, got"),
    ],
)
def test_the_demo_records_nothing_for_an_encoder_that_cannot_see(script, tmp_path, options, error, message):
    with pytest.raises(error, match=message):
        script("demo_bag", f"--out={tmp_path / 'demo'}", *options)
    assert not (tmp_path / "demo").exists()


def test_a_demo_logs_each_command_and_counts_its_minutes(tmp_path, capsys):
    shown = Demo(tmp_path / "demo", usual={"where": 1.0, "break": 3.0})
    shown.run("where: is the bag?", "latentsafe", "path", "--name=bag")
    assert "pretrained/bag" in (tmp_path / "demo" / "logs" / "where.log").read_text()
    shown.say("go on")
    first, second = capsys.readouterr().out.splitlines()
    assert "[....................]   0% where: is the bag?" in first and "[#####...............]  25% go on" in second
    broken = tmp_path / "broken.py"
    broken.write_text("1 / 0")
    for command, words in (
        (("latentsafe", "path", "--name=x"), "no checkpoint at x"),
        (("python", str(broken)), "Zero"),
    ):
        with pytest.raises(SystemExit, match=f"(?s)'break' failed.*{words}"):
            shown.run("break", *command)
    shown.finish()
    assert list(shown.minutes) == ["where", "break", STARTING]
    assert shown.minutes["where"] > 0 and shown.minutes[STARTING] > 0
    part = "".join(where_the_minutes_went({"cache": 0.25, "train": 2.0}))
    assert part.index("train") < part.index("cache") and "2.2" in part


def test_a_simulation_waits_for_whoever_decides_in_it(filter_path):
    """On a busy machine a decision takes long, and that is no fault of the filter that is measured."""
    policy = load_filter(filter_path)
    for actor in (lambda: PolicyActor(policy), lambda: OperatorActor(iter([]), policy)):
        policy.shield.clock = time.perf_counter
        actor()
        assert policy.shield.patience() is None and policy.shield.clock is standing_still
