"""A recurrent world model of whole frames: a GRU on the principal components of a frozen encoder's tokens.

z_t = (h_t, v_t, s_t): h_t remembers what was done and seen, v_t are the leading principal components of all the frame's
tokens, s_t is proprioception. v and s are predicted as changes. A frame is one vector here, not a grid of tokens as in
DINO-WM, which makes imagination cheap. With a `summary`, v_t also tells what is small, which components of whole frames
do not show; what that is the margin teaches, for the frames that are observed.

Trained open loop: a few frames are observed, the rest of the clip is imagined under the recorded actions. One-step
losses teach a model to copy the last frame and to ignore the action (see `evaluation/world_model.py`).
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor, nn

from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.datasets.frame_cache import basis_file
from lerobot_latentsafe.encoders.perception import Perception, PerceptionConfig
from lerobot_latentsafe.latent import Latent, replace_rows
from lerobot_latentsafe.runtime.distributed import mean_over_ranks
from lerobot_latentsafe.world_models.base import WorldModel, WorldModelConfig
from lerobot_latentsafe.world_models.patch_summary import PatchSummary


@WorldModelConfig.register_subclass("gru")
@dataclass
class GRUConfig(WorldModelConfig):
    """Sizes for two cores.

    Attributes:
        perception: the frozen encoder, and how many principal components of its tokens make a frame's vector.
        summary: width of the learned patch features whose mean and maximum over patches v ends with; 0: none.
        hidden, units: sizes of h and of the layers around it.
        observed: frames of a clip that are seen before imagination starts, at most.
        blind: see no images, only proprioception: the control that a model which looks must beat.
    """

    perception: PerceptionConfig = field(default_factory=PerceptionConfig)
    image_size: int = 96
    clip_length: int = 20
    summary: int = 0
    hidden: int = 256
    units: int = 256
    observed: int = 6
    blind: bool = False

    def of_cache(self, manifest: dict) -> "GRUConfig":
        """With the encoder and the components of a token cache; see the base class."""
        return replace(self, perception=self.perception.of_cache(manifest))

    def build(self, image_keys: list[str], state_dim: int, action_dim: int) -> "FrameGRU":
        """A GRU with fresh weights."""
        return FrameGRU(self, image_keys, state_dim, action_dim)


class FrameGRU(WorldModel):
    """See the module's text. Latent: hidden (B, H), vector (B, C), state (B, S), action (B, A)."""

    config: GRUConfig

    def __init__(self, config: GRUConfig, image_keys: list[str], state_dim: int, action_dim: int):
        super().__init__()
        if not image_keys:
            raise ValueError(
                "a gru world model needs at least one camera, got none; record observation.image* features"
            )
        self.image_keys, self.action_dim = sorted(image_keys), action_dim
        self.perception = Perception(config.perception, self.image_keys, config.image_size)
        self.config = replace(config, perception=self.perception.config)
        n_vector, units = config.perception.components, config.units
        if config.summary:
            self.summary = PatchSummary(self.perception.n_patches, self.perception.token_dim, config.summary)
            n_vector += 2 * config.summary
        self.sizes = {"hidden": config.hidden, "vector": n_vector, "state": state_dim, "action": action_dim}
        self.feature_dim = config.hidden + n_vector + state_dim
        self.frame_in = nn.Sequential(nn.Linear(n_vector + state_dim, units), nn.SiLU())
        self.action_in = nn.Sequential(nn.Linear(action_dim, units // 4), nn.SiLU())
        self.cell = nn.GRUCell(units + units // 4, config.hidden)
        first = nn.Linear(config.hidden + n_vector + state_dim, units)
        last = nn.Linear(units, n_vector + state_dim)
        self.change = nn.Sequential(first, nn.SiLU(), last)
        with torch.no_grad():  # start from the best guess without learning: nothing changes
            last.weight.mul_(0.1)
            last.bias.zero_()

    def frozen_perception(self) -> Perception:
        """The encoder and the components of its tokens."""
        return self.perception

    @property
    def percept_names(self) -> list[str]:
        """Components of the frame, and its tokens if a summary is learned."""
        return ["vector", "tokens"] if self.config.summary else ["vector"]

    def load_basis(self, root: Path) -> None:
        """Principal components from a dataset's token cache."""
        self.perception.load_basis(basis_file(root))

    def perceive(self, images: dict[str, Tensor]) -> dict[str, Tensor]:
        """Camera key -> (B, 3, S, S) to vector (B, C), and tokens (B, P, D) with a summary."""
        return self.perception(images, self.percept_names)

    def initial(self, batch_size: int) -> Latent:
        """Zeros: (B, ...)."""
        weight = self.cell.weight_hh
        return {name: weight.new_zeros(batch_size, size) for name, size in self.sizes.items()}

    def step(self, latent: Latent, action: Tensor) -> Latent:
        """Next latent under actions (B, A): one GRU step, then the change of frame and state."""
        frame = torch.cat([latent["vector"], latent["state"]], -1)
        hidden = self.cell(torch.cat([self.frame_in(frame), self.action_in(action)], -1), latent["hidden"])
        frame = frame + self.change(torch.cat([hidden, frame], -1))
        vector, state = frame.split([self.sizes["vector"], self.sizes["state"]], -1)
        return {"hidden": hidden, "vector": vector, "state": state, "action": action}

    def correct(self, predicted: Latent, percepts: dict[str, Tensor], state: Tensor) -> Latent:
        """The frame and state that were seen in place of those predicted."""
        return {**predicted, "vector": self._vector(percepts), "state": state}

    def _vector(self, percepts: dict[str, Tensor]) -> Tensor:
        """v of frames (..., C)."""
        vector = percepts["vector"]
        if self.config.summary:
            vector = torch.cat([vector, self.summary(percepts["tokens"])], -1)
        return torch.zeros_like(vector) if self.config.blind else vector

    def features(self, latent: Latent) -> Tensor:
        """hidden, vector and state side by side: (..., D)."""
        return torch.cat([latent["hidden"], latent["vector"], latent["state"]], -1)

    def tokens_of(self, latent: Latent) -> Tensor | None:
        """The components lifted to the tokens (B, P, C) that they stand for; None if it is blind."""
        if self.config.blind:
            return None
        components = latent["vector"][..., : self.config.perception.components]
        return self.perception.basis.lift(components).unflatten(-1, (self.perception.n_patches, -1))

    def from_cache(self, cached: dict[str, Tensor]) -> dict[str, Tensor]:
        """With whole tokens, if a summary is learned of them, cut down to the components that are read."""
        cut = {"tokens": self.perception.cut_down(cached["tokens"])} if "tokens" in cached else {}
        return {**cached, **cut}

    def ended(self, latent: Latent) -> Tensor:
        """Never: recordings do not end by themselves."""
        return torch.zeros(latent["hidden"].shape[:-1], dtype=torch.bool, device=latent["hidden"].device)

    def error(self, latent: Latent, percepts: dict[str, Tensor], state: Tensor) -> Tensor:
        """Squared distance of frame and state from what was seen, summed: (B,)."""
        seen = self.correct(latent, percepts, state)
        vector, state = ((latent[name] - seen[name]).square().sum(-1) for name in ("vector", "state"))
        return vector + state

    def loss(self, clip: Clip) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Squared errors of all predicted frames, in units of what changes from one frame to the next."""
        length = clip.state.shape[1]
        observed = int(torch.randint(1, self.config.observed + 1, ()))
        shown = self._vector({name: frames[:, :observed] for name, frames in clip.percepts.items()})
        with torch.no_grad():  # what is to be seen the margin alone teaches
            later = self._vector({name: frames[:, observed:] for name, frames in clip.percepts.items()})
        seen = {"vector": torch.cat([shown.detach(), later], 1), "state": clip.state}
        latent = start = self.initial(len(clip.state))
        predicted, rows = [], []
        for t in range(length):
            first = clip.is_first[:, t]
            latent = self.step(replace_rows(latent, start, where=first), clip.action[:, t])
            predicted.append(latent)
            corrected = {**latent, **{name: frames[:, t] for name, frames in seen.items()}}
            latent = corrected if t < observed else replace_rows(latent, corrected, where=first)
            rows.append(self.features({**latent, "vector": shown[:, t]} if t < observed else latent))
        counts = (clip.valid & ~clip.is_first)[..., None].float()
        counts[:, 1:] *= clip.valid[:, :-1, None]
        names = ("state",) if self.config.blind else ("vector", "state")
        changes = [torch.diff(seen[name], dim=1, prepend=seen[name][:, :1]).square() * counts for name in names]
        units = mean_over_ranks(torch.stack([change.sum() for change in changes])).clamp(min=1e-6)
        losses = {}
        for name, unit in zip(names, units):
            error = (torch.stack([z[name] for z in predicted], 1) - seen[name]).square() * counts
            losses[f"loss_{name}"] = error.sum() / unit
        metrics = {name: value.detach() for name, value in losses.items()}
        return sum(losses.values()), torch.stack(rows, 1), metrics
