"""Token caches: what is read is what the encoder sees, whoever made it and however often it was killed."""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import tiny
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.cli.train import Cache
from lerobot_latentsafe.datasets import cache_recipes
from lerobot_latentsafe.datasets.build_cache import build_frame_cache
from lerobot_latentsafe.datasets.frame_cache import FrameCache, FrameCacheError
from lerobot_latentsafe.datasets.join_caches import join_caches
from lerobot_latentsafe.encoders.patch_encoders import EncoderError
from lerobot_latentsafe.encoders.perception import EncoderMismatchError, PatchBasis, Perception
from lerobot_latentsafe.pictures import to_model_images
from lerobot_latentsafe.runtime.onnx_graph import Graph, GraphError


@pytest.fixture(scope="module")
def dataset(dataset_root):
    return LeRobotDataset(tiny.REPO_ID, root=dataset_root)


def arrays(root):
    cache = FrameCache.open(root)
    return {**cache.percepts, **cache.scales}


def test_cache_holds_what_the_world_model_perceives(token_root, dataset):
    policy = tiny.new_policy(tiny.metadata(token_root), world_model=tiny.gru_config())
    index = np.array([0, 5, 41])
    images = torch.stack([dataset[int(i)]["observation.image"] for i in index])
    seen = policy.model.world_model.perception({"observation.image": to_model_images(images, tiny.TOKEN_SIZE)})
    cached, _ = FrameCache.open(token_root).frames(index)
    torch.testing.assert_close(cached["tokens"], seen["tokens"], rtol=2e-3, atol=2e-3)
    torch.testing.assert_close(cached["vector"], seen["vector"], rtol=1e-3, atol=1e-3)
    assert cached["tokens"].shape == (3, 4, 112) and cached["vector"].shape == (3, tiny.COMPONENTS)


def test_components_are_uncorrelated_and_sorted(token_root):
    vector = FrameCache.open(token_root).percepts["vector"]
    spread = vector.std(0)
    assert (np.diff(spread) < 0.05).all() and 0.5 < np.sqrt((spread**2).mean()) < 2


def test_eight_bits_err_by_less_than_a_hundredth(dataset, token_root, tmp_path):
    build_frame_cache(dataset, tmp_path / "int8", tiny.TOKEN_SIZE, tiny.tokens(dtype="int8", basis_from=token_root))
    small, large = (
        FrameCache.open(root).frames(np.arange(50))[0]["tokens"] for root in (tmp_path / "int8", token_root)
    )
    assert (small - large).norm() / large.norm() < 0.01
    assert FrameCache.open(tmp_path / "int8").percepts["tokens"].dtype == np.int8


def test_onnx_runtime_encodes_as_torch_does(dataset, token_root, tmp_path, monkeypatch):
    pytest.importorskip("onnxruntime")
    by_graph, answer = [], Graph.__call__
    monkeypatch.setattr(Graph, "__call__", lambda self, given: by_graph.append(given) or answer(self, given))
    recipe = tiny.tokens(basis_from=token_root, engine="onnx")
    build_frame_cache(dataset, tmp_path / "onnx", tiny.TOKEN_SIZE, recipe)
    made, expected = (FrameCache.open(root) for root in (tmp_path / "onnx", token_root))
    assert len(by_graph) > dataset.num_frames // cache_recipes.ENCODED_AT_ONCE // 2
    for name, values in expected.percepts.items():
        np.testing.assert_allclose(made.percepts[name], values, rtol=2e-3, atol=2e-3)  # both in 16 bits
    joined = join_caches([token_root, tmp_path / "onnx"], "me/both", tmp_path / "both")
    assert joined.manifest["n_frames"] == 2 * expected.manifest["n_frames"]


def test_without_onnx_runtime_no_cache_is_begun(dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(Perception, "_graphs", {})
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(GraphError, match="onnxruntime is missing: pip install"):
        build_frame_cache(dataset, tmp_path / "onnx", tiny.TOKEN_SIZE, tiny.tokens(engine="onnx"))
    assert not (tmp_path / "onnx" / "frame_cache").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [({"engine": "tensorrt"}, "expected torch or onnx"), ({"engine": "onnx", "encoder": None}, "give --encoder")],
)
def test_unknown_and_idle_engines_are_refused(options, said, tmp_path):
    with pytest.raises(ValueError, match=said):
        Cache(**{"output_dir": tmp_path / "cache", "encoder": "auto", **options})


