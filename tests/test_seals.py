"""Checkpoints that are torn, edited, overridden or hostile: none is run, and each refusal names file and remedy."""

import errno
import json
import shutil
import struct
import sys
from types import ModuleType

import pytest
import tiny
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import make_policy
from safetensors.torch import load_file, save_file

from lerobot_latentsafe import LatentSafeDubinsEnv
from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.configuration_latentsafe import SEALED, SEALED_ENTRIES
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter
from lerobot_latentsafe.runtime import checkpoint, locations, processors
from lerobot_latentsafe.runtime.checkpoint import CheckpointWriteError, read_config, seal
from lerobot_latentsafe.runtime.hub import save_policy
from lerobot_latentsafe.runtime.locations import CheckpointError
from lerobot_latentsafe.runtime.processors import DownloadedCodeError, load_processors, no_downloaded_code

DEEP = "[" * 100_000 + "]" * 100_000
HOOK = {"class": "tests_that_must_not_be_imported.Step", "config": {}}


@pytest.fixture
def wrapped(policy, tiny_diffusion, tmp_path):
    """Folder of the tiny filter with a policy to shield in it."""
    policy.attach(tiny_diffusion)
    save_policy(policy, tmp_path / "wrapped")
    return tmp_path / "wrapped"


@pytest.fixture
def base(tiny_diffusion, tmp_path):
    """Folder of a policy to be shielded, to break."""
    return shutil.copytree(tiny_diffusion, tmp_path / "base")


def edit(file, change):
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def flip(file):
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)


# -- files that cannot be read ---

UNREADABLE = {
    "empty": b"", "binary": b"\xff\xfe\x00\x80", "nested": DEEP.encode(), "nested objects": b'{"a":' * 50_000,
    "cut": b'{"type": "latentsafe", "wor', "a list": b"[1, 2]", "a number": b"3",
}  # fmt: skip


@pytest.mark.parametrize("content", UNREADABLE)
@pytest.mark.parametrize("name", ["config.json", "integrity.json", "policy_preprocessor.json"])
@pytest.mark.fault("C07", "integrity.json is binary", "Refused (`CheckpointError`), the file is named")
@pytest.mark.fault("C09", "integrity.json is nested deeply", "Refused (`CheckpointError`), the file is named")
@pytest.mark.fault("C21", "config.json is nested deeply", "Refused (`CheckpointError`), the file is named")
def test_settings_that_cannot_be_read_are_named(filter_copy, name, content):
    (filter_copy / name).write_bytes(UNREADABLE[content])
    with pytest.raises(CheckpointError, match=name):
        load_filter(filter_copy)


def test_settings_that_are_too_large_are_not_read(filter_copy, monkeypatch):
    monkeypatch.setattr(checkpoint, "LARGEST_JSON", 100)
    with pytest.raises(CheckpointError, match=r"config\.json is not readable \(\d+ bytes, at most 100"):
        load_filter(filter_copy)


ENTRIES = {
    "NaN": {"law": {"epsilon": float("nan")}}, "unknown": {"nonsense": 1}, "of another type": {"world_model": 3},
    "no such kind": {"world_model": {"type": "none"}}, "no such policy": {"type": "none"},
}  # fmt: skip


@pytest.mark.parametrize("kind", ENTRIES)
@pytest.mark.fault("C17", "config.json says that epsilon is NaN", "Refused (`CheckpointError`)")
def test_entries_that_mean_nothing_are_refused(filter_copy, kind):
    tiny.rewrite_json(filter_copy / "config.json", **ENTRIES[kind])
    with pytest.raises(CheckpointError, match=r"config\.json"):
        load_filter(filter_copy)


REASONS = {
    "device": ({"device": "meta"}, "Unknown device meta"),
    "retreat": ({"law": {"retreat": {"lift": 1.0}}}, r"retreat moves lift; the actions are turn_rate\.vel"),
    "lookahead": ({"law": {"lookahead": 99}}, r"lookahead is 99; expected 0 \(critic alone\) to 25"),
    "margin": ({"margin": {"delta": -1.0}}, r"margin\.delta is -1\.0; expected a positive number"),
    "base_ahead": ({"base_ahead": -1}, r"base_ahead is -1; expected 0"),
}


