"""What a token world model sees of a frame: a frozen encoder's tokens, or their principal components."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lerobot_latentsafe.datasets.frame_cache import BASIS, FOLDER, FrameCacheError
from lerobot_latentsafe.world_models.encoders import PatchEncoder, load_encoder
from lerobot_latentsafe.world_models.frame_transformer import Linear

LIVE = 64
"""So many pictures at most are of robots that act now, and are remembered until the next ones."""


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

    def adopt_cache(self, manifest: dict) -> None:
        """Take encoder and principal components over from a token cache, or check that they are the same.

        Raises:
            FrameCacheError: it holds pictures, or was made with another encoder or other components.
        """
        if "encoder_hash" not in manifest:
            raise FrameCacheError(
                "this cache holds pictures, the world model reads an encoder's tokens; build one with "
                "latentsafe cache --encoder=auto"
            )
        for name, remedy in (
            ("encoder_hash", "encode the dataset with that encoder (latentsafe cache --encoder=...)"),
            ("basis_hash", "build the cache with --basis_from=<the cache that was trained on>"),
        ):
            known = getattr(self, name)
            if known is not None and known != manifest[name]:
                raise FrameCacheError(
                    f"the cache has {name} {manifest[name]}, the world model was trained with {known}; {remedy}, or "
                    "train anew"
                )
            setattr(self, name, manifest[name])
        self.encoder = manifest["encoder"]


class FrameBasis(nn.Module):
    """Principal components of the flattened tokens of a frame, on one scale: (..., P, C) -> (..., K)."""

    def __init__(self, n_inputs: int, n_components: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(n_inputs))
        self.register_buffer("axes", torch.zeros(n_inputs, n_components))
        self.register_buffer("fitted", torch.zeros((), dtype=torch.bool))

    def forward(self, tokens: Tensor) -> Tensor:
        if not self.fitted:
            raise RuntimeError(
                "no principal components yet: they come with a token cache. Run latentsafe cache --encoder=auto and "
                "train on its folder"
            )
        return (tokens.flatten(-2) - self.mean) @ self.axes

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


class PatchSummary(nn.Module):
    """What is learned of a frame's patches, its mean and maximum over them: tokens (..., P, C) -> (..., 2 width).

    What is small, a candy on a table, is all there is to see in its patch and nothing to components of whole frames.
    """

    def __init__(self, n_patches: int, token_dim: int, width: int):
        super().__init__()
        self.enter, self.leave = Linear(token_dim, width), Linear(width, width)
        self.position = nn.Parameter(torch.randn(n_patches, width))
        self.norm = nn.LayerNorm(2 * width)

    def forward(self, tokens: Tensor) -> Tensor:
        patches = self.leave(F.gelu(self.enter(tokens) + self.position))
        return self.norm(torch.cat([patches.mean(-2), patches.amax(-2)], -1))


class Perception(nn.Module):
    """Images -> {"tokens": (B, P, n_cameras x dim), "vector": (B, components)}.

    The encoder's weights are not part of a checkpoint; its name and hash in the configuration are.
    """

    _latest: ClassVar[dict[tuple, tuple[Tensor, Tensor]]] = {}
    """Pictures encoded last and their tokens: a policy and the filter that shields it look at the same ones."""

    def __init__(self, config: PerceptionConfig, image_keys: list[str], image_size: int):
        super().__init__()
        self.image_keys, self.image_size = sorted(image_keys), image_size
        encoder = load_encoder(config.encoder, config.encoder_hash)
        config.encoder, config.encoder_hash = encoder.name, encoder.weights_hash()
        self.encoder_hash = config.encoder_hash
        self._encoder = [encoder]  # in a list, so that its weights are not ours
        self.n_patches = (image_size // encoder.patch) ** 2
        self.token_dim = encoder.dim * len(self.image_keys)
        self.basis = FrameBasis(self.n_patches * self.token_dim, config.components)

    @property
    def encoder(self) -> PatchEncoder:
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

    def load_basis(self, cache: Path) -> None:
        """Principal components from a token cache."""
        from safetensors.torch import load_file

        self.basis.load_state_dict(load_file(cache / FOLDER / BASIS))

    def forward(self, images: dict[str, Tensor]) -> dict[str, Tensor]:
        tokens = self.tokens(images)
        return {"tokens": tokens, "vector": self.basis(tokens)}
