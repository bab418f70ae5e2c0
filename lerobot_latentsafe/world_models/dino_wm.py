"""DINO-WM: a transformer that predicts a frozen encoder's patch tokens (Zhou et al., 2024), the paper's hardware model.

A frame is P tokens, one a patch, in which the cameras' tokens of that patch lie side by side. From tokens,
proprioception and action of a frame and of the H - 1 frames before it, the model predicts how tokens and proprioception
change. Past frames are there as keys and values (see `frame_transformer.py`): `step` works on one frame only, and the
same `step` serves training, imagination and the shield.

As published, with the action concatenated and a one-step loss, such a model ignores the action: from one frame to the
next hardly anything changes, and texture that nothing can predict drowns what the action moves. So by default

* action and proprioception modulate every layer (AdaLN);
* the rest of each clip is imagined from its start (open loop);
* a step of the model is several ticks of the robot (`frame_skip`);
* a frame token carries the principal components of the whole frame, and most of the loss weighs on it;
* a recurrent memory of the frame tokens tells all layers what happened before, and foretells the frame token by itself;
* the other tokens carry what these leave unsaid, as principal components of a patch, four patches side by side
  (`merge_patches`); a part of the clips is enough to learn them from (`token_share`).
"""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.datasets.frame_cache import FrameCacheError, basis_file
from lerobot_latentsafe.encoders.perception import Perception, PerceptionConfig
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.runtime.distributed import from_first_rank, mean_over_ranks, world_size
from lerobot_latentsafe.world_models.base import WorldModelConfig
from lerobot_latentsafe.world_models.frame_transformer import FrameTransformer
from lerobot_latentsafe.world_models.patch_summary import PatchSummary
from lerobot_latentsafe.world_models.termination import TerminationHead

CONDITIONINGS = ("adaln", "concat")
FRAME_PERCEPTS = {"components": ["vector"], "class": ["vector", "class"]}
"""What a frame token may carry -> the percepts that hold it."""
MOST_WEIGHT = 5.0
"""The error of a token that changes weighs at most so many times the average."""


