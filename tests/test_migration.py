"""Checkpoints of versions before 0.2: refused everywhere with the command that migrates them, and migrated whole."""

import json
import shutil
from dataclasses import fields

import pytest
import tiny
import torch
from lerobot.configs.policies import PreTrainedConfig
from safetensors.torch import load_file, save_file

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.cli import main
from lerobot_latentsafe.migration import MOVED, SEALED_WHEN_FLAT, migrate_checkpoint
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.runtime import checkpoint, locations
from lerobot_latentsafe.runtime.locations import CheckpointError
from lerobot_latentsafe.units import TrainedOn

COMMAND = "latentsafe migrate-checkpoint --policy.path="
OLD_ENTRIES = {entry for group, entry in MOVED.values() if group == "trained_on"}
SINCE_0_3 = {field.name for field in fields(TrainedOn)} - OLD_ENTRIES
"""What filters of older versions do not know of their data."""


def flatten(folder):
    """A filter's folder as versions before 0.2 wrote it: one flat configuration, weights without a prefix."""
    config = json.loads((folder / "config.json").read_text())
    flat = {name: value for name, value in config.items() if name not in {group for group, _ in MOVED.values()}}
    flat |= {old: config[group][entry] for old, (group, entry) in MOVED.items()}
    flat["stage"] = {"critic": "reachability"}.get(flat["stage"], flat["stage"])
    flat["reachability"]["kept"] = flat["reachability"].pop("learned_steps")
    (folder / "config.json").write_text(json.dumps(flat, indent=4))
    tensors = load_file(folder / "model.safetensors")
    assert all(name.startswith("model.") for name in tensors)
    tensors = {name.removeprefix("model."): tensor for name, tensor in tensors.items()}
    save_file(tensors, folder / "model.safetensors", {"format": "pt"})
    checkpoint.seal(folder, SEALED_WHEN_FLAT)
    return folder


@pytest.fixture
def old(tiny_filter, tmp_path):
    """The tiny filter as versions before 0.2 wrote it."""
    return flatten(shutil.copytree(tiny_filter, tmp_path / "old"))


def said(error):
    """The messages of an error and of those that caused it."""
    return "" if error is None else f"{error}\n{said(error.__cause__)}"


LOADERS = {
    "LatentSafePolicy.from_pretrained": LatentSafePolicy.from_pretrained,
    "load_filter": load_filter,
    "BasePolicy.load": BasePolicy.load,
    "attach": lambda old: load_filter(old.parent / "present").attach(old),
    "lerobot's commands": PreTrainedConfig.from_pretrained,
}


@pytest.mark.parametrize("loader", LOADERS)
def test_every_loader_names_the_command_that_migrates(old, tiny_filter, loader):
    shutil.copytree(tiny_filter, old.parent / "present")
    with pytest.raises(Exception) as refused:
        LOADERS[loader](old)
    assert COMMAND in said(refused.value)
    if "lerobot" not in loader:
        assert isinstance(refused.value, CheckpointError) and str(old) in str(refused.value)


def test_a_task_policy_with_an_old_world_model_is_refused(tiny_dreamer, tmp_path):
    policy = shutil.copytree(tiny_dreamer / "policy", tmp_path / "policy")
    flatten(policy / "world_model")
    with pytest.raises(CheckpointError, match=COMMAND):
        BasePolicy.load(policy)
    main(["migrate-checkpoint", f"--policy.path={policy}", f"--output_dir={tmp_path / 'new'}"])
    assert BasePolicy.load(tmp_path / "new").config.type == "latentsafe_dreamer"


