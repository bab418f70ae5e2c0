"""Where something in the data ends episodes, imagination must notice that it has come there."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lerobot_latentsafe.datasets.clips import Clip
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.runtime.distributed import mean_over_ranks
from lerobot_latentsafe.world_models.base import WorldModel


class TerminationHead(WorldModel):
    """A world model with a head `continues`, features (..., D) -> (..., 1): the logit of the episode going on."""

    continues: nn.Module
    ends_seen: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("ends_seen", torch.zeros(()))

    def ended(self, latent: Latent) -> Tensor:
        """Whether the head says that the episode is over: bool (...,)."""
        # A head that never saw an end knows nothing. A GPU is not asked beforehand: that would wait for it.
        if self.ends_seen.device.type == "cpu" and not self.ends_seen:
            return torch.zeros(latent["action"].shape[:-1], dtype=torch.bool)
        over = self.continues(self.features(latent)).squeeze(-1) < 0
        return over & (self.ends_seen > 0)

    def end_loss(self, features: Tensor, clip: Clip) -> Tensor:
        """Cross-entropy of the head, which teaches the features nothing."""
        known = (clip.terminal >= 0) & clip.valid
        if self.training:
            self.ends_seen += mean_over_ranks(((clip.terminal == 1) & known).any()) > 0
        logits, goes_on = self.continues(features.detach()).squeeze(-1), (clip.terminal == 0).float()
        error = F.binary_cross_entropy_with_logits(logits, goes_on, known.float(), reduction="sum")
        return error / mean_over_ranks(known.sum()).clamp(min=1e-6)
