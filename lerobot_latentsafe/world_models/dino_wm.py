"""DINO-WM: a transformer that predicts a frozen encoder's patch tokens (Zhou et al., 2024), the paper's hardware model.

A frame is P tokens, one a patch, in which the cameras' tokens of that patch lie side by side. From tokens,
proprioception and action of a frame and of the H - 1 frames before it, the model predicts how tokens and proprioception
change. Past frames are there as keys and values (see `frame_transformer.py`): `step` works on one frame only, and the
same `step` serves training, imagination and the shield.

As published, with the action concatenated and a one-step loss, such a model ignores the action: from one frame to the
next hardly anything changes. So by default action and proprioception modulate every layer (AdaLN), the rest of each
clip is imagined from its start (open loop), and what changes weighs more than what does not.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.encoders.perception import Perception, PerceptionConfig
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.runtime.distributed import from_first_rank, mean_over_ranks
from lerobot_latentsafe.world_models.base import WorldModelConfig
from lerobot_latentsafe.world_models.frame_transformer import FrameTransformer, Linear
from lerobot_latentsafe.world_models.patch_summary import PatchSummary
from lerobot_latentsafe.world_models.termination import TerminationHead

CONDITIONINGS = ("adaln", "concat")
MOST_WEIGHT = 5.0
"""The error of a token that changes weighs at most so many times the average."""


@WorldModelConfig.register_subclass("dino_wm")
@dataclass
class DinoWMConfig(WorldModelConfig):
    """The default is the compact preset for two cores; `configs/bag_dino_wm_paper.yaml` holds the paper's sizes.

    Attributes:
        perception: the frozen encoder.
        history: H, the frames a prediction is made from.
        dim, depth, heads, head_dim, mlp: the transformer's width, layers, attention heads, their width, and the
            hidden width of its feed-forward layers.
        conditioning: how action and proprioception enter: `adaln` modulates every layer; `concat` embeds each in
            `embedding` numbers that are part of every token, as in the paper.
        embedding: see `conditioning`.
        decoder_layers: layers of the heads that predict each camera's tokens and proprioception.
        summary: width of the patch features whose mean and maximum over patches margin, actor and critic read.
        observed: frames of a clip that are seen before the rest is imagined, at most.
        open_loop: weight of the error of what is imagined open loop; 0 is teacher forcing alone, as in the paper.
        change_weight: share of a token error's weight that follows how much the token changes.
        blind: see no images, only proprioception: the control that a model which looks must beat.
    """

    perception: PerceptionConfig = field(default_factory=PerceptionConfig)
    image_size: int = 96
    clip_length: int = 9
    history: int = 3
    dim: int = 96
    depth: int = 3
    heads: int = 3
    head_dim: int = 32
    mlp: int = 384
    conditioning: str = "adaln"
    embedding: int = 10
    decoder_layers: int = 1
    summary: int = 32
    observed: int = 3
    open_loop: float = 1.0
    change_weight: float = 0.7
    blind: bool = False

    def of_cache(self, manifest: dict) -> "DinoWMConfig":
        """With the encoder of a token cache; see the base class."""
        return replace(self, perception=self.perception.of_cache(manifest))

    def build(self, image_keys: list[str], state_dim: int, action_dim: int) -> "DinoWM":
        """A DINO-WM with fresh weights."""
        if not image_keys:
            raise ValueError("a DINO-WM needs at least one camera, got none; record observation.image* features")
        perception = Perception(self.perception, image_keys, self.image_size)
        sizes = (perception.n_patches, perception.token_dim)
        return DinoWM(self, image_keys, state_dim, action_dim, *sizes, perception)


class _Ahead(NamedTuple):
    """What follows each of T frames: tokens (B, T, P, C), state (B, T, S), context (B, T, d); and the transformer's
    keys and values of these frames and the H - 1 before them, a tensor (B, H - 1 + T, P, 2 K) for each layer."""

    tokens: Tensor
    state: Tensor
    context: Tensor
    kept: list[Tensor]


def _change_decoder(n_in: int, n_layers: int, n_out: int) -> nn.Sequential:
    """Predicts a change, and starts near the best guess without learning: nothing changes."""
    layers: list[nn.Module] = []
    for _ in range(n_layers - 1):
        layers += [Linear(n_in, n_in), nn.GELU()]
    last = Linear(n_in, n_out)
    with torch.no_grad():
        last.weight.mul_(0.1)
        last.bias.zero_()
    return nn.Sequential(*layers, last)


class DinoWM(TerminationHead):
    """See the module's text. A latent holds

        tokens (B, P, C), state (B, S)    of the frame, seen or imagined
        context (B, d)                    what the frames before said of it: the transformer's output, mean over patches
        seen (B,)                         frames known, this one included, at most H; 0 before the first
        past_i (B, H - 1, P, 2 K)         keys and values of the frames before in layer i
        action (B, A)                     that led here

    Args:
        n_patches, token_dim: P and C.
        perception: what makes tokens of images; without it the model reads tokens only.
    """

    config: DinoWMConfig

    def __init__(
        self, config: DinoWMConfig, image_keys: list[str], state_dim: int, action_dim: int, n_patches: int,
        token_dim: int, perception: Perception | None = None,
    ):  # fmt: skip
        super().__init__()
        _check(config)
        self.config = config if perception is None else replace(config, perception=perception.config)
        self.image_keys, self.action_dim = sorted(image_keys), action_dim
        self._perception = [perception]  # in a list, so that it is not part of the checkpoint
        d, width = config.dim, config.summary
        self._build_inputs(n_patches, token_dim, state_dim)
        condition_dim = d if config.conditioning == "adaln" else None
        self.transformer = FrameTransformer(
            d, config.depth, config.heads, config.head_dim, config.mlp, config.history, condition_dim
        )
        self.past_names = [f"past_{i}" for i in range(config.depth)]
        self.decoders = nn.ModuleList(
            _change_decoder(d, config.decoder_layers, token_dim // len(image_keys)) for _ in self.image_keys
        )
        self.state_decoder = _change_decoder(d + state_dim + action_dim, config.decoder_layers, state_dim)
        self.summary = PatchSummary(n_patches, token_dim, width)
        self.feature_dim = 2 * width + d + state_dim
        self.continues = nn.Sequential(nn.Linear(self.feature_dim, 64), nn.SiLU(), nn.Linear(64, 1))
        self.sizes = {"tokens": (n_patches, token_dim), "state": (state_dim,), "context": (d,), "action": (action_dim,)}

    def _build_inputs(self, n_patches: int, token_dim: int, state_dim: int) -> None:
        config, d = self.config, self.config.dim
        width = d
        if config.conditioning == "adaln":
            self.condition_in = nn.Sequential(
                nn.Linear(state_dim + self.action_dim, d), nn.SiLU(), nn.Linear(d, d), nn.SiLU()
            )
        else:
            self.state_in = nn.Linear(state_dim, config.embedding)
            self.action_in = nn.Linear(self.action_dim, config.embedding)
            width = d - 2 * config.embedding
        self.token_in = nn.Identity() if width == token_dim else Linear(token_dim, width)
        # As large as the tokens: while patches are hard to tell apart, what an action moves is not learned.
        self.position = nn.Parameter(torch.randn(n_patches, d))

    # -- the model ---

    @property
    def percept_names(self) -> list[str]:
        """Tokens of the frame."""
        return ["tokens"]

    def perceive(self, images: dict[str, Tensor]) -> dict[str, Tensor]:
        """Camera key -> (B, 3, S, S) to tokens (B, P, C)."""
        perception = self._perception[0]
        if perception is None:
            raise RuntimeError("this DINO-WM was made for tokens; build it from its configuration to let it see images")
        return {"tokens": perception.tokens(images)}

    def initial(self, batch_size: int) -> Latent:
        """Nothing seen, no frames remembered: (B, ...)."""
        latent = {name: self.position.new_zeros(batch_size, *size) for name, size in self.sizes.items()}
        seen = torch.zeros(batch_size, dtype=torch.long, device=self.position.device)
        past = self.transformer.empty_past(batch_size, len(self.position))
        return {**latent, "seen": seen, **dict(zip(self.past_names, past))}

    def step(self, latent: Latent, action: Tensor) -> Latent:
        """Next latent under actions (B, A), from the frame and the H - 1 before it."""
        past = [latent[name] for name in self.past_names]
        now = (latent["tokens"], latent["state"], action, latent["seen"])
        return self._next_latent(self._advance(*(t[:, None] for t in now), past=past), 0, latent["seen"], action)

    def correct(self, predicted: Latent, percepts: dict[str, Tensor], state: Tensor) -> Latent:
        """The tokens and state that were seen in place of those predicted."""
        return {**predicted, "tokens": self._looked_at(percepts), "state": state}

    def features(self, latent: Latent) -> Tensor:
        """Summary of the tokens, context and state side by side: (..., D)."""
        return torch.cat([self.summary(latent["tokens"]), latent["context"], latent["state"]], -1)

    def tokens_of(self, latent: Latent) -> Tensor | None:
        """The tokens (B, P, C) as they are; None if it is blind."""
        return None if self.config.blind else latent["tokens"]

    def error(self, latent: Latent, percepts: dict[str, Tensor], state: Tensor) -> Tensor:
        """Mean squared error of the tokens (of the state, if blind): (B,)."""
        if self.config.blind:
            return (latent["state"] - state).square().mean(-1)
        return (latent["tokens"] - percepts["tokens"]).square().mean((-2, -1))

    def _looked_at(self, percepts: dict[str, Tensor]) -> Tensor:
        return torch.zeros_like(percepts["tokens"]) if self.config.blind else percepts["tokens"]

    def _advance(
        self, tokens: Tensor, state: Tensor, action: Tensor, seen: Tensor, *, past: list[Tensor] | None = None
    ) -> _Ahead:
        """One step ahead of each of T frames, under the actions taken there.

        Args:
            tokens (B, T, P, C), state (B, T, S), action (B, T, A); seen (B, T) and past as in the transformer.
        """
        x, condition = self._embed(tokens, state, action)
        x, kept = self.transformer(x, seen, past, condition)
        context = x.mean(-2)
        tokens = tokens + torch.cat([decoder(x) for decoder in self.decoders], -1)
        state = state + self.state_decoder(torch.cat([context, state, action], -1))
        # Of a first frame nothing was known before; what the empty latent led to must not say otherwise.
        return _Ahead(tokens, state, context * (seen > 0)[..., None], kept)

    def _embed(self, tokens: Tensor, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor | None]:
        """The transformer's input (B, T, P, d), and with AdaLN the condition (B, T, d) of its layers."""
        x = self.token_in(tokens)
        if self.config.conditioning == "adaln":
            return x + self.position, self.condition_in(torch.cat([state, action], -1))
        both = torch.cat([self.state_in(state), self.action_in(action)], -1).unsqueeze(-2)
        return torch.cat([x, both.expand(*x.shape[:-1], -1)], -1) + self.position, None

    def _next_latent(self, ahead: _Ahead, t: int, seen: Tensor, action: Tensor) -> Latent:
        """The latent after frame t, of which `seen` (B,) frames were known, under `action` (B, A)."""
        history = self.config.history
        return {
            "tokens": ahead.tokens[:, t],
            "state": ahead.state[:, t],
            "context": ahead.context[:, t],
            "seen": (seen + 1).clamp(max=history),
            "action": action,
            **{name: kept[:, t + 1 : t + history] for name, kept in zip(self.past_names, ahead.kept)},
        }

    # -- learning ---

    def loss(self, clip: Clip) -> tuple[Tensor, Tensor, dict[str, float]]:
        """Errors one step ahead of frames that were seen (teacher forcing), and of the rest imagined open loop.

        The features are those of latents seen and, from where imagination took over, of latents imagined.
        """
        tokens, state = self._looked_at(clip.percepts), clip.state
        seen = self._frames_seen(clip.is_first)
        goes_on = clip.valid[:, 1:] & clip.valid[:, :-1] & ~clip.is_first[:, 1:]
        ahead = self._advance(tokens[:, :-1], state[:, :-1], clip.action[:, 1:], seen[:, :-1])
        context = F.pad(ahead.context, (0, 0, 1, 0)) * (seen > 1)[..., None]
        frames = {"tokens": tokens, "state": state, "context": context}
        unit = self._unit_of_change(frames, goes_on)
        losses = self._errors(ahead.tokens, ahead.state, frames, goes_on, slice(0, -1), unit)
        metrics = {f"loss_{name}": value.item() for name, value in losses.items()}
        loss = sum(losses.values())
        if self.config.open_loop > 0:
            last = self._last_observed(clip)
            imagined = self._imagine(ahead, clip, seen, last)
            alive = goes_on[:, last:].cumprod(1).bool()
            since = slice(last, last + 1)
            losses = self._errors(imagined["tokens"], imagined["state"], frames, alive, since, unit)
            metrics |= {f"loss_{name}_open_loop": value.item() for name, value in losses.items()}
            loss = loss + self.config.open_loop * sum(losses.values())
            for name, truth in frames.items():
                ahead_of_last = torch.where(_like(alive, truth), imagined[name], truth[:, last + 1 :])
                frames[name] = torch.cat([truth[:, : last + 1], ahead_of_last], 1)
        features = self.features(frames)
        return loss + self.end_loss(features, clip), features, metrics

    def _frames_seen(self, is_first: Tensor) -> Tensor:
        """How many frames each may look at, itself included, at most H: (B, T)."""
        index = torch.arange(is_first.shape[1], device=is_first.device).expand(is_first.shape)
        start = torch.where(is_first, index, 0).cummax(1).values
        return (index - start + 1).clamp(max=self.config.history)

    def _last_observed(self, clip: Clip) -> int:
        """Index of the last frame seen before imagination takes over; random in training."""
        most = min(self.config.observed, clip.state.shape[1] - 1)
        return int(from_first_rank(torch.randint(most, (), device=clip.state.device))) if self.training else most - 1

    def _imagine(self, ahead: _Ahead, clip: Clip, seen: Tensor, last: int) -> Latent:
        """Frames (B, N, ...) after `last`; the first of them is what teacher forcing has predicted."""
        rows = [self._next_latent(ahead, last, seen[:, last], clip.action[:, last + 1])]
        for t in range(last + 2, clip.state.shape[1]):
            rows.append(self.step(rows[-1], clip.action[:, t]))
        return {name: torch.stack([row[name] for row in rows], 1) for name in ("tokens", "state", "context")}

    def _by_camera(self, tokens: Tensor) -> Tensor:
        """Mean squares of differences (..., P, C) of tokens: (..., P, cameras)."""
        return tokens.square().unflatten(-1, (len(self.image_keys), -1)).mean(-1)

    def _unit_of_change(self, frames: dict[str, Tensor], goes_on: Tensor) -> dict[str, Tensor]:
        """Mean squared change from one frame to the next, of each camera's tokens (cameras,) and of state ()."""
        tokens, state = (torch.diff(frames[name], dim=1) for name in ("tokens", "state"))
        change = {"tokens": self._by_camera(tokens).mean(-2), "state": _mean_square(state)}
        return {name: mean_over_ranks(_mean(value, goes_on)).clamp(min=1e-6) for name, value in change.items()}

    def _errors(
        self, tokens: Tensor, state: Tensor, frames: dict[str, Tensor], counts: Tensor, since: slice,
        unit: dict[str, Tensor],
    ) -> dict[str, Tensor]:  # fmt: skip
        """Mean squared errors of the last N frames of a clip, in units of the change from one frame to the next.

        Args:
            tokens (B, N, P, C), state (B, N, S): predicted.
            frames: the clip's.
            counts: bool (B, N), whether a frame is compared.
            since: the frames, N or one, since which a token's change makes it weigh.
        """
        truth = {name: frames[name][:, -tokens.shape[1] :] for name in ("tokens", "state")}
        errors = {"state": _mean(_mean_square(state - truth["state"]), counts) / unit["state"]}
        if not self.config.blind:
            weight = self._weight(self._by_camera(truth["tokens"] - frames["tokens"][:, since]), counts)
            error = (self._by_camera(tokens - truth["tokens"]) * weight).mean(-2)
            errors["tokens"] = (_mean(error, counts) / unit["tokens"]).mean()
        return errors

    def _weight(self, change: Tensor, counts: Tensor) -> Tensor:
        """Weights of tokens that changed so much (B, N, P, cameras), relative to their frame's mean over the batch."""
        share, counts = self.config.change_weight, _like(counts, change)
        parts = ((change * counts).mean((0, 2), keepdim=True), counts.float().mean((0, 2), keepdim=True))
        usual, counted = (mean_over_ranks(part) for part in parts)
        usual = usual / counted.clamp(min=1e-6)
        return 1 - share + share * (change / usual.clamp(min=1e-6)).clamp(max=MOST_WEIGHT)


