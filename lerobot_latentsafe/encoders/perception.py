"""What a token world model sees of a frame: a frozen encoder's tokens, or their principal components."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from lerobot_latentsafe.encoders.patch_encoders import PatchEncoder, load_encoder

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
    """

    encoder: str = "auto"
    encoder_hash: str | None = None
    basis_hash: str | None = None
    components: int = 128

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
        for name, remedy in (
            ("encoder_hash", "encode the dataset with that encoder (latentsafe cache --encoder=...)"),
            ("basis_hash", "build the cache with --basis_from=<the cache that was trained on>"),
        ):
            known = getattr(self, name)
            if known is not None and known != manifest[name]:
                raise EncoderMismatchError(
                    f"the cache has {name} {manifest[name]}, the world model was trained with {known}; {remedy}, or "
                    "train anew"
                )
        adopted = {name: manifest[name] for name in ("encoder", "encoder_hash", "basis_hash")}
        return replace(self, **adopted)


class FrameBasis(nn.Module):
    """Principal components of the flattened tokens of a frame, on one scale: (..., P, C) -> (..., K)."""

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
        if not self.fitted:
            raise RuntimeError(
                "no principal components yet: they come with a token cache. Run latentsafe cache --encoder=auto and "
                "train on its folder"
            )
        return (tokens.flatten(-2) - self.mean) @ self.axes

    def lift(self, components: Tensor) -> Tensor:
        """Components of frames (..., K) -> the flattened tokens (..., P C) nearest to the mean that have them."""
        return components @ torch.linalg.solve(self.axes.T @ self.axes, self.axes.T) + self.mean

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


class Perception(nn.Module):
    """Images -> {"tokens": (B, P, n_cameras x dim), "vector": (B, components)}; `config` names the encoder found.

    The encoder's weights are not part of a checkpoint; its name and hash in the configuration are.
    """

    _latest: ClassVar[dict[tuple, tuple[Tensor, Tensor]]] = {}
    """Pictures encoded last and their tokens: a policy and the filter that shields it look at the same ones."""

    def __init__(self, config: PerceptionConfig, image_keys: list[str], image_size: int):
        super().__init__()
        self.image_keys, self.image_size = sorted(image_keys), image_size
        encoder = load_encoder(config.encoder, config.encoder_hash)
        self.config = replace(config, encoder=encoder.name, encoder_hash=encoder.weights_hash())
        self.encoder_hash = self.config.encoder_hash
        self._encoder = [encoder]  # in a list, so that its weights are not ours
        self.n_patches = (image_size // encoder.patch) ** 2
        self.token_dim = encoder.dim * len(self.image_keys)
        self.basis = FrameBasis(self.n_patches * self.token_dim, config.components)

    @property
    def encoder(self) -> PatchEncoder:
        """The frozen encoder."""
        return self._encoder[0]

    def tokens(self, images: dict[str, Tensor]) -> Tensor:
        """Camera key -> (B, 3, S, S) in [0, 1] to tokens (B, P, n_cameras x dim), a patch of each side by side."""
        together = torch.cat([images[key] for key in self.image_keys])
        key = self.encoder_hash, len(self.image_keys), together.device
        known, tokens = self._latest.get(key, (None, None))
        if known is not None and torch.equal(known, together):
            return tokens
        if self.encoder.mean.device != together.device:  # asking all of its modules at each tick takes milliseconds
            self.encoder.to(together.device)
        tokens = torch.cat(self.encoder(together).float().chunk(len(self.image_keys)), -1)
        if len(together) <= LIVE:
            self._latest[key] = together, tokens
        return tokens

    def load_basis(self, file: Path) -> None:
        """Principal components from a file of a token cache."""
        self.basis.load_state_dict(load_file(file))

    def forward(self, images: dict[str, Tensor]) -> dict[str, Tensor]:
        """Tokens of frames (..., P, C) -> their components (..., K)."""
        tokens = self.tokens(images)
        return {"tokens": tokens, "vector": self.basis(tokens)}
