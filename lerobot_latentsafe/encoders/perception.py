"""What a token world model sees of a frame: a frozen encoder's tokens, their principal components, class tokens."""

import logging
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from lerobot_latentsafe.encoders.patch_encoders import PatchEncoder, Seen, load_encoder
from lerobot_latentsafe.runtime.onnx_graph import TOLERANCE, Graph, GraphError

logger = logging.getLogger(__name__)

LIVE = 64
"""So many pictures at most are of robots that act now, and are remembered until the next ones."""


class EncoderMismatchError(ValueError):
    """Tokens or principal components that another encoder made."""


@dataclass
class PerceptionConfig:
    """Which encoder, and what is kept of its tokens.

    Attributes:
        encoder: auto, dinov2, dinov2_registers, dinov3, efficientnet_lite0, a folder or a Hub id; see `encoders.py`.
        encoder_hash: of its weights; filled in by training, and checked whenever the encoder is loaded again.
        basis_hash: of the principal components, filled in by training.
        components: principal components of a whole frame's tokens.
        token_components: principal components of what the frame's components leave unsaid of a patch, of each camera,
            that stand for its token; 0: whole tokens; None: what the token cache holds.
    """

    encoder: str = "auto"
    encoder_hash: str | None = None
    basis_hash: str | None = None
    components: int = 128
    token_components: int | None = None

    def of_cache(self, manifest: dict) -> "PerceptionConfig":
        """With encoder and principal components of a token cache, if they are not others than known already.

        Raises:
            EncoderMismatchError: it holds pictures, or was made with another encoder or other components.
        """
        if "encoder_hash" not in manifest:
            raise EncoderMismatchError(
                "this cache holds pictures, the world model reads an encoder's tokens; build one with "
                "latentsafe cache --encoder=auto"
            )
        found = {"token_components": 0, **manifest}  # before there were any, a cache held whole tokens
        for name, remedy in (
            ("encoder_hash", "encode the dataset with that encoder (latentsafe cache --encoder=...)"),
            ("token_components", "build the cache with as many (latentsafe cache --token_components=...)"),
            ("basis_hash", "build the cache with --basis_from=<the cache that was trained on>"),
        ):
            known = getattr(self, name)
            if name == "token_components" and found[name] == 0:
                continue  # whole tokens have all components
            if known is not None and known != found[name]:
                raise EncoderMismatchError(
                    f"the cache has {name} {found[name]}, the world model was made for {known}; {remedy}, or train anew"
                )
        adopted = {name: found[name] for name in ("encoder", "encoder_hash", "basis_hash")}
        if self.token_components is None:
            adopted["token_components"] = found["token_components"]
        return replace(self, **adopted)


class FrameBasis(nn.Module):
    """Principal components of the flattened tokens of a frame, on one scale: (..., P, C) -> (..., K).

    The axes are orthogonal and of one length.
    """

    mean: Tensor
    axes: Tensor
    fitted: Tensor

    def __init__(self, n_inputs: int, n_components: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(n_inputs))
        self.register_buffer("axes", torch.zeros(n_inputs, n_components))
        self.register_buffer("fitted", torch.zeros((), dtype=torch.bool))

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens of frames (..., P, C) -> their components (..., K)."""
        _require_fitted(self.fitted)
        return (tokens.flatten(-2) - self.mean) @ self.axes

    def lift(self, components: Tensor) -> Tensor:
        """Components of frames (..., K) -> the flattened tokens (..., P C) nearest to the mean that have them."""
        return (components / self.axes[:, 0].square().sum().clamp(min=1e-12)) @ self.axes.T + self.mean

    def unsaid(self, tokens: Tensor) -> Tensor:
        """What its components leave unsaid of a frame's tokens (..., P, C)."""
        return tokens - self.lift(self(tokens)).unflatten(-1, tokens.shape[-2:])

    @torch.no_grad()
    def fit(self, tokens: Tensor) -> None:
        """From a sample of frames' tokens (N, P, C)."""
        flat = tokens.flatten(-2).float()
        n_components = self.axes.shape[1]
        if len(flat) <= n_components:
            raise ValueError(f"{len(flat)} frames do not span {n_components} principal components; encode more of them")
        centred = flat - flat.mean(0)
        _, spread, axes = torch.svd_lowrank(centred, q=n_components + 8, niter=4)
        scale = spread[:n_components].square().mean().sqrt() / len(flat) ** 0.5
        self.mean.copy_(flat.mean(0))
        self.axes.copy_(axes[:, :n_components] / scale)
        self.fitted.fill_(True)


