"""What is learned of a frame's patches."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class PatchSummary(nn.Module):
    """What is learned of a frame's patches, its mean and maximum over them: tokens (..., P, C) -> (..., 2 width).

    What is small, a candy on a table, is all there is to see in its patch and nothing to components of whole frames.
    """

    def __init__(self, n_patches: int, token_dim: int, width: int):
        super().__init__()
        self.enter, self.leave = nn.Linear(token_dim, width), nn.Linear(width, width)
        self.position = nn.Parameter(torch.randn(n_patches, width))
        self.norm = nn.LayerNorm(2 * width)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens (..., P, C) -> mean and maximum over patches (..., 2 width)."""
        patches = self.leave(F.gelu(self.enter(tokens) + self.position))
        return self.norm(torch.cat([patches.mean(-2), patches.amax(-2)], -1))
