"""Training on a frozen world model: killed, started twice, by two at once, with options that mean nothing."""

import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import tiny
import torch
from safetensors.torch import load_file

from lerobot_latentsafe import training
from lerobot_latentsafe.cli.places import PolicySource
from lerobot_latentsafe.cli.train import Cache, TrainMargin, TrainReachability
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.runtime.files import FolderInUseError
from lerobot_latentsafe.training import train_margin, train_reachability

TRAIN = {"margin": train_margin, "reachability": train_reachability}


class Killed(BaseException):
    pass


def killed(*given, **options):
    raise Killed


@pytest.fixture(scope="module")
def whole(tiny_world_model, tiny_filter, cache_meta, tmp_path_factory):
    """What undisturbed trainings save."""
    folder = tmp_path_factory.mktemp("whole") / "margin"
    train_margin(tiny_world_model, cache_meta, folder)
    return {"margin": folder, "reachability": tiny_filter}


def content(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir()}


@pytest.mark.parametrize("kind", TRAIN)
@pytest.mark.parametrize("step", ["save_policy", "claim"])
@pytest.mark.fault(
    "K04", "train-reachability is killed while it saves", "No torn checkpoint; the same command ends the same"
)
def test_a_killed_training_ends_as_one_that_was_not(
    tiny_world_model, whole, cache_meta, tmp_path, monkeypatch, kind, step
):
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(training, step, killed)
        TRAIN[kind](tiny_world_model, cache_meta, tmp_path / "out")
    assert not any(tmp_path.iterdir())
    TRAIN[kind](tiny_world_model, cache_meta, tmp_path / "out")
    assert content(tmp_path / "out") == content(whole[kind])


@pytest.mark.parametrize("kind", TRAIN)
def test_what_is_there_already_is_not_trained_again(tiny_world_model, whole, cache_meta, monkeypatch, kind, capsys):
    before = content(whole[kind])
    monkeypatch.setattr(training, "seen_and_imagined", killed)
    monkeypatch.setattr(training, "encoded_starts", killed)
    found = TRAIN[kind](tiny_world_model, cache_meta, whole[kind])
    assert isinstance(found, LatentSafePolicy) and content(whole[kind]) == before
    assert "holds the same already" in capsys.readouterr().out
    with pytest.raises(FileExistsError, match="another --output_dir"):
        TRAIN[kind](tiny_world_model, cache_meta, whole[kind], seed=1)


TEARS = {
    "weights cut": lambda folder: (folder / "model.safetensors").write_bytes(b"half"),
    "no seal": lambda folder: (folder / "integrity.json").unlink(),
    "empty configuration": lambda folder: (folder / "config.json").write_text(""),
}


@pytest.mark.parametrize("tear", TEARS)
@pytest.mark.fault("K04", "a torn checkpoint is in the output folder", "It is moved aside, and that is said")
def test_a_torn_checkpoint_is_moved_aside(tiny_world_model, whole, cache_meta, tmp_path, tear, caplog):
    out = shutil.copytree(whole["reachability"], tmp_path / "out")
    TEARS[tear](out)
    train_reachability(tiny_world_model, cache_meta, out)
    assert content(out) == content(whole["reachability"])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "out.torn1"] and "out.torn1" in caplog.text


@pytest.mark.parametrize("kind", ["policy", "file"])
def test_what_is_no_filter_is_left_alone(tiny_world_model, tiny_diffusion, cache_meta, tmp_path, kind):
    out = tmp_path / "out"
    shutil.copytree(tiny_diffusion, out) if kind == "policy" else out.mkdir()
    (out / "precious").write_text("data")
    with pytest.raises(FileExistsError, match="another --output_dir"):
        train_reachability(tiny_world_model, cache_meta, out)
    assert (out / "precious").read_text() == "data"


@pytest.mark.fault("P03", "two trainings write one folder", "The second is refused (`FolderInUseError`)")
def test_two_at_once_are_told_apart(tiny_world_model, cache_meta, tmp_path):
    with tiny.written_elsewhere(tmp_path / "out"), pytest.raises(FolderInUseError, match=r"is writing .*out already"):
        train_reachability(tiny_world_model, cache_meta, tmp_path / "out")


def test_a_critic_that_diverged_is_not_saved(tiny_world_model, cache_meta, tmp_path, monkeypatch):
    def diverges(policy, *given):
        with torch.no_grad():
            next(policy.model.critic.parameters()).fill_(float("nan"))

    monkeypatch.setattr(training, "learn_critic", diverges)
    with pytest.raises(
        FloatingPointError, match=r"SafetyCritic holds numbers that are not finite, so nothing is saved"
    ):
        train_reachability(tiny_world_model, cache_meta, tmp_path / "out")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("steps", [0, -5])
@pytest.mark.fault("N07", "train-reachability of no steps", "Refused, with what was expected")
def test_no_steps_make_no_critic(tiny_world_model, cache_meta, tmp_path, steps):
    with pytest.raises(ValueError, match=f"--steps is {steps}; expected at least 1"):
        train_reachability(tiny_world_model, cache_meta, tmp_path / "out", steps=steps)
    assert not any(tmp_path.iterdir())