class PatchBasis(nn.Module):
    """Principal components of what is left of each camera's patch tokens, the first of them of unit variance.

    Tokens (..., P, cameras x C) -> (..., P, cameras x K).
    """

    mean: Tensor
    axes: Tensor
    fitted: Tensor

    def __init__(self, n_cameras: int, token_dim: int, n_components: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(n_cameras, token_dim))
        self.register_buffer("axes", torch.zeros(n_cameras, token_dim, n_components))
        self.register_buffer("fitted", torch.zeros((), dtype=torch.bool))

    def forward(self, tokens: Tensor) -> Tensor:
        """Whole tokens (..., P, cameras x C) -> their components (..., P, cameras x K)."""
        _require_fitted(self.fitted)
        return self.parts(tokens - self.mean.flatten())

    def parts(self, differences: Tensor) -> Tensor:
        """Components of differences of tokens (..., P, cameras x C)."""
        apart = differences.unflatten(-1, (len(self.mean), -1))
        return torch.einsum("...nc,nck->...nk", apart, self.axes).flatten(-2)

    def lift(self, components: Tensor) -> Tensor:
        """The tokens (..., P, cameras x C) nearest to the data's mean that have these components."""
        variance = 1 / self.axes.square().sum(1, keepdim=True).clamp(min=1e-12)  # axes are orthogonal
        parts = components.unflatten(-1, (len(self.mean), -1))
        return (torch.einsum("...nk,nck->...nc", parts, self.axes * variance) + self.mean).flatten(-2)

    @torch.no_grad()
    def fit(self, tokens: Tensor) -> None:
        """From a sample of frames' tokens (N, P, cameras x C).

        Raises:
            ValueError: a token has fewer numbers than there are to be components.
        """
        n_cameras, n_inputs, n_components = self.axes.shape
        if n_components > n_inputs:
            raise ValueError(
                f"token_components is {n_components}, and this encoder's tokens have {n_inputs} numbers; give at most "
                "that many, or 0 for whole tokens"
            )
        for camera, flat in enumerate(tokens.float().unflatten(-1, (n_cameras, -1)).flatten(0, 1).unbind(1)):
            centred = flat - flat.mean(0)
            variance, axes = torch.linalg.eigh(centred.T @ centred / len(flat))  # ascending
            self.mean[camera] = flat.mean(0)
            self.axes[camera] = axes[:, -n_components:].flip(1) / variance[-1].clamp(min=1e-12).sqrt()
        self.fitted.fill_(True)


class ClassScale(nn.Module):
    """The cameras' class tokens side by side (..., cameras x C): each number of mean 0, each camera's of variance 1."""

    mean: Tensor
    std: Tensor
    fitted: Tensor

    def __init__(self, n_cameras: int, token_dim: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(n_cameras, token_dim))
        self.register_buffer("std", torch.ones(n_cameras, 1))
        self.register_buffer("fitted", torch.zeros((), dtype=torch.bool))

    def forward(self, tokens: Tensor) -> Tensor:
        """Class tokens on that scale."""
        _require_fitted(self.fitted)
        return ((tokens.unflatten(-1, self.mean.shape) - self.mean) / self.std).flatten(-2)

    @torch.no_grad()
    def fit(self, tokens: Tensor) -> None:
        """From a sample of frames' class tokens (N, cameras x C)."""
        apart = tokens.float().unflatten(-1, self.mean.shape)
        self.mean.copy_(apart.mean(0))
        variance = (apart - self.mean).square().mean((0, 2))
        self.std.copy_(variance.sqrt().clamp(min=1e-6)[:, None])
        self.fitted.fill_(True)


def _require_fitted(fitted: Tensor) -> None:
    if not fitted:
        raise RuntimeError(
            "no principal components yet: they come with a token cache. Run latentsafe cache --encoder=auto and train "
            "on its folder"
        )


