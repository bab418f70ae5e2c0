"""The failure margin l: a classifier on latent features whose zero-sublevel set is the failure set (Eq. 3)."""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lerobot_latentsafe.latent import ABSURD
from lerobot_latentsafe.runtime.distributed import mean_over_ranks


@dataclass
class MarginConfig:
    """The failure margin and its training.

    Attributes:
        hidden, layers: its MLP (2 layers of 16 in the paper).
        delta: delta of Eq. 3.
        weight: weight of Eq. 3 in the training loss; 0 leaves the margin to `latentsafe train-margin`.
        clips: windows of the data that `latentsafe train-margin` fits the margin to.
        noise: of the features meanwhile, in standard deviations: the more of them, the more.
        gradient_penalty: weight of the squared gradient of l between failing and safe features, by which
            `latentsafe train-margin` makes l rise gradually from one to the other.
        failure_specification: name of the failure labels: a dataset column or a sidecar file.
    """

    hidden: int = 16
    layers: int = 2
    delta: float = 0.75
    weight: float = 10.0
    clips: int = 10_000
    noise: float = 0.5
    gradient_penalty: float = 0.0
    failure_specification: str = "failure"

    def __post_init__(self) -> None:
        if self.delta <= 0:
            raise ValueError(f"--policy.margin.delta is {self.delta}; expected a positive number")
        if not 0 <= self.noise < math.inf:
            raise ValueError(f"--policy.margin.noise is {self.noise}; expected standard deviations, 0 or more")
        if not 0 <= self.gradient_penalty < math.inf:
            raise ValueError(
                f"--policy.margin.gradient_penalty is {self.gradient_penalty}; expected a weight, 0 or more"
            )


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
        """l of features (..., D): (...,), not bounded."""
        return self.net(features).squeeze(-1)

    def bounded(self, features: Tensor) -> Tensor:
        """tanh l of features (..., D): (...,) in (-1, 1); NaN where l is absurd, which tanh would hide."""
        margin = self(features)
        return torch.tanh(torch.where(margin.abs() <= ABSURD, margin, torch.nan))


def hinge_loss(margin: Tensor, failure: Tensor, delta: float = 0.75) -> Tensor:
    """Eq. 3: mean ReLU(delta - l) over safe frames plus mean ReLU(delta + l) over failing frames.

    Args:
        margin: l, any shape.
        failure: same shape; 1 failing, 0 safe, -1 unlabelled (ignored).
        delta: the margin each class is pushed beyond.
    """
    safe, failing = failure == 0, failure == 1
    n_safe, n_failing = mean_over_ranks(torch.stack([safe.sum(), failing.sum()])).clamp(min=1e-6)
    return (F.relu(delta - margin) * safe).sum() / n_safe + (F.relu(delta + margin) * failing).sum() / n_failing


def slope_between(margin: FailureMargin, features: Tensor, failure: Tensor, generator: torch.Generator) -> Tensor:
    """Mean squared gradient of l at random places between failing and safe features; 0 where there is but one kind.

    The gradient penalty of Gulrajani et al. (2017), without their wish that it be 1: the hinge loss says how far apart
    both ends are.

    Args:
        features: (N, D).
        failure: (N,), 1 of those that fail, 0 of safe ones.
    """
    failing, safe = features[failure == 1], features[failure == 0]
    if not len(failing) or not len(safe):
        return features.new_zeros(())
    share = torch.rand(len(safe), 1, generator=generator).to(features.device)
    other = failing[torch.randint(len(failing), (len(safe),), generator=generator).to(features.device)]
    between = torch.lerp(other, safe, share).detach().requires_grad_()
    (slope,) = torch.autograd.grad(margin(between).sum(), between, create_graph=True)
    return slope.square().sum(-1).mean()