@WorldModelConfig.register_subclass("dino_wm")
@dataclass
class DinoWMConfig(WorldModelConfig):
    """The default is the compact preset for two cores; `configs/bag_dino_wm_paper.yaml` holds the paper's sizes.

    Attributes:
        perception: the frozen encoder, and how many components of its tokens are read.
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
        merge_patches: so many patches a side, side by side, are one token.
        frame_token: whether a token beside the patches stands for the whole frame.
        frame_percept: what it carries: the frame's principal components (`components`); or these and the class token
            of each camera (`class`), of an encoder that has them: DINOv2 and DINOv3 do, efficientnet_lite0 does not.
        memory: width of the recurrent memory that a frame token has; 0: none, what was before is in keys and values
            alone.
        token_share: share of a batch's clips whose patches are predicted. The others teach the memory and the frame
            token, and the margin what these tell by themselves, and cost less.
        token_weight, frame_weight: of the errors of patches, and of the frame token.
        blind: see no images, only proprioception: the control that a model which looks must beat.
    """

    perception: PerceptionConfig = field(default_factory=PerceptionConfig)
    image_size: int = 96
    clip_length: int = 10
    frame_skip: int = 3
    history: int = 3
    dim: int = 128
    depth: int = 1
    heads: int = 4
    head_dim: int = 32
    mlp: int = 256
    conditioning: str = "adaln"
    embedding: int = 10
    decoder_layers: int = 1
    summary: int = 32
    observed: int = 4
    open_loop: float = 1.0
    change_weight: float = 0.0
    merge_patches: int = 2
    frame_token: bool = True
    frame_percept: str = "components"
    memory: int = 256
    token_share: float = 0.125
    token_weight: float = 0.1
    frame_weight: float = 1.0
    blind: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.conditioning not in CONDITIONINGS:
            raise ValueError(f"conditioning is {self.conditioning!r}; expected one of {', '.join(CONDITIONINGS)}")
        if self.frame_percept not in FRAME_PERCEPTS:
            raise ValueError(f"frame_percept is {self.frame_percept!r}; expected one of {', '.join(FRAME_PERCEPTS)}")
        if self.history < 1:
            raise ValueError(f"history is {self.history}; a prediction is made from at least 1 frame")
        if self.clip_length <= self.history:
            raise ValueError(
                f"clip_length is {self.clip_length}; a prediction from history={self.history} frames needs at least "
                f"{self.history + 1}"
            )
        if self.head_dim % 2:
            raise ValueError(f"head_dim is {self.head_dim}; the rotary embedding turns pairs, give an even number")
        if self.conditioning == "concat" and self.dim <= 2 * self.embedding:
            raise ValueError(f"dim is {self.dim}; twice embedding={self.embedding} of it leave nothing for the tokens")
        if self.memory < 0:
            raise ValueError(f"memory is {self.memory}; expected 0 (none) or the numbers that a frame token remembers")
        if not 0 < self.token_share <= 1:
            raise ValueError(f"token_share is {self.token_share}; expected a share of the clips, above 0 and up to 1")
        if self.merge_patches < 1:
            raise ValueError(f"merge_patches is {self.merge_patches}; expected 1 (as they are) or more")

    def of_cache(self, manifest: dict) -> "DinoWMConfig":
        """With the encoder of a token cache; see the base class."""
        config = replace(self, perception=self.perception.of_cache(manifest))
        if self.reads_class_tokens and "class" not in manifest["percepts"]:
            raise FrameCacheError(_no_class_token(manifest["encoder"]))
        return config

    @property
    def reads_class_tokens(self) -> bool:
        """Whether the frame token carries what the encoder says of the whole frame."""
        return self.frame_token and self.frame_percept == "class"

    def build(self, image_keys: list[str], state_dim: int, action_dim: int) -> "DinoWM":
        """A DINO-WM with fresh weights."""
        if not image_keys:
            raise ValueError("a DINO-WM needs at least one camera, got none; record observation.image* features")
        perception = Perception(self.perception, image_keys, self.image_size)
        if self.reads_class_tokens and perception.class_scale is None:
            raise ValueError(_no_class_token(perception.config.encoder))
        if perception.patches is not None and not self.frame_token:
            raise ValueError(
                f"world_model.frame_token is false, and the {perception.config.token_components} components of a token "
                "are of what the frame's components leave unsaid; build the cache with whole tokens (latentsafe cache "
                "--token_components=0), or keep the frame token"
            )
        n_frame = sum(perception.sizes[name][0] for name in FRAME_PERCEPTS[self.frame_percept])
        sizes = (perception.n_patches, perception.token_dim, n_frame)
        return DinoWM(self, image_keys, state_dim, action_dim, *sizes, perception)


def _no_class_token(encoder: str) -> str:
    return (
        f"world_model.frame_percept is class, and {encoder} has no class token, or its cache was made before they were "
        "kept; build the cache with an encoder that has one (latentsafe cache --encoder=dinov2), or set "
        "world_model.frame_percept=components"
    )


class _Ahead(NamedTuple):
    """What follows each of T frames: by name tokens (B, T, P, C), vector (B, T, F), state (B, T, S) and context
    (B, T, d); and the transformer's keys and values of these frames and the H - 1 before them, a tensor
    (B, H - 1 + T, P, 2 K) for each layer."""

    frames: dict[str, Tensor]
    kept: list[Tensor]


def _change_decoder(n_in: int, n_layers: int, n_out: int, n_hidden: int | None = None) -> nn.Sequential:
    """Predicts a change, and starts near the best guess without learning: nothing changes."""
    layers: list[nn.Module] = []
    for _ in range(n_layers - 1):
        n_in, n_before = n_hidden or n_in, n_in
        layers += [nn.Linear(n_before, n_in), nn.GELU()]
    last = nn.Linear(n_in, n_out)
    with torch.no_grad():
        last.weight.mul_(0.1)
        last.bias.zero_()
    return nn.Sequential(*layers, last)


