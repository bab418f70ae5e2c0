"""Recurrent state-space model (Hafner et al., 2019; DreamerV3), the paper's model in simulation.

z_t = (h_t, x_t): h_t = GRU(h_{t-1}, x_{t-1}, a_{t-1}) is deterministic, x_t is Gaussian or categorical with a prior
p(x_t | h_t) and a posterior q(x_t | h_t, o_t). Training reconstructs images and proprioception and pulls prior and
posterior together. Filtering and `step` carry means or modes, so they are deterministic; `sample_step` samples.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.runtime.distributed import mean_over_ranks
from lerobot_latentsafe.world_models.base import WorldModelConfig
from lerobot_latentsafe.world_models.stochastic import Categorical, Gaussian, Statistics
from lerobot_latentsafe.world_models.termination import TerminationHead


@WorldModelConfig.register_subclass("rssm")
@dataclass
class RSSMConfig(WorldModelConfig):
    """The default is the compact preset for two cores; `configs/dubins_rssm_paper.yaml` holds the paper's sizes.

    Attributes:
        deterministic, stochastic, hidden: sizes of h, x and of the layers between them.
        classes: 0: x is `stochastic` Gaussians; else `stochastic` categoricals of so many classes (32 of 32 in the
            paper's manipulation).
        unimix: share of a categorical's probability that is uniform.
        encoder: `mlp` reads small images flat; `cnn` is DreamerV3's strided network down to 4 x 4.
        cnn_depth: channels of the first of the CNN's layers, doubled at each.
        units, image_layers: width and depth of the MLP image encoder and decoder.
        state_units, state_layers: the same for proprioception.
        min_std: lower bound of the latent's standard deviation.
        free_nats, dynamics_scale, representation_scale: KL balancing as in DreamerV3.
        image_scale: weight of the squared image error, summed over pixels. 16 makes a 32 x 32 image weigh
            what the same picture weighs at 128 x 128.
        decoder: whether it can draw what it imagines. It learns by drawing; a filter at work need not draw.
    """

    image_size: int = 32
    clip_length: int = 16
    deterministic: int = 256
    stochastic: int = 32
    hidden: int = 256
    classes: int = 0
    unimix: float = 0.01
    encoder: str = "mlp"
    cnn_depth: int = 32
    units: int = 240
    image_layers: int = 2
    state_units: int = 64
    state_layers: int = 2
    min_std: float = 0.1
    free_nats: float = 1.0
    dynamics_scale: float = 0.5
    representation_scale: float = 0.1
    image_scale: float = 16.0
    decoder: bool = True

    def build(self, image_keys: list[str], state_dim: int, action_dim: int) -> "RSSM":
        """An RSSM with fresh weights."""
        return RSSM(self, image_keys, state_dim, action_dim)


class _ChannelNorm(nn.LayerNorm):
    """Layer norm over channels; in channels-last memory the permutation is a view."""

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


def mlp(n_in: int, units: int, n_layers: int) -> nn.Sequential:
    """Layers of DreamerV3: linear, normalised, SiLU."""
    layers: list[nn.Module] = []
    for i in range(n_layers):
        layers += [nn.Linear(n_in if i == 0 else units, units, bias=False), nn.LayerNorm(units), nn.SiLU()]
    return nn.Sequential(*layers)


def _cnn_channels(config: RSSMConfig) -> list[int]:
    """Channels of the strided layers from the image's side down to 4."""
    n_layers = (config.image_size // 4).bit_length() - 1
    if config.image_size != 4 * 2**n_layers:
        raise ValueError(f"image_size is {config.image_size}; the cnn encoder needs 4 times a power of two")
    return [config.cnn_depth * 2**i for i in range(n_layers)]


class _ImageEncoder(nn.Module):
    """(N, 3, S, S) -> (N, dim)."""

    def __init__(self, config: RSSMConfig):
        super().__init__()
        self.flat = config.encoder == "mlp"
        if self.flat:
            self.dim = config.units
            pixels = 3 * config.image_size**2
            self.net = nn.Sequential(nn.Flatten(), mlp(pixels, config.units, config.image_layers))
            return
        channels = _cnn_channels(config)
        layers: list[nn.Module] = []
        for n_in, n_out in zip([3, *channels], channels):
            layers += [nn.Conv2d(n_in, n_out, 4, 2, 1, bias=False), _ChannelNorm(n_out, eps=1e-3), nn.SiLU()]
        self.dim = channels[-1] * 16
        self.net = nn.Sequential(*layers, nn.Flatten())

    def forward(self, images: Tensor) -> Tensor:
        return self.net(images if self.flat else images.contiguous(memory_format=torch.channels_last))


class _ImageDecoder(nn.Module):
    """(N, D) -> (N, 3, S, S)."""

    def __init__(self, config: RSSMConfig, feature_dim: int):
        super().__init__()
        self.size = config.image_size
        self.flat = config.encoder == "mlp"
        if self.flat:
            last = nn.Linear(config.units, 3 * config.image_size**2)
            self.net = nn.Sequential(mlp(feature_dim, config.units, config.image_layers), last)
        else:
            channels = _cnn_channels(config)[::-1]
            self.channels = channels[0]
            self.project = nn.Linear(feature_dim, channels[0] * 16)
            layers: list[nn.Module] = []
            for n_in, n_out in pairwise(channels):
                layers += [
                    nn.ConvTranspose2d(n_in, n_out, 4, 2, 1, bias=False),
                    _ChannelNorm(n_out, eps=1e-3),
                ]
                layers.append(nn.SiLU())
            last = nn.ConvTranspose2d(channels[-1], 3, 4, 2, 1)
            self.net = nn.Sequential(*layers, last)
        # Start near the mean image: the first gradients then go to what moves.
        nn.init.zeros_(last.bias)
        with torch.no_grad():
            last.weight.mul_(0.1)

    def forward(self, features: Tensor) -> Tensor:
        if self.flat:
            return self.net(features).unflatten(1, (3, self.size, self.size))
        x = self.project(features).unflatten(1, (self.channels, 4, 4))
        return self.net(x.contiguous(memory_format=torch.channels_last))


class RSSM(TerminationHead):
    """See the module's text. Latent: h (B, H) and x (B, X), flat one-hot vectors where it is categorical."""

    config: RSSMConfig
    mean_count: Tensor

    def __init__(self, config: RSSMConfig, image_keys: list[str], state_dim: int, action_dim: int):
        super().__init__()
        if not image_keys:
            raise ValueError("an RSSM needs at least one camera, got none; record observation.image* features")
        if config.encoder not in ("mlp", "cnn"):
            raise ValueError(f"encoder is {config.encoder!r}; expected 'mlp' or 'cnn'")
        if config.classes < 0 or config.classes == 1:
            raise ValueError(f"classes is {config.classes}; expected 0 (Gaussian) or at least 2")
        self.config, self.image_keys, self.action_dim = config, sorted(image_keys), action_dim
        if config.classes:
            self.stochastic = Categorical(config.stochastic, config.classes, config.unimix)
        else:
            self.stochastic = Gaussian(config.stochastic, config.min_std)
        h, x, hidden = config.deterministic, self.stochastic.dim, config.hidden
        self.feature_dim = h + x
        # Module names must not hold dots, dataset keys do.
        self.cameras = {key: key.replace(".", "_") for key in self.image_keys}
        shape = (3, config.image_size, config.image_size)
        self.encoders = nn.ModuleDict({name: _ImageEncoder(config) for name in self.cameras.values()})
        drawn = self.cameras.values() if config.decoder else ()
        self.decoders = nn.ModuleDict({name: _ImageDecoder(config, self.feature_dim) for name in drawn})
        for name in self.cameras.values():
            self.register_buffer(f"mean_{name}", torch.zeros(shape))
        self.register_buffer("mean_count", torch.zeros(()))
        self.state_encoder = mlp(state_dim, config.state_units, config.state_layers)
        self.state_decoder = nn.Sequential(
            mlp(self.feature_dim, config.state_units, config.state_layers),
            nn.Linear(config.state_units, state_dim),
        )
        embedding = sum(e.dim for e in self.encoders.values()) + config.state_units
        self.embed_in = nn.Linear(embedding, hidden, bias=False)
        self.recurrent_in = nn.Linear(x + action_dim, hidden, bias=False)
        self.recurrent_norm = nn.LayerNorm(hidden, eps=1e-3)
        self.gru = nn.Linear(hidden + h, 3 * h, bias=False)
        self.gru_norm = nn.LayerNorm(3 * h, eps=1e-3)
        self.prior_in, self.prior_norm = nn.Linear(h, hidden, bias=False), nn.LayerNorm(hidden, eps=1e-3)
        self.prior_out = nn.Linear(hidden, self.stochastic.n_raw)
        self.posterior_in, self.posterior_norm = (
            nn.Linear(h, hidden, bias=False),
            nn.LayerNorm(hidden, eps=1e-3),
        )
        self.posterior_out = nn.Linear(hidden, self.stochastic.n_raw)
        self.h0 = nn.Parameter(torch.zeros(h))
        self.continues = nn.Sequential(mlp(self.feature_dim, config.state_units, 1), nn.Linear(config.state_units, 1))

    # -- the model ---

    def initial(self, batch_size: int) -> Latent:
        """The learned start of h and the prior's centre of x: (B, ...)."""
        h = torch.tanh(self.h0).expand(batch_size, -1)
        action = h.new_zeros(batch_size, self.action_dim)
        return {"h": h, "x": self.stochastic.centre(self._prior(h)), "action": action}

    def step(self, latent: Latent, action: Tensor) -> Latent:
        """Next latent under actions (B, A): x is the prior's mean or mode."""
        h = self._recur(latent["h"], latent["x"], action)
        return {"h": h, "x": self.stochastic.centre(self._prior(h)), "action": action}

    def sample_step(self, latent: Latent, action: Tensor) -> Latent:
        """Next latent under actions (B, A): x is drawn from the prior."""
        h = self._recur(latent["h"], latent["x"], action)
        return {"h": h, "x": self.stochastic.sample(self._prior(h)), "action": action}

    def correct(self, predicted: Latent, percepts: dict[str, Tensor], state: Tensor) -> Latent:
        """x of the posterior given what was seen, h as predicted."""
        posterior = self._posterior(predicted["h"], self.embed(percepts, state))
        return {**predicted, "x": self.stochastic.centre(posterior)}

    def features(self, latent: Latent) -> Tensor:
        """x and h side by side: (..., D)."""
        return torch.cat([latent["x"], latent["h"]], -1)

    def latent_of(self, features: Tensor, action: Tensor) -> Latent:
        """The latent with these features (N, D), led to by actions (N, A)."""
        x, h = features.split([self.stochastic.dim, self.config.deterministic], -1)
        return {"h": h, "x": x, "action": action}

    @property
    def draws(self) -> bool:
        """Whether it kept its decoders."""
        return self.config.decoder

    def stop_drawing(self) -> None:
        """Forget the decoders: what is left is smaller, and learns no more."""
        self.decoders, self.config = nn.ModuleDict(), replace(self.config, decoder=False)

    def error(self, latent: Latent, percepts: dict[str, Tensor], state: Tensor) -> Tensor:
        """Mean squared error of decoded pictures, or of features where it cannot draw: (B,)."""
        if not self.draws:
            seen = self.features(self.correct(latent, percepts, state))
            return (self.features(latent) - seen).square().mean(-1)
        decoded = self.decode(self.features(latent))
        errors = [(decoded[key] - percepts[key]).square().mean((1, 2, 3)) for key in self.image_keys]
        return torch.stack(errors).sum(0)

    def embed(self, images: dict[str, Tensor], state: Tensor) -> Tensor:
        """Observations (N, ...) -> (N, hidden)."""
        parts = [self.encoders[name](self._centred(key, images)) for key, name in self.cameras.items()]
        return self.embed_in(torch.cat([*parts, self.state_encoder(state)], -1))

    def decode(self, features: Tensor) -> dict[str, Tensor]:
        """Features (N, D) -> camera key -> images (N, 3, S, S), about in [0, 1]."""
        return {
            key: self.decoders[name](features) + getattr(self, f"mean_{name}") for key, name in self.cameras.items()
        }

    def _recur(self, h: Tensor, x: Tensor, action: Tensor) -> Tensor:
        u = F.silu(self.recurrent_norm(self.recurrent_in(torch.cat([x, action], -1))))
        gates = self.gru_norm(self.gru(torch.cat([u, h], -1))).to(h.dtype)  # h stays as precise under autocast
        reset, candidate, update = gates.chunk(3, -1)
        # The bias of -1 makes a fresh cell remember, as in DreamerV3.
        return torch.lerp(h, torch.tanh(torch.sigmoid(reset) * candidate), torch.sigmoid(update - 1))

    def _prior(self, h: Tensor) -> Statistics:
        return self.stochastic.read(self.prior_out(F.silu(self.prior_norm(self.prior_in(h)))))

    def _posterior(self, h: Tensor, embedding: Tensor) -> Statistics:
        u = F.silu(self.posterior_norm(self.posterior_in(h) + embedding))
        return self.stochastic.read(self.posterior_out(u))

    def _centred(self, key: str, images: dict[str, Tensor]) -> Tensor:
        return images[key] - getattr(self, f"mean_{self.cameras[key]}")

    # -- learning ---

    def loss(self, clip: Clip) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Reconstruction + balanced KL + continuation; samples x so that the model is trained as a distribution.

        Raises:
            ValueError: it was stored without its decoders.
        """
        if not self.draws:
            raise ValueError(
                "this world model was stored without what draws its imagination (world_model.decoder is false), and "
                "cannot learn; train the one that it was wrapped from"
            )
        if self.training:
            self._update_mean_image(clip)
        batch, length = clip.state.shape[:2]
        images = {key: value.flatten(0, 1) for key, value in clip.percepts.items()}
        embedding = self.embed(images, clip.state.flatten(0, 1)).unflatten(0, (batch, length))
        h, x, *posterior = self._filter_sampled(embedding, clip)
        features = torch.cat([x, h], -1)
        weight = clip.valid.float()
        weight = weight / mean_over_ranks(weight.sum()).clamp(min=1)

        kl_dynamics, kl_representation, kl = self._balanced_kl(h, tuple(posterior), weight)
        error = {}
        for key, name in self.cameras.items():
            residual = self.decoders[name](features.flatten(0, 1)) - self._centred(key, images)
            per_frame = residual.square().flatten(1).sum(1).unflatten(0, (batch, length))
            error[f"loss_{name}"] = (per_frame * weight).sum()
        state_error = (self.state_decoder(features) - clip.state).square().sum(-1)
        error_state = (state_error * weight).sum()
        loss = (
            self.config.image_scale * sum(error.values())
            + error_state
            + self.config.dynamics_scale * kl_dynamics
            + self.config.representation_scale * kl_representation
            + self.end_loss(features, clip)
        )
        return loss, features, {**error, "loss_state": error_state, "kl": kl}

    def _filter_sampled(self, embedding: Tensor, clip: Clip) -> list[Tensor]:
        """h, x and the posterior's statistics of every frame: (B, T, ...) each."""
        batch, length = embedding.shape[:2]
        start = self.initial(batch)
        h, x = start["h"], start["x"]
        rows = []
        for t in range(length):
            first = clip.is_first[:, t, None]
            h, x = torch.where(first, start["h"], h), torch.where(first, start["x"], x)
            h = self._recur(h, x, clip.action[:, t])
            posterior = self._posterior(h, embedding[:, t])
            x = self.stochastic.sample(posterior)
            rows.append((h, x, *posterior))
        return [torch.stack(column, 1) for column in zip(*rows)]

    def _balanced_kl(self, h: Tensor, posterior: Statistics, weight: Tensor) -> tuple[Tensor, ...]:
        prior, kl, free = self._prior(h), self.stochastic.kl, self.config.free_nats
        fixed = lambda statistics: tuple(t.detach() for t in statistics)  # noqa: E731
        dynamics, representation = kl(fixed(posterior), prior), kl(posterior, fixed(prior))
        mean_of = lambda kl: (kl * weight).sum()  # noqa: E731
        return (
            mean_of(dynamics.clamp(min=free)),
            mean_of(representation.clamp(min=free)),
            mean_of(dynamics).detach(),
        )

    @torch.no_grad()
    def _update_mean_image(self, clip: Clip, settle_after: int = 200) -> None:
        """Running mean image of the first batches, which the encoder subtracts and the decoder adds."""
        settling = self.mean_count < settle_after
        self.mean_count += settling
        for key, name in self.cameras.items():
            mean = getattr(self, f"mean_{name}")
            mean.lerp_(mean_over_ranks(clip.percepts[key].mean((0, 1))), settling / self.mean_count)