@pytest.mark.parametrize("name", REASONS)
def test_an_entry_that_is_refused_says_what_was_expected(filter_copy, name):
    change, reason = REASONS[name]
    tiny.rewrite_json(filter_copy / "config.json", **change)
    with pytest.raises(CheckpointError, match=rf"config\.json is not readable \(.*{reason}"):
        read_config(filter_copy)


def header(length, content=b""):
    return struct.pack("<Q", length) + content


def claiming(shape, end):
    told = json.dumps({"model.x": {"dtype": "F32", "shape": shape, "data_offsets": [0, end]}}).encode()
    return header(len(told), told)


WEIGHTS = {
    "header of 2^40 bytes": header(2**40), "header of 2^63 bytes": header(2**63), "no header": b"",
    "4 TB": claiming([10**12], 4 * 10**12), "less than it claims": claiming([10], 40),
    "no JSON": header(4, b"\xff\xff\xff\xff"),
}  # fmt: skip


@pytest.mark.parametrize("kind", WEIGHTS)
@pytest.mark.parametrize("what", ["filter", "base policy"])
@pytest.mark.fault("C30", "weights with a header of 2^40 bytes", "Refused (`CheckpointError`)")
@pytest.mark.fault("C31", "weights that claim 4 TB", "Refused (`CheckpointError`)")
def test_weights_that_cannot_be_read_are_named(filter_copy, base, kind, what):
    folder = filter_copy if what == "filter" else base
    (folder / "model.safetensors").write_bytes(WEIGHTS[kind])
    if what == "filter":
        seal(folder, SEALED)  # by somebody who knows how
    with pytest.raises(CheckpointError, match=str(folder)):
        (load_filter if what == "filter" else BasePolicy.load)(folder)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(filter_copy, value):
    file = filter_copy / "model.safetensors"
    tensors = load_file(file)
    name = next(name for name in tensors if "critic.q" in name)
    tensors[name].view(-1)[0] = value
    save_file(tensors, file)
    seal(filter_copy, SEALED)
    with pytest.raises(CheckpointError, match=rf"not finite: {name}.*train it again"):
        load_filter(filter_copy)


# -- what the seal covers ---

EDITS = {
    "activation": lambda c: c["reachability"].update(activation="tanh"),
    "sizes": lambda c: c["reachability"].update(components=8),
    "proportions": lambda c: c["input_features"]["observation.image"].update(shape=[3, 96, 128]),
    "action": lambda c: c["output_features"]["action"].update(type="STATE"),
    "another output": lambda c: c["output_features"].update({"action.left": {"type": "ACTION", "shape": [2]}}),
    "no output": lambda c: c.update(output_features={}),
    "specification": lambda c: c["margin"].update(failure_specification="other"),
    "normalisation": lambda c: c["normalization_mapping"].update(VISUAL="MEAN_STD"),
    "range": lambda c: c["trained_on"].update(action_high=[9.0, 9.0]),
    "stage": lambda c: c["trained_on"].update(stage="world_model"),
}


@pytest.mark.parametrize("what", EDITS)
@pytest.mark.fault("C13", "the critic's activation is edited in config.json", "Refused (`CheckpointError`)")
@pytest.mark.fault("C14", "the camera's proportions are edited in config.json", "Refused (`CheckpointError`)")
@pytest.mark.fault("C14", "output_features is edited in config.json", "Refused (`CheckpointError`)")
def test_what_decides_is_sealed(filter_copy, what):
    edit(filter_copy / "config.json", EDITS[what])
    with pytest.raises(CheckpointError, match=r"config\.json was edited"):
        load_filter(filter_copy)


def test_what_is_the_users_is_not_sealed(filter_copy):
    edit(filter_copy / "config.json", lambda c: c["law"].update(epsilon=0.3))
    edit(filter_copy / "config.json", lambda c: c["reachability"].update(lr=1e-5))
    edit(filter_copy / "config.json", lambda c: c.update(optimizer_lr=1e-5, repo_id="me/filter"))
    assert load_filter(filter_copy).config.law.epsilon == 0.3


FILES = {
    "weights": "base_policy/model.safetensors",
    "configuration": "base_policy/config.json",
    "processor": "base_policy/policy_preprocessor.json",
    "statistics": "base_policy/policy_preprocessor_step_3_normalizer_processor.safetensors",
    "own processor": "policy_preprocessor.json",
}