def _like(mask: Tensor, x: Tensor) -> Tensor:
    """A mask (B, N) with the axes of x (B, N, ...)."""
    return mask.reshape(*mask.shape, *[1] * (x.ndim - 2))


def _mean_square(x: Tensor) -> Tensor:
    """Of the last axis, which may be empty: 0 then."""
    return x.square().sum(-1) / max(1, x.shape[-1])


def _mean(x: Tensor, counts: Tensor) -> Tensor:
    """Mean over batch and time of (B, N, ...) where it counts; on several ranks, their average is that mean."""
    return (x * _like(counts, x)).sum((0, 1)) / mean_over_ranks(counts.sum()).clamp(min=1e-6)


def _check(config: DinoWMConfig) -> None:
    if config.conditioning not in CONDITIONINGS:
        raise ValueError(f"conditioning is {config.conditioning!r}; expected one of {', '.join(CONDITIONINGS)}")
    if config.clip_length < 2:
        raise ValueError(f"clip_length is {config.clip_length}; a prediction needs at least 2 frames")
    if config.head_dim % 2:
        raise ValueError(f"head_dim is {config.head_dim}; the rotary embedding turns pairs, give an even number")
    if config.conditioning == "concat" and config.dim <= 2 * config.embedding:
        raise ValueError(f"dim is {config.dim}; twice embedding={config.embedding} of it leave nothing for the tokens")