def test_killed_build_goes_on_and_equals_an_undisturbed_one(dataset, token_root, tmp_path, monkeypatch):
    pieces, begun = cache_recipes.Sight.pieces, []

    def killed(self, place, numbers=None):
        begun.extend([place] if numbers is None else [])
        for piece in pieces(self, place, numbers):
            yield piece
            if len(begun) == 4:  # in the middle of an episode
                raise KeyboardInterrupt

    monkeypatch.setattr(cache_recipes.Sight, "pieces", killed)
    with pytest.raises(KeyboardInterrupt):
        build_frame_cache(dataset, tmp_path / "cut", tiny.TOKEN_SIZE, tiny.tokens())
    with pytest.raises(FrameCacheError, match="cut off"):
        FrameCache.open(tmp_path / "cut")
    with pytest.raises(FileExistsError, match="unfinished cache of another"):
        build_frame_cache(dataset, tmp_path / "cut", 2 * tiny.TOKEN_SIZE, tiny.tokens())
    build_frame_cache(dataset, tmp_path / "cut", tiny.TOKEN_SIZE, tiny.tokens())
    assert begun == [*range(4), *range(3, dataset.num_episodes)]  # the three finished episodes were kept
    for name, whole in arrays(token_root).items():
        np.testing.assert_array_equal(arrays(tmp_path / "cut")[name], whole)


def test_processes_share_the_work(dataset_root, token_root, tmp_path):
    """Two ranks of torchrun make what one makes."""
    command = [sys.executable, "-m", "lerobot_latentsafe.cli", "cache", f"--dataset.repo_id={tiny.REPO_ID}"]
    command += [f"--dataset.root={dataset_root}", f"--output_dir={tmp_path / 'shared'}", "--image_size=16"]
    ranks = [
        subprocess.Popen(command, env={**os.environ, "RANK": str(rank), "WORLD_SIZE": "2"}, stdout=subprocess.PIPE)
        for rank in range(2)
    ]
    said = [rank.communicate(timeout=1200)[0].decode() for rank in ranks]
    assert [rank.returncode for rank in ranks] == [0, 0] and any("train with" in text for text in said)
    alone = build_frame_cache(LeRobotDataset(tiny.REPO_ID, root=dataset_root), tmp_path / "alone", 16)
    for name, whole in alone.percepts.items():
        np.testing.assert_array_equal(arrays(tmp_path / "shared")[name], whole)


def test_pictures_are_no_tokens_and_tokens_no_pictures(cache_meta, token_root):
    with pytest.raises(EncoderMismatchError, match=r"holds pictures.*--encoder=auto"):
        tiny.new_policy(cache_meta, world_model=tiny.gru_config())
    with pytest.raises(FrameCacheError, match="holds the tokens of efficientnet_lite0"):
        tiny.new_policy(tiny.metadata(token_root))


@pytest.mark.parametrize("name", ["encoder_hash", "basis_hash"])
def test_cache_of_another_encoder_or_basis_is_refused(token_root, name):
    world_model = tiny.gru_config()
    setattr(world_model.perception, name, "another")
    with pytest.raises((EncoderMismatchError, EncoderError), match="another"):
        tiny.new_policy(tiny.metadata(token_root), world_model=world_model)


def test_training_without_a_token_cache_says_what_to_run(dataset_meta, dataset):
    policy = tiny.new_policy(dataset_meta, world_model=tiny.gru_config())
    with pytest.raises(RuntimeError, match="latentsafe cache --encoder=auto"):
        policy.model.world_model.perceive({"observation.image": torch.rand(1, 3, 32, 32)})


def test_basis_of_pictures_is_refused(dataset, cache_root, tmp_path):
    with pytest.raises(FrameCacheError, match="do not fit"):
        build_frame_cache(dataset, tmp_path / "new", tiny.TOKEN_SIZE, tiny.tokens(basis_from=cache_root))