class Perception(nn.Module):
    """Images -> what is kept of them, by name; `config` names the encoder found. That is

        vector (B, components)        principal components of the whole frame
        tokens (B, P, token_dim)      whole, a patch of each camera side by side; or each camera's `token_components`
                                      of what `vector` leaves unsaid
        class (B, cameras x dim)      the cameras' class tokens side by side, on one scale, of an encoder that has them

    The encoder's weights are not part of a checkpoint; its name and hash in the configuration are.

    Args:
        image_size: None: the encoder's default.

    Raises:
        EncoderError: the encoder cannot be had, or is another.
        ValueError: its patches do not fill images of this size.
    """

    _latest: ClassVar[dict[tuple, tuple[Tensor, Seen]]] = {}
    """Pictures encoded last, and what was seen: a policy and the filter that shields it look at the same ones."""
    _graphs: ClassVar[dict[tuple, Graph]] = {}
    """Compiled encoders, by hash of the weights and shape of the pictures."""
    _by_graphs: ClassVar[bool] = False

    def __init__(self, config: PerceptionConfig, image_keys: list[str], image_size: int | None):
        super().__init__()
        encoder = load_encoder(config.encoder, config.encoder_hash)
        self.image_keys, self.image_size = sorted(image_keys), encoder.image_size if image_size is None else image_size
        self.config = replace(config, encoder=encoder.name, encoder_hash=encoder.weights_hash())
        self.encoder_hash = self.config.encoder_hash
        self._compiled = False
        self._encoder = [encoder]  # in a list, so that its weights are not ours
        self.n_patches, n_cameras = encoder.n_patches(self.image_size, self.image_size), len(self.image_keys)
        self.basis = FrameBasis(self.n_patches * encoder.dim * n_cameras, config.components)
        n_kept = config.token_components or 0
        self.patches = PatchBasis(n_cameras, encoder.dim, n_kept) if n_kept else None
        # In a list, so that it is part of the world models that read class tokens, and of no others.
        self._class_scale = [ClassScale(n_cameras, encoder.dim) if encoder.has_class_token else None]
        self._known: tuple[list, tuple[Tensor, Tensor] | None] = [], None
        self.token_dim = n_cameras * (n_kept or encoder.dim)
        self.sizes: dict[str, tuple[int, ...]] = {
            "tokens": (self.n_patches, self.token_dim),
            "vector": (config.components,),
        }
        if self.class_scale is not None:
            self.sizes["class"] = (n_cameras * encoder.dim,)

    @property
    def encoder(self) -> PatchEncoder:
        """The frozen encoder."""
        return self._encoder[0]

    @property
    def class_scale(self) -> ClassScale | None:
        """The scale of class tokens; None if the encoder has none."""
        return self._class_scale[0]

    def see(self, images: dict[str, Tensor]) -> Seen:
        """Camera key -> (B, 3, S, S) in [0, 1] to what the encoder says of them, the cameras' tokens side by side.

        Returns:
            Whole tokens (B, P, n_cameras x dim) and, if there are any, class tokens (B, n_cameras x dim).
        """
        together = torch.cat([images[key] for key in self.image_keys])
        key = self.encoder_hash, len(self.image_keys), together.device
        if key in self._latest:
            known, seen = self._latest[key]
            if torch.equal(known, together):
                return seen
        if self.encoder.mean.device != together.device:  # asking all of its modules at each tick takes milliseconds
            self.encoder.to(together.device)
        seen = Seen(*(None if part is None else self._side_by_side(part) for part in self._encoded(together)))
        if len(together) <= LIVE:
            self._latest[key] = together, seen
        return seen

    def _encoded(self, images: Tensor) -> Seen:
        by_graphs = self._by_graphs or self._compiled
        graph = self._graphs.get((self.encoder_hash, *images.shape)) if by_graphs else None
        if graph is None or images.device.type != "cpu":
            return self.encoder(images)
        try:
            said = graph({"images": images})
        except Exception as e:
            self._graphs.clear()
            logger.warning("THE COMPILED ENCODER FAILED (%s: %s): torch encodes instead", type(e).__name__, e)
            return self.encoder(images)
        return Seen(said["tokens"], said.get("class_token"))

    @torch.no_grad()
    def compile(self, n_frames: int = 1) -> None:
        """Make a graph that encodes so many frames at once, for all that see with this encoder; see `use_graphs`.

        Raises:
            GraphError: there is no such graph, or it says something else than torch.
        """
        shape = n_frames * len(self.image_keys), 3, self.image_size, self.image_size
        if (self.encoder_hash, *shape) in self._graphs:
            return
        images = torch.rand(shape, generator=torch.Generator().manual_seed(0))
        graph = Graph(self.encoder, _say, {"images": images})
        expected, said = _say(self.encoder, images), graph({"images": images})
        if not all(torch.allclose(said[key], expected[key], rtol=TOLERANCE, atol=TOLERANCE) for key in expected):
            raise GraphError(f"encoder {self.config.encoder} says something else as a graph than in torch")
        self._graphs[self.encoder_hash, *shape] = graph

    def encode_by_graphs(self, n_frames: int) -> None:
        """From now on encode so many frames at once by a graph, and others by torch.

        Raises:
            GraphError: there is no such graph, or it says something else than torch.
        """
        self.compile(n_frames)
        self._compiled = True

    def _side_by_side(self, tokens: Tensor) -> Tensor:
        """Tokens (n_cameras x B, ..., dim), camera by camera, as (B, ..., n_cameras x dim)."""
        return torch.cat(tokens.float().chunk(len(self.image_keys)), -1)

    def tokens(self, images: dict[str, Tensor]) -> Tensor:
        """Camera key -> (B, 3, S, S) in [0, 1] to whole tokens (B, P, n_cameras x dim)."""
        return self.see(images).tokens

    def fit(self, seen: Seen) -> None:
        """Principal components, and the scale of class tokens, of a sample of frames (N, ...)."""
        self.basis.fit(seen.tokens)
        if self.patches is not None:
            self.patches.fit(self.basis.unsaid(seen.tokens))
        if self.class_scale is not None and seen.class_token is not None:
            self.class_scale.fit(seen.class_token)

    def components(self) -> dict[str, Tensor]:
        """All that `fit` has found, as `load_basis` reads it from a file."""
        found = self.basis.state_dict()
        for name, part in (("patches", self.patches), ("class", self.class_scale)):
            if part is not None:
                found |= {f"{name}.{key}": tensor for key, tensor in part.state_dict().items()}
        return found

    @classmethod
    def forget(cls) -> None:
        """Forget the pictures encoded last."""
        cls._latest.clear()

    @classmethod
    def use_graphs(cls, use: bool) -> None:
        """Whether from now on graphs encode in this process, where there are any, for filters and policies alike: a
        policy and the filter that shields it look at the same pictures, and the first of them encodes."""
        cls._by_graphs = use

    def load_basis(self, file: Path) -> None:
        """What `fit` has found, from a file of a token cache."""
        found = load_file(file)
        if found["axes"].shape != self.basis.axes.shape:
            (there, n_there), (here, n_here) = found["axes"].shape, self.basis.axes.shape
            raise EncoderMismatchError(
                f"{file} holds {n_there} components of {there} numbers a frame, expected {n_here} of {here}; build the "
                "cache at this image size and with as many, or set world_model.perception.components"
            )
        self.basis.load_state_dict({key: found[key] for key in self.basis.state_dict()})
        if self.class_scale is not None and "class.mean" in found:  # older versions kept no class tokens
            self.class_scale.load_state_dict({key: found[f"class.{key}"] for key in self.class_scale.state_dict()})
        if self.patches is None:
            return
        axes = found.get("patches.axes")
        if axes is None or axes.shape != self.patches.axes.shape:
            n, expected = 0 if axes is None else axes.shape[-1], self.patches.axes.shape[-1]
            raise EncoderMismatchError(
                f"{file} holds {n} components of each camera's tokens, expected {expected}; build the cache with as "
                "many (latentsafe cache --token_components=...)"
            )
        self.patches.load_state_dict({key: found[f"patches.{key}"] for key in self.patches.state_dict()})

    def forward(self, images: dict[str, Tensor], names: Collection[str] | None = None) -> dict[str, Tensor]:
        """Camera key -> (B, 3, S, S) in [0, 1] to what is kept of the frames, or to what of that is named."""
        return self.kept(self.see(images), names)

    def kept(self, seen: Seen, names: Collection[str] | None = None) -> dict[str, Tensor]:
        """What is kept of frames that the encoder saw, or what of that is named."""
        names, kept = self.sizes if names is None else names, {}
        vector = self.basis(seen.tokens) if "vector" in names else None
        if "tokens" in names:
            kept["tokens"] = self.cut_down(seen.tokens, vector)
        if vector is not None:
            kept["vector"] = vector
        if "class" in names and self.class_scale is not None and seen.class_token is not None:
            kept["class"] = self.class_scale(seen.class_token)
        return kept

    def cut_down(self, tokens: Tensor, vector: Tensor | None = None) -> Tensor:
        """Tokens (..., P, C), whole or cut down already, as they are kept.

        Args:
            vector: (..., K), the components of these frames, if they are known.
        """
        whole = tokens.shape[-1] != self.token_dim
        if not whole or self.patches is None:
            return tokens
        weight, bias = self._said()
        vector = self.basis(tokens) if vector is None else vector
        return self.patches(tokens) - torch.addmm(bias, vector.view(-1, len(weight)), weight).view(
            *tokens.shape[:-1], -1
        )

    def _said(self) -> tuple[Tensor, Tensor]:
        """What the frame's components, times (K, D), and their mean (D,) tell of all components of its patches.

        A tick would else lift each frame, which reads as many numbers as all its components have weights.
        """
        parts = self.basis.axes, self.basis.mean, self.patches.axes, self.patches.mean
        # They are loaded, or moved, from time to time; those made under inference_mode do not say how often.
        state = [(part.data_ptr(), 0 if part.is_inference() else part._version) for part in parts]
        if self._known[0] != state:
            n_components = self.basis.axes.shape[1]
            one_each = torch.eye(n_components, device=parts[0].device, dtype=parts[0].dtype)
            lifted = self.basis.lift(torch.cat([torch.zeros_like(one_each[:1]), one_each]))
            told = self.patches.parts(lifted.unflatten(-1, (self.n_patches, -1))).flatten(1)
            self._known = state, (told[1:] - told[0], told[0])
        return self._known[1]


def _say(encoder: PatchEncoder, images: Tensor) -> dict[str, Tensor]:
    """What an encoder says of images, by name."""
    said = encoder(images)._asdict()
    return {name: tensor for name, tensor in said.items() if tensor is not None}