@pytest.mark.parametrize("what", FILES)
@pytest.mark.parametrize("change", ["flipped", "removed"])
@pytest.mark.fault("C40", "a bit of the base policy's weights is flipped", "Refused (`CheckpointError`)")
@pytest.mark.fault("C42", "the base policy's weights are missing", "Refused (`CheckpointError`), the file is named")
def test_processors_and_the_base_policy_are_sealed(wrapped, what, change):
    file = wrapped / FILES[what]
    flip(file) if change == "flipped" else file.unlink()
    with pytest.raises(CheckpointError, match=rf"{FILES[what]} was changed or removed.*restore it"):
        load_filter(wrapped)


@pytest.mark.parametrize("name", ["adapter_config.json", "trained_on.json", "train_config.json"])
def test_nothing_is_added_to_a_base_policy_that_is_sealed(wrapped, name):
    (wrapped / "base_policy" / name).write_text("{}")
    with pytest.raises(CheckpointError, match=f"base_policy/{name} was added.*wrap it again"):
        load_filter(wrapped)


def unrecorded(folder, change):
    """Processors that were written after the seal, as lerobot-train does."""
    edit(folder / "integrity.json", lambda record: record.pop("files"))
    edit(folder / "policy_preprocessor.json", lambda c: change(c["steps"]))


CHANGES = {
    "exchanged cameras": lambda steps: steps[0]["config"].update(rename_map={"observation.a": "observation.b"}),
    "scaled": lambda steps: steps[-1]["config"]["norm_map"].update(VISUAL="MEAN_STD"),
    "one more": lambda steps: steps.append({"registry_name": "image_crop_resize_processor", "config": {}}),
    "one less": lambda steps: steps.pop(),
    "a class": lambda steps: steps.append(HOOK),
}


@pytest.mark.parametrize("kind", CHANGES)
def test_processors_that_are_not_sealed_change_nothing(filter_copy, kind):
    unrecorded(filter_copy, CHANGES[kind])
    with pytest.raises(CheckpointError, match=r"policy_preprocessor\.json"):
        load_filter(filter_copy)


OLDER = {
    "before 0.3": SEALED,
    "without output_features": [name for name in SEALED_ENTRIES if name != "output_features"],
}


@pytest.mark.parametrize("version", OLDER)
def test_an_older_seal_is_believed_for_what_it_covers(filter_copy, version):
    unrecorded(filter_copy, lambda steps: None)
    entries = list(OLDER[version])
    edit(filter_copy / "integrity.json", lambda record: record.update(
        entries=entries, config_sha256=checkpoint._config_digest(filter_copy, entries)))  # fmt: skip
    policy = load_filter(filter_copy)
    save_policy(policy, filter_copy.parent / "again")
    assert json.loads((filter_copy.parent / "again" / "integrity.json").read_text())["entries"] == list(SEALED_ENTRIES)
    edit(filter_copy / "config.json", EDITS["range"])
    with pytest.raises(CheckpointError, match="was edited"):
        load_filter(filter_copy)


@pytest.mark.parametrize("entries", [[], ["trained_on"], [3], [["a"]], [*SEALED, 3]])
def test_a_seal_that_covers_less_than_ever_is_no_seal(filter_copy, entries):
    edit(filter_copy / "integrity.json", lambda record: record.update(entries=entries))
    with pytest.raises(CheckpointError, match=r"integrity\.json is not readable \(it says nothing of "):
        load_filter(filter_copy)


@pytest.mark.parametrize("name", ["dubins", "bag", "blocks"])
def test_committed_filters_are_sealed_in_all_that_decides(name):
    checkpoint.check_sealed(locations.PRETRAINED / name, SEALED_ENTRIES)
    record = json.loads((locations.PRETRAINED / name / "integrity.json").read_text())
    assert {"policy_preprocessor.json", "policy_postprocessor.json"} <= record["files"].keys()


# -- what is used, whoever changed it ---

OVERRIDES = {
    "stage": "--trained_on.stage=world_model",
    "rate": "--trained_on.fps=30",
    "mean": "--trained_on.state_mean=[5,5]",
    "range": "--trained_on.action_high=[9,9]",
    "fallback": "--fallback.low=[0,0]",
    "picture size": "--world_model.image_size=64",
    "activation": "--reachability.activation=tanh",
    "specification": "--margin.failure_specification=other",
}