class DinoWM(TerminationHead):
    """See the module's text. A latent holds

        tokens (B, P, C), state (B, S)    of the frame, seen or imagined
        vector (B, F)                     of the whole frame, with a frame token; P counts it for past_i
        context (B, M)                    what the frames before said of it: the memory; without one, the transformer's
                                          output, mean over patches
        seen (B,)                         frames known, this one included, at most H; 0 before the first
        past_i (B, H - 1, P, 2 K)         keys and values of the frames before in layer i
        action (B, A)                     that led here

    Args:
        n_patches, token_dim: of the percepts, before patches are merged to P tokens of C numbers.
        n_frame: F, numbers that a frame token carries; by default all of the frame's components.
        perception: what makes tokens of images; without it the model reads tokens only.
    """

    config: DinoWMConfig

    def __init__(
        self, config: DinoWMConfig, image_keys: list[str], state_dim: int, action_dim: int, n_patches: int,
        token_dim: int, n_frame: int | None = None, perception: Perception | None = None,
    ):  # fmt: skip
        super().__init__()
        self.config = config if perception is None else replace(config, perception=perception.config)
        self.image_keys, self.action_dim = sorted(image_keys), action_dim
        self._perception = [perception]  # in a list, so that the encoder is not part of the checkpoint
        self.patches = None if perception is None else perception.patches
        self.basis = perception.basis if perception is not None and config.frame_token else None
        self.class_scale = perception.class_scale if perception is not None and config.reads_class_tokens else None
        self._grid = (*_merged_grid(n_patches, config.merge_patches), config.merge_patches)
        n_tokens, token_dim = self._grid[0] * self._grid[1], token_dim * config.merge_patches**2
        d, width = config.dim, config.summary
        n_frame = n_frame or config.perception.components
        self.memory_dim = config.memory if config.frame_token else 0
        self._build_inputs(n_tokens, token_dim, n_frame, state_dim)
        condition_dim = d if config.conditioning == "adaln" else None
        self.transformer = FrameTransformer(
            d, config.depth, config.heads, config.head_dim, config.mlp, config.history, condition_dim
        )
        self.past_names = [f"past_{i}" for i in range(config.depth)]
        self.decoders = nn.ModuleList(
            _change_decoder(d, config.decoder_layers, token_dim // len(image_keys)) for _ in self.image_keys
        )
        self.summary = PatchSummary(n_tokens, token_dim, width)
        n_context = self.memory_dim or d
        n_told = n_context + state_dim + self.action_dim
        self.feature_dim = 2 * width + n_context + state_dim
        self.sizes = {"tokens": (n_tokens, token_dim), "state": (state_dim,), "context": (n_context,)}
        self.sizes["action"] = (action_dim,)
        if config.frame_token:
            # With a memory, that must carry what the action does: so it learns what margin and critic need, too.
            n_known = n_told + n_frame + (-self.action_dim if self.memory_dim else d)
            self.frame_decoder = _change_decoder(n_known, 2, n_frame + state_dim, n_context)
            self.sizes["vector"] = (n_frame,)
            self.feature_dim += n_frame
        else:
            self.state_decoder = _change_decoder(n_told, config.decoder_layers, state_dim)
        self.seen_names: list[str] = [name for name in ("tokens", "vector", "state") if name in self.sizes]
        self.continues = nn.Sequential(nn.Linear(self.feature_dim, 64), nn.SiLU(), nn.Linear(64, 1))

    def _build_inputs(self, n_tokens: int, token_dim: int, n_frame: int, state_dim: int) -> None:
        config, d = self.config, self.config.dim
        width = d
        if self.memory_dim:
            n_heard = n_frame + state_dim + self.action_dim
            self.memory_in = nn.Sequential(nn.Linear(n_heard, self.memory_dim), nn.SiLU())
            self.memory = nn.GRUCell(self.memory_dim, self.memory_dim)
        if config.conditioning == "adaln":
            n_told = state_dim + self.action_dim + self.memory_dim
            self.condition_in = nn.Sequential(nn.Linear(n_told, d), nn.SiLU(), nn.Linear(d, d), nn.SiLU())
        else:
            self.state_in = nn.Linear(state_dim, config.embedding)
            self.action_in = nn.Linear(self.action_dim, config.embedding)
            width = d - 2 * config.embedding
        self.token_in = nn.Identity() if width == token_dim else nn.Linear(token_dim, width)
        if config.frame_token:
            self.frame_in = nn.Linear(n_frame, width)
        # As large as the tokens: while patches are hard to tell apart, what an action moves is not learned.
        self.position = nn.Parameter(torch.randn(n_tokens + config.frame_token, d))

    # -- the model ---

    def frozen_perception(self) -> Perception | None:
        """The encoder and the components of its tokens; None if it was made for tokens."""
        return self._perception[0]

    @property
    def percept_names(self) -> list[str]:
        """Tokens of the frame, and what of the whole of it a frame token carries."""
        return ["tokens", *self._frame_percepts]

    @property
    def _frame_percepts(self) -> list[str]:
        return FRAME_PERCEPTS[self.config.frame_percept] if self.config.frame_token else []

    def load_basis(self, root: Path) -> None:
        """Principal components, or the scale of class tokens, from a dataset's token cache."""
        perception = self._perception[0]
        if perception is not None and any(part is not None for part in (self.basis, self.patches, self.class_scale)):
            perception.load_basis(basis_file(root))

    def perceive(self, images: dict[str, Tensor]) -> dict[str, Tensor]:
        """Camera key -> (B, 3, S, S) to tokens (B, patches, ...), and with a frame token what it carries (B, F)."""
        perception = self._perception[0]
        if perception is None:
            raise RuntimeError("this DINO-WM was made for tokens; build it from its configuration to let it see images")
        return perception(images, self.percept_names)

    def initial(self, batch_size: int) -> Latent:
        """Nothing seen, no frames remembered: (B, ...)."""
        latent = {name: self.position.new_zeros(batch_size, *size) for name, size in self.sizes.items()}
        seen = torch.zeros(batch_size, dtype=torch.long, device=self.position.device)
        past = self.transformer.empty_past(batch_size, len(self.position))
        return {**latent, "seen": seen, **dict(zip(self.past_names, past))}

    def step(self, latent: Latent, action: Tensor) -> Latent:
        """Next latent under actions (B, A), from the frame and the H - 1 before it.

        With a memory a latent may lack tokens and past: then what follows does, too.
        """
        past = [latent[name] for name in self.past_names if name in latent]
        ahead = self._advance(self._now(latent), action[:, None], latent["seen"][:, None], past, latent["context"])
        return self._next_latent(ahead, 0, latent["seen"], action)

    def observe(
        self, latent: Latent | None, action: Tensor | None, percepts: dict[str, Tensor], state: Tensor
    ) -> Latent:
        """See the base class. With a memory it takes no prediction, as that gives way to what is seen."""
        if not self.memory_dim or latent is None or action is None:
            return super().observe(latent, action, percepts, state)
        now, told, seen = self._now(latent), [latent["state"][:, None], action[:, None]], latent["seen"][:, None]
        told += self._remembered(now, action[:, None], seen, latent["context"])
        past = [latent[name] for name in self.past_names]
        x, condition = self._embed(now, told)
        kept = self.transformer.keep(x, seen, past, condition)
        ahead = _Ahead({"context": told[-1] * (seen > 0)[..., None]}, kept)
        return self.correct(self._next_latent(ahead, 0, latent["seen"], action), percepts, state)

    def _now(self, latent: Latent) -> dict[str, Tensor]:
        """The frame of a latent, as one of a sequence: (B, 1, ...)."""
        return {name: latent[name][:, None] for name in self.seen_names if name in latent}

    def correct(self, predicted: Latent, percepts: dict[str, Tensor], state: Tensor) -> Latent:
        """What was seen in place of what was predicted."""
        return {**predicted, **self._looked_at(percepts), "state": state}

    def features(self, latent: Latent) -> Tensor:
        """Summary of the tokens (0 of none), context, state and what the frame token carries side by side: (..., D)."""
        frame, context = [latent["vector"]] if self.config.frame_token else [], latent["context"]
        if "tokens" in latent:
            summary = self.summary(latent["tokens"])
        else:
            summary = context.new_zeros(*context.shape[:-1], 2 * self.config.summary)
        return torch.cat([summary, context, latent["state"], *frame], -1)

    def tokens_of(self, latent: Latent) -> Tensor | None:
        """Whole tokens (B, patches, cameras x dim) that lie nearest to the data's mean and have what the latent tells.

        None if it is blind.
        """
        if self.config.blind:
            return None
        tokens = self._apart(latent["tokens"])
        if self.patches is not None:
            tokens = self.patches.lift(tokens) + self.basis.mean.unflatten(-1, (tokens.shape[-2], -1))
        if self.basis is not None:  # the frame's components are foretold by themselves
            missing = latent["vector"][..., : self.config.perception.components] - self.basis(tokens)
            tokens = tokens + (self.basis.lift(missing) - self.basis.mean).unflatten(-1, tokens.shape[-2:])
        return tokens

    def from_cache(self, cached: dict[str, Tensor]) -> dict[str, Tensor]:
        """With whole tokens cut down to the components that are read."""
        perception = self._perception[0]
        return cached if perception is None else {**cached, "tokens": perception.cut_down(cached["tokens"])}

    def error(self, latent: Latent, percepts: dict[str, Tensor], state: Tensor) -> Tensor:
        """Mean squared error of the whole frame, which action moves most; without a frame token of the tokens; of the
        state, if blind: (B,)."""
        if self.config.blind:
            return (latent["state"] - state).square().mean(-1)
        seen = self._looked_at(percepts)
        if self.config.frame_token:
            return (latent["vector"] - seen["vector"]).square().mean(-1)
        return (latent["tokens"] - seen["tokens"]).square().mean((-2, -1))

    def _looked_at(self, percepts: dict[str, Tensor]) -> dict[str, Tensor]:
        """What is seen of frames: tokens (..., P, C), if there are any, and vector (..., F) with a frame token."""
        seen = {"tokens": self._merged(percepts["tokens"])} if "tokens" in percepts else {}
        if self._frame_percepts:
            seen["vector"] = torch.cat([percepts[name] for name in self._frame_percepts], -1)
        return {name: torch.zeros_like(value) for name, value in seen.items()} if self.config.blind else seen

    def _merged(self, tokens: Tensor) -> Tensor:
        """Neighbouring patches side by side, camera by camera: (..., patches, cameras x K) -> (..., P, C)."""
        rows, columns, m = self._grid
        if m == 1:
            return tokens
        apart = tokens.unflatten(-1, (len(self.image_keys), -1)).unflatten(-3, (rows, m, columns, m))
        n = apart.dim()  # ONNX counts axes from the front
        return apart.movedim((n - 6, n - 4, n - 2), (n - 6, n - 5, n - 4)).flatten(-4).flatten(-3, -2)

    def _apart(self, tokens: Tensor) -> Tensor:
        """The inverse of `_merged`."""
        rows, columns, m = self._grid
        if m == 1:
            return tokens
        apart = tokens.unflatten(-1, (len(self.image_keys), m, m, -1)).unflatten(-5, (rows, columns))
        return apart.movedim((-6, -5, -4), (-6, -4, -2)).flatten(-2).flatten(-5, -2)

    def _advance(
        self, frames: dict[str, Tensor], action: Tensor, seen: Tensor, past: list[Tensor] | None = None,
        context: Tensor | None = None,
    ) -> _Ahead:  # fmt: skip
        """One step ahead of each of T frames, under the actions taken there.

        Args:
            frames: tokens (B, T, P, C), state (B, T, S) and perhaps vector (B, T, F); with a memory, tokens may lack.
            action: (B, T, A).
            seen: (B, T), and past: as in the transformer.
            context: (B, M), of the first of them; None if nothing was before.
        """
        state, known = frames["state"], (seen > 0)[..., None]
        told = [state, action, *self._remembered(frames, action, seen, context)]
        ahead, kept, frame = {}, [], []
        if "tokens" in frames:
            x, condition = self._embed(frames, told)
            x, kept = self.transformer(x, seen, past or None, condition)
            patches = x[..., : frames["tokens"].shape[-2], :]
            ahead["tokens"] = frames["tokens"] + torch.cat([decoder(patches) for decoder in self.decoders], -1)
            if not self.memory_dim:
                frame, told = [x[..., -1, :]], [*told, x.mean(-2)]
        # Of a first frame nothing was known before; what the empty latent led to must not say otherwise.
        ahead["context"] = told[-1] * known
        if not self.config.frame_token:
            return _Ahead({**ahead, "state": state + self.state_decoder(torch.cat(told, -1))}, kept)
        told = [state, told[-1]] if self.memory_dim else [*frame, *told]
        change = self.frame_decoder(torch.cat([frames["vector"], *told], -1))
        vector, moved = change.split([frames["vector"].shape[-1], state.shape[-1]], -1)
        return _Ahead({**ahead, "vector": frames["vector"] + vector, "state": state + moved}, kept)

    def _remembered(
        self, frames: dict[str, Tensor], action: Tensor, seen: Tensor, memory: Tensor | None
    ) -> list[Tensor]:
        """The memory (B, T, M) after each of T frames, from that before them (B, M); nothing without a memory."""
        if not self.memory_dim:
            return []
        told = self.memory_in(torch.cat([frames["vector"], frames["state"], action], -1))
        memory, rows = told.new_zeros(len(told), self.memory_dim) if memory is None else memory, []
        for t in range(told.shape[1]):
            memory = self.memory(told[:, t], memory * (seen[:, t] > 1)[:, None])  # a first frame remembers nothing
            rows.append(memory)
        return [torch.stack(rows, 1)]

    def _embed(self, frames: dict[str, Tensor], told: list[Tensor]) -> tuple[Tensor, Tensor | None]:
        """The transformer's input (B, T, P, d), and with AdaLN the condition (B, T, d) of its layers.

        Args:
            told: state (B, T, S), action (B, T, A) and perhaps the memory.
        """
        x = self.token_in(frames["tokens"])
        if self.config.frame_token:
            x = torch.cat([x, self.frame_in(frames["vector"]).unsqueeze(-2)], -2)
        if self.config.conditioning == "adaln":
            return x + self.position, self.condition_in(torch.cat(told, -1))
        both = torch.cat([self.state_in(told[0]), self.action_in(told[1])], -1).unsqueeze(-2)
        return torch.cat([x, both.expand(*x.shape[:-1], -1)], -1) + self.position, None

    def _next_latent(self, ahead: _Ahead, t: int, seen: Tensor, action: Tensor) -> Latent:
        """The latent after frame t, of which `seen` (B,) frames were known, under `action` (B, A)."""
        history = self.config.history
        return {
            **{name: values[:, t] for name, values in ahead.frames.items()},
            "seen": (seen + 1).clamp(max=history),
            "action": action,
            **{name: kept[:, t + 1 : t + history] for name, kept in zip(self.past_names, ahead.kept)},
        }

    # -- learning ---

    def loss(self, clip: Clip) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Errors one step ahead of frames that were seen (teacher forcing), and of the rest imagined open loop.

        The features are those of latents seen and, from where imagination took over, of latents imagined. Episodes
        begin at the first frame of a clip, if anywhere in it.
        """
        n_clips, length = clip.state.shape[:2]
        last = self._last_observed(clip) if self.config.open_loop > 0 else length - 2
        shown = math.ceil(self._token_share * n_clips)
        parts = [(slice(0, shown), self.seen_names)]
        if shown < n_clips:
            parts.append((slice(shown, n_clips), [name for name in self.seen_names if name != "tokens"]))
        done = [self._part_loss(clip.rows(part), names, last) for part, names in parts]
        loss = sum(
            ((part.stop - part.start) / n_clips * error for (part, _), (error, _, _) in zip(parts, done)),
            clip.state.new_zeros(()),
        )
        features = torch.cat([each for _, each, _ in done])
        return loss + self.end_loss(features, clip), features, done[0][2]

    @property
    def _token_share(self) -> float:
        """Without a memory, what follows a frame is not known without its patches."""
        return self.config.token_share if self.memory_dim else 1.0

    def _part_loss(self, clip: Clip, names: list[str], last: int) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Loss, features and metrics of clips of which `names` are predicted, and which are seen up to frame `last`."""
        percepts = {name: values for name, values in clip.percepts.items() if name != "tokens" or name in names}
        frames = {**self._looked_at(percepts), "state": clip.state}
        seen, length = self._frames_seen(clip.is_first), clip.state.shape[1]
        goes_on = clip.valid[:, 1:] & clip.valid[:, :-1] & ~clip.is_first[:, 1:]
        known = slice(0, last + 1)
        ahead = self._advance({k: v[:, known] for k, v in frames.items()}, clip.action[:, 1 : last + 2], seen[:, known])
        unit = self._unit_of_change(frames, goes_on)
        begun = {name: value[:, : last + 2] for name, value in frames.items()}
        losses = self._errors(ahead.frames, begun, goes_on[:, known], slice(0, -1), unit)
        metrics = {f"loss_{name}": value.detach() for name, value in losses.items()}
        loss = (last + 1) / (length - 1) * torch.stack(list(losses.values())).sum()
        context = F.pad(ahead.frames["context"], (0, 0, 1, 0)) * (seen[:, : last + 2] > 1)[..., None]
        if self.config.open_loop > 0:
            imagined = self._imagine(ahead, clip, seen, last)
            alive = goes_on[:, last:].cumprod(1).bool()
            losses = self._errors(imagined, frames, alive, slice(last, last + 1), unit)
            metrics |= {f"loss_{name}_open_loop": value.detach() for name, value in losses.items()}
            loss = loss + self.config.open_loop * torch.stack(list(losses.values())).sum()
            for name, truth in frames.items():
                ahead_of_last = torch.where(_like(alive, truth), imagined[name], truth[:, last + 1 :])
                frames[name] = torch.cat([truth[:, known], ahead_of_last], 1)
            context = torch.cat([context[:, known], imagined["context"]], 1)
        return loss, self.features({**frames, "context": context}), metrics

    def _frames_seen(self, is_first: Tensor) -> Tensor:
        """How many frames each may look at, itself included, at most H: (B, T)."""
        index = torch.arange(is_first.shape[1], device=is_first.device).expand(is_first.shape)
        start = torch.where(is_first, index, 0).cummax(1).values
        return (index - start + 1).clamp(max=self.config.history)

    def _last_observed(self, clip: Clip) -> int:
        """Index of the last frame seen before imagination takes over; random in training."""
        most = min(self.config.observed, clip.state.shape[1] - 1)
        if not self.training:
            return most - 1
        device = clip.state.device if world_size() > 1 else "cpu"  # alone it need not wait for a GPU
        return int(from_first_rank(torch.randint(most, (), device=device)))

    def _imagine(self, ahead: _Ahead, clip: Clip, seen: Tensor, last: int) -> Latent:
        """Frames (B, N, ...) after `last`; the first of them is what teacher forcing has predicted."""
        rows = [self._next_latent(ahead, last, seen[:, last], clip.action[:, last + 1])]
        for t in range(last + 2, clip.state.shape[1]):
            rows.append(self.step(rows[-1], clip.action[:, t]))
        return {name: torch.stack([row[name] for row in rows], 1) for name in ahead.frames}

    def _by_camera(self, tokens: Tensor) -> Tensor:
        """Mean squares of differences (..., P, C) of tokens: (..., P, cameras)."""
        return tokens.square().unflatten(-1, (len(self.image_keys), -1)).mean(-1)

    def _unit_of_change(self, frames: dict[str, Tensor], goes_on: Tensor) -> dict[str, Tensor]:
        """Mean squared change from one frame to the next, of each camera's tokens (cameras,), of the rest ()."""
        change = {name: torch.diff(value, dim=1) for name, value in frames.items()}
        change = {
            name: self._by_camera(value).mean(-2) if name == "tokens" else _mean_square(value)
            for name, value in change.items()
        }
        return {name: mean_over_ranks(_mean(value, goes_on)).clamp(min=1e-6) for name, value in change.items()}

    def _errors(
        self, predicted: dict[str, Tensor], frames: dict[str, Tensor], counts: Tensor, since: slice,
        unit: dict[str, Tensor],
    ) -> dict[str, Tensor]:  # fmt: skip
        """Mean squared errors of the last N frames of a clip, in units of the change from one frame to the next.

        Args:
            predicted: tokens (B, N, P, C), state (B, N, S) and perhaps vector (B, N, F).
            frames: the clip's.
            counts: bool (B, N), whether a frame is compared.
            since: the frames, N or one, since which a token's change makes it weigh.
        """
        config, n = self.config, predicted["state"].shape[1]
        truth = {name: value[:, -n:] for name, value in frames.items()}
        errors = {"state": _mean(_mean_square(predicted["state"] - truth["state"]), counts) / unit["state"]}
        if config.blind:
            return errors
        if "tokens" in frames:
            error = self._by_camera(predicted["tokens"] - truth["tokens"])
            if config.change_weight > 0:
                error = error * self._weight(self._by_camera(truth["tokens"] - frames["tokens"][:, since]), counts)
            errors["tokens"] = config.token_weight * (_mean(error.mean(-2), counts) / unit["tokens"]).mean()
        if config.frame_token:
            error = _mean_square(predicted["vector"] - truth["vector"])
            errors["frame"] = config.frame_weight * _mean(error, counts) / unit["vector"]
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


def _merged_grid(n_patches: int, m: int) -> tuple[int, int]:
    """Rows and columns of a square grid of patches when m x m of them are one token.

    Raises:
        ValueError: the grid is no square, or does not fall into such squares.
    """
    side = math.isqrt(n_patches)
    if m == 1:
        return n_patches, 1
    if side * side != n_patches or side % m:
        raise ValueError(
            f"merge_patches is {m}, and the encoder makes {n_patches} patches a camera: {m} x {m} of them do not fill "
            "the grid. Give an image_size whose patches a side are a multiple, or merge_patches=1"
        )
    return side // m, side // m