ON_THE_CAR = ["--env.type=latentsafe_dubins"]
VERBS = {
    "train-margin": ["--output_dir={out}", "cache"],
    "train-reachability": ["--output_dir={out}", "cache"],
    "calibrate": ["--output_dir={out}", "cache"],
    "eval-world-model": ["cache"],
    "wrap": ["--output_dir={out}"],
    "push": ["--repo_id=me/filter"],
    "eval-monitor": ON_THE_CAR,
    "eval-shield": ON_THE_CAR,
    "report": ON_THE_CAR,
    "check-labels": ["data"],
    "label": ["data", "--port=0"],
}


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_that_takes_a_checkpoint_names_it_too(verb, old, cache_root, dataset_root, tmp_path):
    roots = {"cache": cache_root, "data": shutil.copytree(dataset_root, tmp_path / "data")}
    options = [f"--policy.path={old}"]
    for option in VERBS[verb]:
        if option in roots:
            options += [f"--dataset.repo_id={tiny.REPO_ID}", f"--dataset.root={roots[option]}"]
        else:
            options.append(option.format(out=tmp_path / "out"))
    with pytest.raises(SystemExit, match=COMMAND) as stopped:
        main([verb, *options])
    assert str(old) in str(stopped.value) and len(str(stopped.value).splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("verb", ["record", "teleoperate"])
def test_a_robot_behind_an_old_filter_is_refused(verb, tmp_path):
    old = flatten(tiny.save_franka_filter(tmp_path / "old"))
    robot = ["--robot.type=latentsafe_franka_mujoco", "--robot.scene=blocks", "--teleop.type=latentsafe_scripted"]
    robot.append("--teleop.behavior=pluck_careful")
    dataset = [
        "--dataset.repo_id=me/x",
        f"--dataset.root={tmp_path / 'x'}",
        "--dataset.single_task=x",
        "--dataset.fps=20",
    ]
    with pytest.raises(SystemExit, match=COMMAND):
        main([verb, f"--filter={old}", *robot, *(dataset if verb == "record" else [])])


SINCE_0_3_OF_THE_LAW = [
    ("law", name) for name in ("slack_ms", "unknown", "kappa", "replan_above", "engine", "max_retreat_steps")
]
SINCE_0_3_OF_TRAINING = [
    ("margin", "noise"), ("margin", "gradient_penalty"), ("reachability", "hinge"), ("reachability", "local_updates"),
    ("reachability", "recorded"),
]  # fmt: skip


def assert_same(first, second, n_steps=6):
    """Two folders hold the same configuration, weights and decisions."""
    configs = [json.loads((folder / "config.json").read_text()) for folder in (first, second)]
    for config in configs:
        assert config["reachability"].pop("kept", None) is None
        for group, name in (*SINCE_0_3_OF_THE_LAW, *SINCE_0_3_OF_TRAINING):
            config[group].pop(name, None)
        for name in SINCE_0_3:
            config["trained_on"].pop(name, None)
        config.pop("local_updates", None)
    assert configs[0] == configs[1]
    ours, theirs = (load_file(folder / "model.safetensors") for folder in (first, second))
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)
    driven = []
    for folder in (first, second):
        torch.manual_seed(0)
        driven.append(tiny.drive(load_filter(folder), n_steps))
    for a, b in zip(*driven):
        for name in ("action", "value", "margin", "reason"):
            torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=0, atol=0)


def test_a_migrated_filter_is_the_same(old, tiny_filter, tmp_path, capsys):
    main(["migrate-checkpoint", f"--policy.path={old}", f"--output_dir={tmp_path / 'new'}"])
    assert str(tmp_path / "new") in capsys.readouterr().out
    assert_same(tmp_path / "new", tiny_filter)
    assert {file.name for file in (tmp_path / "new").iterdir()} == {file.name for file in tiny_filter.iterdir()}


def test_what_lies_in_a_checkpoint_comes_along(tiny_filter, tiny_diffusion, tmp_path, capsys):
    main(
        ["wrap", f"--policy.path={tiny_filter}", f"--base_policy_path={tiny_diffusion}", "--law.epsilon=0.125",
         f"--output_dir={tmp_path / 'wrapped'}"]
    )  # fmt: skip
    old = shutil.copytree(tmp_path / "wrapped", tmp_path / "old")
    flatten(shutil.copytree(tiny_filter, old / "base_policy" / "world_model"))
    flatten(old)
    main(["migrate-checkpoint", f"--policy.path={old}", f"--output_dir={tmp_path / 'new'}"])
    assert capsys.readouterr().out.count("migrated ") == 2
    assert_same(tmp_path / "new", tmp_path / "wrapped")
    assert_same(tmp_path / "new" / "base_policy" / "world_model", tiny_filter)
    for file in tiny_diffusion.iterdir():
        assert (tmp_path / "new" / "base_policy" / file.name).read_bytes() == file.read_bytes()
    assert load_filter(tmp_path / "new").base.config.type == "diffusion"


def test_a_committed_name_can_be_migrated(old, tiny_filter, tmp_path, monkeypatch):
    monkeypatch.setattr(locations, "PRETRAINED", old.parent)
    main(["migrate-checkpoint", "--policy.path=old", f"--output_dir={tmp_path / 'new'}"])
    assert_same(tmp_path / "new", tiny_filter)


def test_a_migrated_filter_is_sealed(old, tmp_path):
    migrate_checkpoint(old, tmp_path / "new")
    tiny.rewrite_json(tmp_path / "new" / "config.json", trained_on={"fps": 5})
    with pytest.raises(CheckpointError, match="was edited"):
        load_filter(tmp_path / "new")


def cut(old):
    weights = old / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-4])


def alter_a_weight(old):
    weights = old / "model.safetensors"
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(content)


def alter_a_range(old):
    tiny.rewrite_json(old / "config.json", action_high=[9.0, 9.0])


@pytest.mark.parametrize(
    ("spoil", "words"), [(cut, "truncated"), (alter_a_weight, "changed after saving"), (alter_a_range, "was edited")]
)
def test_what_was_cut_or_edited_is_not_sealed_anew(old, tmp_path, spoil, words):
    spoil(old)
    with pytest.raises(CheckpointError, match=words):
        migrate_checkpoint(old, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_nothing_is_overwritten_and_nothing_is_migrated_twice(old, tiny_filter, tmp_path):
    for source, output, words in (
        (old, old, "choose another --output_dir"),
        (tiny_filter, tmp_path / "new", "holds no filter of the old layout"),
        (tmp_path / "nowhere", tmp_path / "new", "no checkpoint at"),
    ):
        with pytest.raises(SystemExit, match=words):
            main(["migrate-checkpoint", f"--policy.path={source}", f"--output_dir={output}"])
    assert not (tmp_path / "new").exists()