@pytest.mark.parametrize("what", OVERRIDES)
@pytest.mark.parametrize("how", ["make_policy", "from_pretrained"])
@pytest.mark.fault("C49", "the command line gives another fps or state_mean", "Refused (`CheckpointError`)")
def test_what_belongs_to_the_weights_cannot_be_overridden(tiny_filter, what, how):
    """As LeRobot's commands do it: --policy.path with --policy.<option>."""
    config = PreTrainedConfig.from_pretrained(tiny_filter, cli_overrides=[OVERRIDES[what]])
    config.pretrained_path = tiny_filter
    option = OVERRIDES[what].partition("=")[0].removeprefix("--")
    with pytest.raises(CheckpointError, match=rf"--policy\.{option}"):
        if how == "make_policy":
            make_policy(config, env_cfg=LatentSafeDubinsEnv())
        else:
            LatentSafePolicy.from_pretrained(tiny_filter, config=config)


def test_a_filters_weights_take_no_adapter(tiny_filter):
    config = PreTrainedConfig.from_pretrained(tiny_filter, cli_overrides=["--use_peft=true"])
    with pytest.raises(CheckpointError, match=r"--policy\.use_peft"):
        LatentSafePolicy.from_pretrained(tiny_filter, config=config)


@pytest.mark.fault("C48", "the command line says that an untrained critic is trained", "Refused (`CheckpointError`)")
def test_a_critic_that_was_never_trained_cannot_be_declared_trained(tiny_world_model):
    config = PreTrainedConfig.from_pretrained(tiny_world_model, cli_overrides=["--trained_on.stage=critic"])
    with pytest.raises(CheckpointError, match=r"trained_on\.stage was overridden"):
        LatentSafePolicy.from_pretrained(tiny_world_model, config=config)


def test_the_law_the_device_and_the_training_are_the_users(tiny_filter):
    options = ["--law.epsilon=0.3", "--law.mode=monitor", "--device=cpu", "--optimizer_lr=0.5", "--reachability.lr=0.5",
               "--margin.weight=2", "--repo_id=me/x", "--base_ahead=2"]  # fmt: skip
    config = PreTrainedConfig.from_pretrained(tiny_filter, cli_overrides=options)
    assert LatentSafePolicy.from_pretrained(tiny_filter, config=config).config.law.epsilon == 0.3


# -- nothing that a file names is run ---


@pytest.mark.parametrize("name", ["policy_preprocessor.json", "policy_postprocessor.json"])
@pytest.mark.parametrize("step", [HOOK, {"class": "os.system"}, {"registry_name": "not_registered"}, {}, 3])
@pytest.mark.fault("H15", "a downloaded processor names a class", "Nothing is run: refused (`CheckpointError`)")
def test_a_step_that_is_not_registered_is_not_imported(base, name, step):
    edit(base / name, lambda c: c["steps"].append(step))
    with pytest.raises(CheckpointError, match=name):
        BasePolicy.load(base)
    assert "tests_that_must_not_be_imported" not in sys.modules


STATES = [
    "../other.safetensors",
    "/tmp/x.safetensors",
    "C:\\x.safetensors",
    "sub/x.safetensors",
    "x.bin",
    3,
    "gone.safetensors",
]


@pytest.mark.parametrize("state", STATES)
def test_numbers_of_a_processor_lie_in_its_folder(base, state):
    edit(base / "policy_preprocessor.json", lambda c: c["steps"][-1].update(state_file=state))
    with pytest.raises(CheckpointError, match=r"safetensors"):
        BasePolicy.load(base)


@pytest.mark.parametrize("name", processors.FILES)
@pytest.mark.fault("C44", "the base policy's processors are missing", "Refused (`CheckpointError`), with the remedy")
def test_processors_that_are_missing_are_named(base, name):
    (base / name).unlink()
    with pytest.raises(CheckpointError, match=rf"{name} is missing.*migrate_policy_normalization"):
        BasePolicy.load(base)


def test_a_step_that_cannot_be_made_is_named(base):
    edit(base / "policy_preprocessor.json", lambda c: c["steps"][0]["config"].update(nonsense=1))
    with pytest.raises(CheckpointError, match=str(base)):
        load_processors(read_config(base), base)