@pytest.fixture
def two_cameras(token_root, tmp_path):
    """A copy of the token cache that claims to see by one more camera."""
    root = shutil.copytree(token_root, tmp_path / "two")
    cameras = FrameCache.open(root).manifest["cameras"]
    tiny.rewrite_json(root / "frame_cache" / "manifest.json", cameras={**cameras, "observation.side": [32, 32, 3]})
    return root


def test_tokens_of_more_cameras_than_the_filter_sees_are_refused(two_cameras):
    with pytest.raises(FrameCacheError, match=r"tokens of observation\.image, observation\.side side by side"):
        tiny.new_policy(
            tiny.metadata(two_cameras), world_model=tiny.gru_config(), trained_on_cameras=["observation.image"]
        )


def test_basis_of_other_cameras_is_refused(dataset, two_cameras, tmp_path):
    with pytest.raises(FrameCacheError, match=r"sees observation\.image, observation\.side, this dataset"):
        build_frame_cache(dataset, tmp_path / "new", tiny.TOKEN_SIZE, tiny.tokens(basis_from=two_cameras))


def test_unknown_dtype_is_refused(dataset, tmp_path):
    with pytest.raises(ValueError, match="float16 or int8"):
        build_frame_cache(dataset, tmp_path / "new", tiny.TOKEN_SIZE, tiny.tokens(dtype="float8"))


def test_folder_with_something_else_is_left_alone(dataset, tmp_path):
    """Not even one that holds a beginning of a cache which this function did not make."""
    (tmp_path / "mine" / "frame_cache").mkdir(parents=True)
    (tmp_path / "mine" / "precious").write_text("data")
    with pytest.raises(FileExistsError, match="another --output_dir"):
        build_frame_cache(dataset, tmp_path / "mine", tiny.TOKEN_SIZE, tiny.tokens())
    assert (tmp_path / "mine" / "precious").read_text() == "data"


