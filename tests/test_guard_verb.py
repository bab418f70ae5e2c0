"""latentsafe guard: what works on the first day, made of recorded episodes alone, goes where a filter goes."""

import json
import re
import shutil

import pytest
import tiny
import torch

from lerobot_latentsafe.cli import main
from lerobot_latentsafe.decision import Reason
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.runtime.checkpoint import seal_again
from lerobot_latentsafe.world_models import NoneConfig

CAMERA, STATE = "observation.image", "observation.state"
LIMITS = ("state_low", "state_high", "state_step", "action_step", "action_jerk", "unanswered")


def guard(*options):
    main(["guard", *map(str, options)])


@pytest.fixture(scope="module")
def unlabelled(dataset_root, tmp_path_factory):
    """The same episodes, and nobody said where they fail."""
    root = tmp_path_factory.mktemp("unlabelled") / "car"
    shutil.copytree(dataset_root, root)
    info = json.loads((root / "meta" / "info.json").read_text())
    info["features"] = {key: value for key, value in info["features"].items() if key != "failure"}
    (root / "meta" / "info.json").write_text(json.dumps(info))
    return root


@pytest.fixture(scope="module")
def guard_folder(unlabelled, tmp_path_factory):
    folder = tmp_path_factory.mktemp("guard") / "guard"
    guard(f"--dataset.root={unlabelled}", f"--output_dir={folder}")
    return folder


@pytest.fixture
def guarded(guard_folder):
    return load_filter(guard_folder)


def seen():
    return tiny.observation([[-0.9, 0.1, 0.0]])


def test_a_guard_needs_no_labels_and_says_that_it_has_no_value(unlabelled, tmp_path, capsys):
    guard(f"--dataset.root={unlabelled}", f"--output_dir={tmp_path / 'guard'}")
    said = capsys.readouterr().out
    assert "a guard; it has no V, and foresees nothing" in said
    assert f"{CAMERA}: the data do not tell whether it is upside down" in said


def test_a_guard_is_a_filter_of_another_law(guarded):
    trained_on = guarded.config.trained_on
    assert (trained_on.stage, guarded.config.law.name, guarded.config.world_model.type) == ("guard", "guard", "none")
    decision = guarded.shield(seen(), torch.tensor([[0.0, 1.0]]))
    assert decision.reason.item() == Reason.PASSED and not decision.intervened
    assert decision.value.isnan().all() and decision.margin.isnan().all()


@pytest.mark.parametrize(
    ("observation", "action"),
    [
        ({CAMERA: lambda x: torch.full_like(x, 0.5)}, [0.0, 1.0]),
        ({STATE: lambda x: x * 1e4}, [0.0, 1.0]),
        ({}, [9.0, 1.0]),
        ({}, [torch.nan, 1.0]),
    ],
    ids=["dead camera", "state far away", "command far away", "command that is no number"],
)
def test_a_guard_stops_what_is_wrong(guarded, observation, action):
    given = {key: observation.get(key, lambda x: x)(value) for key, value in seen().items()}
    decision = guarded.shield(given, torch.tensor([action]))
    assert decision.intervened and decision.reason.item() != Reason.PASSED
    assert decision.action[0, 0] == 0  # it does not turn


def test_a_guard_shields_a_policy_as_a_filter_does(guard_folder, tiny_diffusion, tmp_path):
    main(
        ["wrap", f"--policy.path={guard_folder}", f"--base_policy_path={tiny_diffusion}", f"--output_dir={tmp_path}/w"]
    )
    shielded = load_filter(tmp_path / "w")
    decisions = tiny.drive(shielded, start=[(-0.9, 0.1, 0.0)])
    assert len(decisions) == 6 and all(d.value.isnan().all() for d in decisions)


def test_a_guard_of_named_episodes_and_cameras(unlabelled, tmp_path):
    options = [f"--dataset.root={unlabelled}", f"--output_dir={tmp_path / 'guard'}"]
    guard(*options, "--dataset.episodes=[1,2]", f"--policy.trained_on.cameras=[{CAMERA}]")
    look = load_filter(tmp_path / "guard").config.trained_on.looks[CAMERA]
    assert look.frames == sum(tiny.metadata(unlabelled).episodes["length"][1:3])


def test_a_guard_of_a_cache_of_pictures(cache_root, tmp_path):
    guard(f"--dataset.root={cache_root}", f"--output_dir={tmp_path / 'guard'}")
    assert [*load_filter(tmp_path / "guard").config.trained_on.looks] == [CAMERA]


def test_a_filter_of_before_learns_what_a_guard_knows(tiny_filter, dataset_root, tmp_path):
    old = tmp_path / "old"
    shutil.copytree(tiny_filter, old)
    config = json.loads((old / "config.json").read_text())
    config["trained_on"] = {k: v for k, v in config["trained_on"].items() if k not in (*LIMITS, "looks")}
    (old / "config.json").write_text(json.dumps(config))
    seal_again(old)
    assert load_filter(old).config.trained_on.looks is None
    guard(f"--policy.path={old}", f"--dataset.root={dataset_root}", f"--output_dir={tmp_path / 'new'}")
    before, after = load_filter(old), load_filter(tmp_path / "new")
    assert after.config.trained_on.looks[CAMERA].frames > 0
    assert all(getattr(after.config.trained_on, name) is not None for name in LIMITS)
    for name, weight in before.model.state_dict().items():
        torch.testing.assert_close(weight, after.model.state_dict()[name])
    assert after.config.law == before.config.law and after.config.trained_on.stage == "critic"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--policy.trained_on.cameras=[observation.images.front]"], "lacks the camera observation.images.front; it"),
        (["--policy.trained_on.meanings={turn: delta}"], "names turn; .* has the commands turn_rate.vel, speed.vel"),
        (["--dataset.episodes=[99]"], r"--dataset.episodes is \[99\]"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(unlabelled, tmp_path, capsys, options, message):
    with pytest.raises(SystemExit) as ended:
        guard(f"--dataset.root={unlabelled}", f"--output_dir={tmp_path / 'guard'}", *options)
    assert re.search(message, str(ended.value) + capsys.readouterr().err)
    assert not (tmp_path / "guard").exists()


def test_nothing_is_overwritten(unlabelled, guard_folder, capsys):
    with pytest.raises(SystemExit):
        guard(f"--dataset.root={unlabelled}", f"--output_dir={guard_folder}")


def test_there_is_nothing_to_train_in_a_guard(cache_meta, cache_root):
    policy = tiny.new_policy(cache_meta, world_model=NoneConfig())
    with pytest.raises(ValueError, match="has nothing to train"):
        policy.forward({"index": torch.arange(4)})