def test_a_configuration_without_steps_makes_no_critic(tiny_world_model, cache_meta, tmp_path):
    folder = shutil.copytree(tiny_world_model, tmp_path / "model")
    tiny.rewrite_group(folder, "reachability", steps=0)
    with pytest.raises(ValueError, match=r"reachability\.steps is 0"):
        train_reachability(folder, cache_meta, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("other", [{}, {"target": "risk"}, {"alike": {"heading_cos.pos": 1.0}}], ids=str)
def test_a_critic_that_visits_what_was_recorded_is_trained(tiny_world_model, cache_meta, tmp_path, other):
    folder = shutil.copytree(tiny_world_model, tmp_path / "model")
    tiny.rewrite_group(folder, "reachability", recorded=0.5)
    policy = train_reachability(folder, cache_meta, tmp_path / "out", **other)
    assert policy.config.reachability.recorded == 0.5 and policy.config.trained_on.stage == "critic"


@pytest.fixture
def hinged(tiny_world_model, tmp_path):
    """A filter after stage 1, whose critic is to heed what succeeds."""
    folder = shutil.copytree(tiny_world_model, tmp_path / "model")
    tiny.rewrite_group(folder, "reachability", hinge=1.0)
    return folder


def test_a_hinge_needs_recordings_that_tell_what_succeeds(hinged, cache_meta, tmp_path):
    with pytest.raises(ValueError, match=r"has no column next\.success, which the hinge needs; record with"):
        train_reachability(hinged, cache_meta, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("other", [{"target": "risk"}, {"alike": {"heading_cos.pos": 1.0}}])
def test_a_hinge_speaks_of_the_value_of_one_failure(hinged, cache_meta, tmp_path, other):
    with pytest.raises(ValueError, match=r"--policy\.reachability\.hinge is 1, .*--alike and --target=risk"):
        train_reachability(hinged, cache_meta, tmp_path / "out", **other)


def test_episodes_that_succeed_end_so_and_never_fail(monkeypatch):
    reader = SimpleNamespace(
        labels=SimpleNamespace(episode=np.repeat([0, 3, 4, 7], 3), failure=np.array([0] * 3 + [0, 1, 0] + [0] * 6))
    )
    success = np.array([0, 0, 1, 0, 0, 1, 1, 1, 0, 0, 1, 1], bool)
    monkeypatch.setattr(training, "read_frames", lambda root, columns: {"next.success": success[:, None]})
    assert training.frames_of_success("root", reader).tolist() == [True] * 3 + [False] * 6 + [True] * 3
    success[[2, 11]] = False
    with pytest.raises(ValueError, match="no episode of root ends in success without a failure"):
        training.frames_of_success("root", reader)


def test_a_critic_with_a_hinge_is_trained(hinged, cache_meta, tmp_path, monkeypatch):
    everything = lambda root, reader: np.ones(len(reader.labels.episode), bool)  # noqa: E731
    monkeypatch.setattr(training, "frames_of_success", everything)
    policy = train_reachability(hinged, cache_meta, tmp_path / "out")
    assert policy.config.reachability.hinge == 1.0 and policy.config.trained_on.stage == "critic"


NOWHERE = {"policy": PolicySource("no/such"), "output_dir": "out"}
NONSENSE = {
    "--steps is 0": lambda: TrainReachability(**NOWHERE, steps=0),
    "--steps is -5": lambda: TrainReachability(**NOWHERE, steps=-5),
    r"--seeds is \[\]": lambda: TrainReachability(**NOWHERE, seeds=[]),
    r"--seeds is \[1, 1\]": lambda: TrainReachability(**NOWHERE, seeds=[1, 1]),
    r"--seeds is \[-1\]": lambda: TrainReachability(**NOWHERE, seeds=[-1]),
    "--seed is -1": lambda: TrainMargin(**NOWHERE, seed=-1),
    "--image_size is 0": lambda: Cache("out", image_size=0),
    "--image_size is -1": lambda: Cache("out", image_size=-1, encoder="auto"),
    "--dtype is 'half'": lambda: Cache("out", dtype="half"),
}


@pytest.mark.parametrize("message", NONSENSE)
@pytest.mark.fault("N07", "train-reachability without seeds", "Refused, with what was expected")
@pytest.mark.fault("N08", "cache of pictures of no size", "Refused, with what was expected")
def test_options_that_mean_nothing_are_refused_before_any_work(message):
    with pytest.raises(ValueError, match=message):
        NONSENSE[message]()


def test_a_seed_of_several_has_its_own_folder_and_each_is_done_once(
    tiny_world_model, cache_root, tmp_path, monkeypatch
):
    from lerobot_latentsafe.cli.options import DatasetSource

    options = (PolicySource(str(tiny_world_model)), tmp_path / "out", DatasetSource(tiny.REPO_ID, str(cache_root)))
    with monkeypatch.context() as patch, pytest.raises(Killed):
        learn, calls = training.learn_critic, iter([False, True])
        patch.setattr(training, "learn_critic", lambda *given: killed() if next(calls) else learn(*given))
        TrainReachability(*options, seeds=[0, 1], steps=3).run()
    first = (tmp_path / "out" / "seed_0" / "model.safetensors").stat().st_mtime_ns
    TrainReachability(*options, seeds=[0, 1], steps=3).run()
    assert (tmp_path / "out" / "seed_0" / "model.safetensors").stat().st_mtime_ns == first
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["seed_0", "seed_1"]
    names = ("model.critic.q.0.weight",)
    weights = [load_file(tmp_path / "out" / f"seed_{n}" / "model.safetensors") for n in (0, 1)]
    assert not any(torch.equal(weights[0][name], weights[1][name]) for name in names)
    assert load_filter(tmp_path / "out" / "seed_1").config.trained_on.stage == "critic"