@pytest.fixture
def fetched(monkeypatch):
    """What a stand-in for transformers fetched to run."""
    package, modules, fetched = ModuleType("transformers"), ModuleType("transformers.dynamic_module_utils"), []
    modules.get_cached_module_file = lambda repository, file: fetched.append(repository)
    package.dynamic_module_utils = modules
    monkeypatch.setitem(sys.modules, "transformers", package)
    monkeypatch.setitem(sys.modules, "transformers.dynamic_module_utils", modules)
    modules.fetched = fetched
    return modules


def test_transformers_runs_no_code_that_a_file_names(fetched):
    from lerobot.policies.pi0_fast.configuration_pi0_fast import PI0FastConfig

    own = PI0FastConfig.action_tokenizer_name
    with no_downloaded_code(PI0FastConfig(action_tokenizer_name="evil/tokenizer", device="cpu")):
        fetched.get_cached_module_file(own, "processing.py")
        with pytest.raises(DownloadedCodeError, match=r"processing\.py of evil/tokenizer.*shield_policy"):
            fetched.get_cached_module_file("evil/tokenizer", "processing.py")
    fetched.get_cached_module_file("mine/outside", "processing.py")
    assert fetched.fetched == [own, "mine/outside"]


# -- nothing that a file names is fetched or looked for elsewhere ---

ELSEWHERE = [
    "evil/policy",
    "../other",
    "/absolute",
    "base_policy/../../other",
    "dubins_diffusion_reckless",
    "C:\\other",
]


@pytest.fixture
def nothing_fetched(monkeypatch):
    def fetch(*_, **options):
        assert options.get("local_files_only"), "the Hub was asked"
        raise OSError("not in the cache")

    monkeypatch.setattr(locations, "snapshot_download", fetch)


@pytest.mark.parametrize("place", ELSEWHERE)
@pytest.mark.fault(
    "C45", "config.json names a base policy in another folder or on the Hub", "Refused (`CheckpointError`)"
)
@pytest.mark.fault(
    "H15", "a downloaded config.json names another Hub id", "Nothing is fetched: refused (`CheckpointError`)"
)
def test_a_filters_file_names_no_base_policy_elsewhere(filter_copy, nothing_fetched, place):
    tiny.rewrite_json(filter_copy / "config.json", base_policy_path=place)
    with pytest.raises(CheckpointError, match=r"names the base policy.*--policy\.base_policy_path"):
        load_filter(filter_copy)
    config = PreTrainedConfig.from_pretrained(filter_copy)
    config.pretrained_path = filter_copy
    with pytest.raises(CheckpointError, match="names the base policy"):
        make_policy(config, env_cfg=LatentSafeDubinsEnv())


@pytest.mark.fault(
    "C39", "the base policy is missing, and the present folder has one of that name", "Refused (`CheckpointError`)"
)
def test_a_base_policy_that_is_missing_is_not_another_folders(wrapped, tiny_diffusion, tmp_path, monkeypatch):
    edit(wrapped / "integrity.json", lambda record: record.pop("files"))
    shutil.rmtree(wrapped / "base_policy")
    shutil.copytree(tiny_diffusion, tmp_path / "here" / "base_policy")
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(CheckpointError, match="names the base policy base_policy"):
        load_filter(wrapped)
    (wrapped / "base_policy").symlink_to(tmp_path / "here" / "base_policy")
    with pytest.raises(CheckpointError, match="names the base policy base_policy"):
        load_filter(wrapped)


def test_the_user_may_choose_any_base_policy(filter_copy, tiny_diffusion, monkeypatch):
    tiny.rewrite_json(filter_copy / "config.json", base_policy_path=str(tiny_diffusion))
    assert load_filter(filter_copy, base_policy=tiny_diffusion).base is not None
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", f"--policy.base_policy_path={tiny_diffusion}"])
    config = PreTrainedConfig.from_pretrained(filter_copy)
    assert LatentSafePolicy.from_pretrained(filter_copy, config=config).base is not None


@pytest.mark.parametrize("place", ["evil/policy", "../other", "/absolute", 3, ["a"]])
def test_an_adapter_fetches_nothing(base, nothing_fetched, place):
    (base / "adapter_config.json").write_text(json.dumps({"base_model_name_or_path": place}))
    with pytest.raises(CheckpointError, match=r"adapter_config\.json"):
        BasePolicy.load(base)


