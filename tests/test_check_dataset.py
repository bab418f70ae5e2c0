"""From a dataset as people have it to a filter's configuration, and what the console says on the way."""

import json
import shutil

import datasets_of_the_world as world
import numpy as np
import pytest
import tiny
import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.converters import batch_to_transition

from lerobot_latentsafe.cli import main
from lerobot_latentsafe.datasets.build_cache import build_frame_cache
from lerobot_latentsafe.datasets.clips import FilterData
from lerobot_latentsafe.datasets.contract import Contract
from lerobot_latentsafe.datasets.folder import load_metadata, open_dataset
from lerobot_latentsafe.datasets.reading import DatasetContractError
from lerobot_latentsafe.processor_latentsafe import make_latentsafe_pre_post_processors
from lerobot_latentsafe.runtime.hub import save_policy

SHAPE = (3, world.HEIGHT, world.WIDTH)
CHW = dict(shape=SHAPE, axes=("channels", "height", "width"))
SIZE = 16


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A dataset with nothing odd about it."""
    return world.record(tmp_path_factory.mktemp("world") / "plain", world.features())


def cached(root, folder):
    build_frame_cache(open_dataset("me/data", root), folder, SIZE)
    return load_metadata("me/data_cache", folder)


def new_policy(meta):
    return tiny.new_policy(meta, world_model=tiny.rssm_config(image_size=SIZE), fallback_action_candidates=None)


def says(capsys, *argv):
    """Exit code and output of a command."""
    code = 0
    try:
        main(list(argv))
    except SystemExit as stopped:
        if isinstance(stopped.code, str):
            print(stopped.code)
        code = stopped.code if isinstance(stopped.code, int) else 1
    said = capsys.readouterr()
    return code, said.out + said.err


# -- check-dataset ---


def test_check_dataset_prints_the_contract(capsys, root):
    code, said = says(capsys, "check-dataset", f"--dataset.root={root}")
    assert code == 0 and said.strip().splitlines()[-1].startswith("can be used")
    for words in (
        "10 Hz", "2, of 5 to 6 frames", "3 channels, 48 x 64 pixels", "y.pos: 0 to 0.5", "command",
        "failure: 5 failing, 6 safe, 0 not labelled",
    ):  # fmt: skip
        assert words in said


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda root: world.cut(root, "data/*/*.parquet"), ["file-000.parquet", "download"]),
        (lambda root: world.edit_column(root, "failure", lambda f: [2 for _ in f]), ["'failure'", "1, 0 or -1"]),
        (lambda root: shutil.rmtree(root), ["no folder"]),
        (lambda root: world.edit_column(root, world.CAMERA, lambda p: [{**i, "bytes": i["bytes"][:99]} for i in p]),
         ["cut or damaged"]),
    ],
)  # fmt: skip
def test_the_last_line_of_check_dataset_says_why_not(capsys, root, tmp_path, change, words):
    copy = shutil.copytree(root, tmp_path / "copy")
    change(copy)
    code, said = says(capsys, "check-dataset", f"--dataset.root={copy}")
    last = said.strip().splitlines()[-1]
    assert code == 1 and last.startswith("cannot be used") and [word for word in words if word not in last] == []


def test_check_dataset_tells_what_to_know(capsys, tmp_path):
    root = world.record(tmp_path / "data", world.features(failure=None, **{"observation.state": None}))
    world.edit_feature(world.delete(root, "meta/stats.json"), "action", names=["all"])
    code, said = says(capsys, "check-dataset", f"--dataset.root={root}")
    assert code == 1 and "trained_on.meanings='{action_0: delta, action_1: delta}'" in said.strip().splitlines()[-1]
    for words in (
        "action_0, action_1 here",
        "of unknown meaning",
        "without proprioception",
        "use_imagenet_stats=false",
    ):
        assert words in said


def test_check_dataset_wants_a_camera_that_shows_pictures(capsys, tmp_path):
    root = world.record(tmp_path / "data", world.features(None, **{"observation.images.far": world.DEPTH}))
    code, said = says(capsys, "check-dataset", f"--dataset.root={root}")
    assert code == 1 and "left out: observation.images.far" in said.strip().splitlines()[-1]


def test_check_dataset_knows_cached_frames(capsys, root, tmp_path):
    cached(root, tmp_path / "cache")
    code, said = says(capsys, "check-dataset", f"--dataset.root={tmp_path / 'cache'}")
    assert code == 0 and f"{world.CAMERA}: cached at 16 x 16 pixels" in said


# -- other names ---


@pytest.mark.parametrize("dtype", ["image", "video"])
def test_a_renamed_copy_is_a_dataset_like_any_other(capsys, tmp_path, dtype):
    other = world.features("image", dtype, state=world.NUMBERS, actions=world.NUMBERS, action=None)
    root = world.record(tmp_path / "other", {k: f for k, f in other.items() if k != "observation.state"})
    with pytest.raises(DatasetContractError) as refused:
        Contract.read(load_metadata("me/data", root))
    command = str(refused.value).partition("latentsafe ")[2]
    renames = json.loads(command.partition("--rename_map='")[2].partition("'")[0])
    renames["image"] = world.CAMERA
    copy = tmp_path / "copy"
    options = [f"--dataset.root={root}", f"--rename_map={json.dumps(renames)}", f"--output_dir={copy}"]
    assert says(capsys, "rename-features", *options)[0] == 0
    usual = world.record(tmp_path / "usual", world.features(dtype=dtype))
    found, expected = (Contract.read(load_metadata("me/data", folder)) for folder in (copy, usual))
    assert found.cameras == expected.cameras and found.action_names == expected.action_names
    np.testing.assert_array_equal(found.state, expected.state)
    assert {*load_metadata("me/data", copy).stats} == {*load_metadata("me/data", usual).stats}
    frame, same = (LeRobotDataset("me/data", root=folder)[3] for folder in (copy, usual))
    assert {*frame} == {*same} and torch.equal(frame[world.CAMERA], same[world.CAMERA])


@pytest.mark.parametrize(
    ("renames", "words"), [({"nothing": "action"}, "nothing"), ({"failure": "action"}, "twice"), ({}, "no feature")]
)
def test_renames_that_make_no_dataset_are_refused(capsys, root, tmp_path, renames, words):
    options = [f"--dataset.root={root}", f"--rename_map={json.dumps(renames)}", f"--output_dir={tmp_path / 'copy'}"]
    code, said = says(capsys, "rename-features", *options)
    assert code == 1 and words in said and not (tmp_path / "copy").exists()


# -- cameras, from the file to the filter ---


@pytest.mark.parametrize("is_cached", [False, True])
@pytest.mark.parametrize("dtype", ["image", "video"])
def test_a_filter_of_channels_first_cameras_takes_channels_first(tmp_path, dtype, is_cached):
    root = world.record(tmp_path / "data", world.features(dtype=dtype, **CHW))
    meta = cached(root, tmp_path / "cache") if is_cached else load_metadata("me/data", root)
    policy = new_policy(meta)
    assert tuple(policy.config.input_features[world.CAMERA].shape) == SHAPE
    if is_cached:
        assert policy.reader.cache.manifest["cameras"] == {world.CAMERA: [*SHAPE[1:], 3]}
    save_policy(policy, tmp_path / "policy")
    config = json.loads((tmp_path / "policy" / "config.json").read_text())
    assert config["input_features"][world.CAMERA]["shape"] == list(SHAPE)


def test_the_order_of_a_cameras_axes_changes_no_picture(root, tmp_path):
    first = world.record(tmp_path / "first", world.features(**CHW))
    caches = [cached(data, tmp_path / f"{i}") for i, data in enumerate((root, first))]
    one, other = (np.load(meta.root / "frame_cache" / f"{world.CAMERA}.npy") for meta in caches)
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("is_cached", [False, True])
def test_depth_maps_never_reach_a_filter(tmp_path, is_cached):
    root = world.record(tmp_path / "data", world.features(**{"observation.images.far": world.DEPTH}))
    meta = cached(root, tmp_path / "cache") if is_cached else load_metadata("me/data", root)
    config = new_policy(meta).config
    assert config.trained_on.cameras == [world.CAMERA] and "observation.images.far" not in config.input_features


def test_actions_of_two_axes_are_a_row_of_numbers(tmp_path):
    kind = {"dtype": "float32", "shape": (2, 1), "names": world.AXES}
    meta = cached(world.record(tmp_path / "data", world.features(action=kind)), tmp_path / "cache")
    policy = new_policy(meta)
    assert policy.config.action_feature.shape == (2,)
    assert policy.reader.cut(np.array([0])).action.shape[-1] == 2


def test_a_dataset_without_proprioception_is_cached_with_an_empty_state(tmp_path):
    root = world.record(tmp_path / "data", world.features(**{"observation.state": None}))
    data = FilterData.open(cached(root, tmp_path / "cache"), "failure", None, SIZE)
    percepts, state = data.cache.frames(np.arange(3))
    assert state.shape == (3, 0) and percepts[world.CAMERA].shape == (3, 3, SIZE, SIZE)


def test_cached_frames_without_proprioception_pass_lerobots_steps(tmp_path):
    config = tiny.config(
        trained_on_cameras=[world.CAMERA],
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        input_features={world.CAMERA: PolicyFeature(FeatureType.VISUAL, SHAPE)},
    )
    before, _ = make_latentsafe_pre_post_processors(config)
    before.save_pretrained(tmp_path)
    again = PolicyProcessorPipeline.from_pretrained(tmp_path, f"{before.name}.json", to_transition=batch_to_transition)
    batch = {"action": torch.zeros(4, 2), "index": torch.arange(4)}
    for steps in (before, again):
        assert steps(batch)["index"].tolist() == [0, 1, 2, 3]


@pytest.mark.filterwarnings("ignore:Initializing zero-element tensors")
@pytest.mark.parametrize("kind", ["rssm", "gru", "dino_wm"])
def test_world_models_learn_without_proprioception(kind):
    config = getattr(tiny, f"{kind}_config")()
    model = config.build([world.CAMERA], 0, tiny.ACTION_DIM)
    clip = tiny.random_clip(key=world.CAMERA, state_dim=0, length=config.clip_length)
    if kind == "gru":
        clip.percepts = {"vector": torch.randn(*clip.valid.shape, tiny.COMPONENTS)}
    if kind == "dino_wm":
        clip.percepts = {"tokens": torch.randn(*clip.valid.shape, *model.sizes["tokens"])}
    loss, *_ = model.loss(clip)
    assert torch.isfinite(loss)


def test_without_statistics_the_cached_copy_has_its_own(root, tmp_path):
    bare = world.delete(shutil.copytree(root, tmp_path / "bare"), "meta/stats.json")
    meta, whole = cached(bare, tmp_path / "cache"), load_metadata("me/data", root)
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(meta.stats["action"][name], whole.stats["action"][name], atol=1e-5)


@pytest.mark.parametrize("label", [2, 7])
def test_frames_are_not_cached_with_labels_that_are_none(root, tmp_path, label):
    copy = world.edit_column(shutil.copytree(root, tmp_path / "copy"), "failure", lambda f: [label for _ in f])
    with pytest.raises(ValueError, match="expected 1, 0 or -1"):
        build_frame_cache(open_dataset("me/data", copy), tmp_path / "cache", SIZE)
    assert not (tmp_path / "cache").exists()


# -- lerobot-train ---


def training(root, **options):
    return TrainPipelineConfig(
        dataset=DatasetConfig(repo_id="me/data", root=str(root), **options), policy=tiny.config()
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (shutil.rmtree, "no folder"),
        (lambda root: world.cut(root, "meta/info.json"), "info.json"),
        (lambda root: world.delete(root, "meta/stats.json"), "use_imagenet_stats=false"),
        (lambda root: world.edit_feature(root, world.CAMERA, names=None), "name its axes"),
    ],
)
def test_lerobot_train_is_told_before_it_opens_the_dataset(root, tmp_path, change, words):
    copy = shutil.copytree(root, tmp_path / "copy")
    change(copy)
    with pytest.raises(DatasetContractError, match=words):
        training(copy).validate()
    training(root).validate()


def test_transforms_of_cached_frames_are_refused(root, tmp_path):
    meta = cached(root, tmp_path / "cache")
    cfg = training(meta.root)  # as in lerobot-train
    assert FilterData.open(meta, "failure", None, SIZE).cache is not None
    cfg.dataset.image_transforms.enable = True
    with pytest.raises(ValueError, match=r"image_transforms.*no effect on the cached frames"):
        FilterData.open(meta, "failure", None, SIZE)


# -- what the console says ---


@pytest.mark.parametrize("verb", ["check-dataset", "cache", "label", "auto-label", "write-labels", "merge-decisions"])
def test_a_mistyped_root_is_named_by_every_verb(capsys, tmp_path, verb):
    more = {
        "cache": ["--output_dir=x"], "auto-label": ["--labeller=dubins_truth"],
        "write-labels": ["--output_dir=x", "--new_repo_id=me/x"],
        "merge-decisions": ["--output_dir=x", "--new_repo_id=me/x"],
    }  # fmt: skip
    root = tmp_path / "no_such_folder"
    code, said = says(capsys, verb, f"--dataset.root={root}", *more.get(verb, []))
    last = said.strip().splitlines()[-1]
    assert code == 1 and "no_such_folder" in last and "Hub" not in last and not root.exists()


@pytest.mark.parametrize("place", [0, 1, 2])
def test_debug_shows_the_traceback_wherever_it_stands(capsys, tmp_path, place):
    argv = ["cache", f"--dataset.root={tmp_path / 'nothing'}", "--output_dir=x"]
    assert "Traceback" not in says(capsys, *argv)[1]
    code, said = says(capsys, *argv[:place], "--debug", *argv[place:])
    assert code == 1 and "Traceback" in said
    assert any(line.startswith("latentsafe cache: there is no folder") for line in said.splitlines())


@pytest.mark.parametrize(
    "error", [KeyError("observation.state"), IndexError("list index out of range"), TypeError(), AssertionError("no")]
)
def test_errors_that_nobody_meant_name_their_class(capsys, monkeypatch, error):
    from lerobot_latentsafe.cli.path import PathOf

    def fail(self):
        raise error

    monkeypatch.setattr(PathOf, "run", fail)
    code, said = says(capsys, "path")
    assert code == 1 and said.strip().startswith(f"latentsafe path: {type(error).__name__}: ")
    assert said.strip().endswith("(--debug shows where)") and "\n" not in said.strip()
