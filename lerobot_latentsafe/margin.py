"""The failure margin l: a classifier on latent features whose zero-sublevel set is the failure set (Eq. 3)."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class FailureMargin(nn.Module):
    """l(z): features (..., D) -> (...,). Negative means failure.

    The hinge loss pushes l to +-delta, so l measures certainty, not distance; `bounded` squashes it by tanh
    into (-1, 1), the bounded margin that the Bellman backup needs.
    """

    def __init__(self, feature_dim: int, hidden: int = 16, n_layers: int = 2):
        super().__init__()
        layers: list[nn.Module] = []
        for i in range(n_layers):
            layers += [nn.Linear(feature_dim if i == 0 else hidden, hidden), nn.SiLU()]
        self.net = nn.Sequential(*layers, nn.Linear(hidden, 1))

    def forward(self, features: Tensor) -> Tensor:
        return self.net(features).squeeze(-1)

    def bounded(self, features: Tensor) -> Tensor:
        return torch.tanh(self(features))


def hinge_loss(margin: Tensor, failure: Tensor, delta: float = 0.75) -> Tensor:
    """Eq. 3: mean ReLU(delta - l) over safe frames plus mean ReLU(delta + l) over failing frames.

    Args:
        margin: l, any shape.
        failure: same shape; 1 failing, 0 safe, -1 unlabelled (ignored).
        delta: the margin each class is pushed beyond.
    """
    loss = margin.sum() * 0.0  # keeps the graph when a batch holds neither class
    for is_class, signed in ((failure == 0, margin), (failure == 1, -margin)):
        if is_class.any():
            loss = loss + F.relu(delta - signed[is_class]).mean()
    return loss