@pytest.mark.parametrize("entry", ["auto_mapping", "megatron_config"])
def test_an_adapter_names_no_code(base, entry):
    (base / "adapter_config.json").write_text(json.dumps({"base_model_name_or_path": str(base), entry: {"x": "os"}}))
    with pytest.raises(DownloadedCodeError, match=entry):
        BasePolicy.load(base)


def test_a_downloaded_checkpoint_names_no_folder_of_this_machine(base, tmp_path, nothing_fetched):
    (base / ".cache" / "huggingface").mkdir(parents=True)  # of `hf download`
    with pytest.raises(CheckpointError, match="Nothing is fetched"):
        locations.named_by(base, str(tmp_path), "")


@pytest.mark.parametrize("repo_id", ["../../x", "/etc", "a/b/c", 3, None, "me/data"])
def test_a_downloaded_policy_tells_of_no_dataset_in_a_folder_it_names(base, tmp_path, repo_id):
    info = {"fps": 7, "features": {"action": {"shape": [2], "names": ["b", "a"]}}}
    (tmp_path / "data" / "meta").mkdir(parents=True)
    (tmp_path / "data" / "meta" / "info.json").write_text(json.dumps(info))
    told = {"dataset": {"repo_id": repo_id, "root": str(tmp_path / "data")}}
    (base / "train_config.json").write_text(json.dumps(told))
    assert BasePolicy.load(base).origin.fps == 7
    (base / ".cache" / "huggingface").mkdir(parents=True)
    assert BasePolicy.load(base).origin.fps is None


# -- torn while it was written ---


@pytest.mark.parametrize("call", ["save_model_as_safetensor", "seal"])
@pytest.mark.parametrize("before", ["nothing", "another filter"])
@pytest.mark.fault("D03", "the disk is full when a trained filter is saved", "What was there stays; save it again")
@pytest.mark.fault("D05", "the disk is full when a policy is wrapped", "What was there stays; save it again")
def test_a_full_disk_leaves_what_was_there(policy, filter_copy, tmp_path, monkeypatch, call, before):
    folder = filter_copy if before == "another filter" else tmp_path / "new"
    found = {f: f.read_bytes() for f in folder.rglob("*") if f.is_file()}

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    place = "lerobot.policies.pretrained" if call.startswith("save") else "lerobot_latentsafe.modeling_latentsafe"
    monkeypatch.setattr(f"{place}.{call}", full)
    for save in (policy.save_pretrained, lambda folder: save_policy(policy, folder)):
        with pytest.raises(CheckpointWriteError, match=r"No space left.*save it again"):
            save(folder)
        assert {f: f.read_bytes() for f in folder.rglob("*") if f.is_file()} == found
    assert not [f for f in tmp_path.iterdir() if f.name.startswith(".")]
    monkeypatch.undo()
    save_policy(policy, folder)
    load_filter(folder)


def test_who_is_killed_while_files_are_moved_leaves_nothing_that_loads(policy, filter_copy, monkeypatch):
    policy.config.law.epsilon = 0.5
    move = type(filter_copy).replace
    monkeypatch.setattr(type(filter_copy), "replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        policy.save_pretrained(filter_copy)
    monkeypatch.setattr(type(filter_copy), "replace", move)
    with pytest.raises(CheckpointError, match=r"lacks integrity\.json"):
        load_filter(filter_copy)


@pytest.mark.skipif(sys.platform == "win32", reason="needs fork")
def test_what_a_killed_save_left_goes_with_the_next(policy, filter_copy):
    from test_killed_recording import killed

    killed(lambda: policy.save_pretrained(filter_copy), "lerobot_latentsafe.runtime.checkpoint._move_into", 1)
    policy.save_pretrained(filter_copy)
    assert [file.name for file in filter_copy.parent.iterdir() if file.name.startswith(".")] == []
    load_filter(filter_copy)


def test_a_policy_is_saved_over_itself(wrapped):
    policy = load_filter(wrapped)
    policy.config.law.epsilon = 0.25
    policy.save_pretrained(wrapped)
    again = load_filter(wrapped)
    assert again.config.law.epsilon == 0.25 and again.base is not None
    assert all(
        torch.equal(a, b) for a, b in zip(policy.state_dict().values(), again.state_dict().values(), strict=True)
    )