def test_build_killed_before_its_first_episode_starts_anew(dataset, token_root, tmp_path, monkeypatch):
    prepare = cache_recipes.Tokens.prepare

    def killed(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(cache_recipes.Tokens, "prepare", killed)
    with pytest.raises(KeyboardInterrupt):
        build_frame_cache(dataset, tmp_path / "new", tiny.TOKEN_SIZE, tiny.tokens())
    assert not (tmp_path / "new").exists()
    monkeypatch.setattr(cache_recipes.Tokens, "prepare", prepare)
    build_frame_cache(dataset, tmp_path / "new", tiny.TOKEN_SIZE, tiny.tokens())
    assert [path.name for path in tmp_path.iterdir()] == ["new"]
    np.testing.assert_array_equal(arrays(tmp_path / "new")["vector"], arrays(token_root)["vector"])


def test_cache_of_another_version_says_so(token_root, tmp_path):
    import shutil

    copy = shutil.copytree(token_root, tmp_path / "old")
    tiny.rewrite_json(copy / "frame_cache" / "manifest.json", version=1)
    with pytest.raises(FrameCacheError, match=r"is of version 1, this package reads versions 2 and 3; delete it"):
        FrameCache.open(copy)


# -- components that stand for tokens ---


@pytest.fixture(scope="module")
def component_root(dataset, tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "components"
    build_frame_cache(dataset, root, tiny.TOKEN_SIZE, tiny.tokens(config=tiny.perception_config(token_components=6)))
    return root


def dino_wm_policy(root, **changes):
    world_model = tiny.dino_wm_config(**{"frame_token": True, "merge_patches": 2, **changes})
    return tiny.new_policy(tiny.metadata(root), world_model=world_model)


def dino_wm_of(root, **changes):
    return dino_wm_policy(root, perception=tiny.perception_config(**changes)).model.world_model


def test_cached_components_are_those_at_deployment(component_root, dataset):
    model, index = dino_wm_of(component_root), np.array([0, 5, 41])
    images = torch.stack([dataset[int(i)]["observation.image"] for i in index])
    seen = model.perceive({"observation.image": to_model_images(images, tiny.TOKEN_SIZE)})
    cached, _ = FrameCache.open(component_root).frames(index)
    for name in ("tokens", "vector"):
        torch.testing.assert_close(cached[name], seen[name], rtol=1e-3, atol=1e-3)
    assert cached["tokens"].shape == (3, 4, 6) and model.config.perception.token_components == 6


def test_whole_tokens_are_cut_down_to_the_components_that_are_read(component_root, dataset, tmp_path):
    build_frame_cache(dataset, tmp_path / "whole", tiny.TOKEN_SIZE, tiny.tokens(basis_from=component_root))
    model, index = dino_wm_of(component_root), np.array([0, 5, 41])
    whole, _ = FrameCache.open(tmp_path / "whole").frames(index, model.percept_names)
    cached, _ = FrameCache.open(component_root).frames(index, model.percept_names)
    torch.testing.assert_close(model.from_cache(whole)["tokens"], cached["tokens"], rtol=1e-2, atol=1e-2)
    assert model.from_cache(cached)["tokens"] is cached["tokens"]
    # What a latent stands for has the components that it tells of the whole frame.
    latent = model.correct(model.initial(3), cached, torch.zeros(3, 2))
    torch.testing.assert_close(model.basis(model.tokens_of(latent)), cached["vector"], rtol=1e-2, atol=1e-2)


@torch.inference_mode()
def test_tokens_are_cut_down_where_nothing_is_learned(component_root):
    """Tensors made under inference_mode do not count their changes."""
    model = dino_wm_of(component_root)
    perception = model._perception[0]
    size = perception.encoder.dim * len(perception.image_keys)
    tokens = torch.randn(2, perception.n_patches, size)
    assert perception.cut_down(tokens).shape == (2, perception.n_patches, perception.token_dim)


@pytest.mark.parametrize("kind", tiny.DINO)
def test_a_frame_token_of_class_tokens_is_cached_trained_and_seen(kind, dataset, tmp_path):
    encoder = tiny.save_dino(tmp_path / "dino", kind)
    perception = tiny.perception_config(encoder=encoder, token_components=6)
    cache = build_frame_cache(dataset, tmp_path / "tokens", None, tiny.tokens(config=perception), [0, 1])
    assert cache.image_size == 224 and cache.manifest["percepts"] == ["tokens", "vector", "class"]
    assert all(np.isfinite(values).all() for values in cache.percepts.values())
    small = dict(image_size=224, frame_percept="class", perception=perception)
    policy = dino_wm_policy(tmp_path / "tokens", **small)
    loss, metrics = policy.forward({"index": torch.arange(4)})
    assert loss.isfinite() and "loss_frame" in metrics
    model, index = policy.model.world_model, np.array([0, 5, 11])
    images = torch.stack([dataset[int(i)]["observation.image"] for i in index])
    seen = model.perceive({"observation.image": to_model_images(images, 224)})
    cached, _ = cache.frames(index, model.percept_names)
    for name in ("tokens", "vector", "class"):
        torch.testing.assert_close(cached[name], seen[name], rtol=5e-3, atol=5e-3)
    latent = model.correct(model.initial(3), cached, torch.zeros(3, 2))
    torch.testing.assert_close(model.basis(model.tokens_of(latent)), cached["vector"], rtol=1e-3, atol=1e-3)
    assert {f"model.world_model.class_scale.{name}" for name in ("mean", "std", "fitted")} < set(policy.state_dict())
    with pytest.raises(ValueError, match="do not fill the grid"):
        dino_wm_policy(tmp_path / "tokens", **small, merge_patches=3)


def test_class_tokens_of_an_encoder_without_any_are_refused(component_root):
    with pytest.raises(FrameCacheError, match=r"efficientnet_lite0 has no class token.*--encoder=dinov2"):
        dino_wm_policy(component_root, frame_percept="class")
    with pytest.raises(ValueError, match="efficientnet_lite0 has no class token"):
        tiny.dino_wm_config(frame_token=True, frame_percept="class").build(["observation.image"], 2, 2)


def test_a_basis_of_before_class_tokens_were_kept_is_refused(dataset, component_root, tmp_path):
    old = shutil.copytree(component_root, tmp_path / "old")
    tiny.rewrite_json(old / "frame_cache" / "manifest.json", percepts=["tokens"])
    with pytest.raises(FrameCacheError, match=r"holds tokens, and this one is to hold tokens, vector.*build it anew"):
        build_frame_cache(dataset, tmp_path / "new", tiny.TOKEN_SIZE, tiny.tokens(basis_from=old))


def test_large_tokens_are_sampled_less(dataset, token_root, tmp_path, monkeypatch):
    """At the paper's sizes a frame is 768 kB: what principal components are found in must fit in memory."""
    sampled, fit = [], Perception.fit
    monkeypatch.setattr(cache_recipes, "SAMPLED_BYTES", 100 * 4 * 448)
    monkeypatch.setattr(Perception, "fit", lambda self, seen: sampled.append(len(seen.tokens)) or fit(self, seen))
    build_frame_cache(dataset, tmp_path / "new", tiny.TOKEN_SIZE, tiny.tokens())
    assert 100 <= sampled[0] < 100 + dataset.num_episodes


def test_components_of_patches_tell_what_those_of_the_frame_leave_unsaid(component_root, token_root):
    model = dino_wm_policy(component_root).model.world_model
    whole, cached = (FrameCache.open(root).frames(np.arange(50))[0] for root in (token_root, component_root))
    unsaid = model.basis.unsaid(whole["tokens"])
    assert model.basis(unsaid + model.basis.mean.view(unsaid.shape[1:])).abs().max() < 1e-2
    torch.testing.assert_close(cached["tokens"], model.patches(unsaid), rtol=5e-3, atol=5e-3)
    said = model.tokens_of(model.correct(model.initial(50), cached, torch.zeros(50, 2)))
    assert (said - whole["tokens"]).norm() < 0.9 * unsaid.norm()


def test_components_of_patches_alone_are_no_frame(component_root):
    with pytest.raises(ValueError, match=r"frame_token is false.*leave unsaid.*--token_components=0"):
        dino_wm_policy(component_root, frame_token=False)


def test_the_more_components_the_nearer_to_the_tokens(dataset, token_root, component_root):
    whole = FrameCache.open(token_root).frames(np.arange(50))[0]["tokens"]
    errors = []
    for n in (1, 6, 112):
        basis = PatchBasis(1, 112, n)
        basis.fit(whole)
        errors.append(float((basis.lift(basis(whole)) - whole).norm() / (whole - whole.mean((0, 1))).norm()))
    assert errors[0] > errors[1] > errors[2] and errors[2] < 1e-3


@pytest.mark.parametrize(
    ("cache", "asked", "said"),
    [
        ("component_root", {"token_components": 8}, r"token_components 6, .* made for 8.*--token_components"),
        ("component_root", {"token_components": 0}, r"token_components 6, .* made for 0"),
        ("component_root", {"components": 5}, "8 components of 448 numbers a frame, expected 5"),
    ],
)
def test_caches_of_other_components_are_refused(request, cache, asked, said):
    with pytest.raises(EncoderMismatchError, match=said):
        dino_wm_of(request.getfixturevalue(cache), **asked)


def test_more_components_than_a_token_has_are_refused(dataset, tmp_path):
    recipe = tiny.tokens(config=tiny.perception_config(token_components=113))
    with pytest.raises(ValueError, match="113, and this encoder's tokens have 112 numbers"):
        build_frame_cache(dataset, tmp_path / "new", tiny.TOKEN_SIZE, recipe)


def test_a_basis_of_as_many_components_is_shared(dataset, component_root, tmp_path):
    with pytest.raises(FrameCacheError, match=r"--token_components is 3, and the cache in .* keeps 6"):
        few = tiny.tokens(config=tiny.perception_config(token_components=3), basis_from=component_root)
        build_frame_cache(dataset, tmp_path / "few", tiny.TOKEN_SIZE, few)
    build_frame_cache(dataset, tmp_path / "whole", tiny.TOKEN_SIZE, tiny.tokens(basis_from=component_root))
    manifests = [FrameCache.open(root).manifest for root in (component_root, tmp_path / "whole")]
    assert manifests[0]["basis_hash"] == manifests[1]["basis_hash"] and manifests[1]["token_components"] == 0
