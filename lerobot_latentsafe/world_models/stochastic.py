"""What the stochastic part x of an RSSM can be: Gaussians (Hafner et al., 2019) or categoricals (DreamerV3).

A network's raw output (..., n_raw) is read into statistics, a tuple of tensors, which all else is a function of: in
single precision, also where the network computes in 16 bits.
"""

import torch
from torch import Tensor

from lerobot_latentsafe.runtime.distributed import rand_like, randn_like

Statistics = tuple[Tensor, ...]


class Gaussian:
    """`size` independent Gaussians; statistics: mean and standard deviation (..., size)."""

    def __init__(self, size: int, min_std: float):
        self.dim, self.n_raw, self.min_std = size, 2 * size, min_std

    def read(self, raw: Tensor) -> Statistics:
        """Raw output (..., n_raw) -> statistics."""
        mean, std = raw.float().chunk(2, -1)
        return mean, 2 * torch.sigmoid(std / 2) + self.min_std

    def centre(self, statistics: Statistics) -> Tensor:
        """The mean: x (..., dim)."""
        return statistics[0]

    def sample(self, statistics: Statistics) -> Tensor:
        """One draw: x (..., dim)."""
        mean, std = statistics
        return mean + std * randn_like(std)

    def kl(self, of: Statistics, to: Statistics) -> Tensor:
        """KL(of || to), summed over the Gaussians: (...,)."""
        (mean1, std1), (mean2, std2) = of, to
        return (torch.log(std2 / std1) + (std1**2 + (mean1 - mean2) ** 2) / (2 * std2**2) - 0.5).sum(-1)


class Categorical:
    """`size` independent variables of `classes` classes each, x their one-hot vectors in a row.

    Statistics: probabilities (..., size, classes). A share `unimix` of them is uniform, as in DreamerV3, so that no
    class is ever impossible and the KL stays finite. Gradients of a sample go straight through to its probabilities.
    """

    def __init__(self, size: int, classes: int, unimix: float):
        self.size, self.classes, self.unimix = size, classes, unimix
        self.dim = self.n_raw = size * classes

    def read(self, raw: Tensor) -> Statistics:
        """Raw output (..., n_raw) -> statistics."""
        probabilities = raw.float().unflatten(-1, (self.size, self.classes)).softmax(-1)
        return ((1 - self.unimix) * probabilities + self.unimix / self.classes,)

    def centre(self, statistics: Statistics) -> Tensor:
        """The likeliest class of each variable: x (..., dim)."""
        (probabilities,) = statistics
        return self._one_hot(probabilities.argmax(-1))

    def sample(self, statistics: Statistics) -> Tensor:
        """One draw: x (..., dim)."""
        (probabilities,) = statistics
        below = probabilities.cumsum(-1) < rand_like(probabilities[..., :1])
        drawn = self._one_hot(below.sum(-1).clamp(max=self.classes - 1))
        return drawn + (probabilities - probabilities.detach()).flatten(-2)

    def kl(self, of: Statistics, to: Statistics) -> Tensor:
        """KL(of || to), summed over the variables: (...,)."""
        return (of[0] * (of[0].log() - to[0].log())).sum((-2, -1))

    def _one_hot(self, classes: Tensor) -> Tensor:
        return (classes[..., None] == torch.arange(self.classes, device=classes.device)).float().flatten(-2)
