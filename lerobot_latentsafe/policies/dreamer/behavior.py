"""Learning to act in imagination (DreamerV3): heads, returns, and the actor-critic's losses.

Imagined latents z_0 .. z_H follow actions a_0 .. a_{H-1} of the actor; the reward r_t is that of arriving in z_t.
"""

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.world_models.base import WorldModel
from lerobot_latentsafe.world_models.rssm import mlp

TERMS = ("reach", "lifted", "failure", "joint_speed", "action_rate")
"""What the reward of a frame is made of: the scene's truth, and the squared change of the action that led there."""


@dataclass
class RewardWeights:
    """The paper's dense reward: r = reach + lift - topple - joint speed - action rate, each times its weight.

    Attributes:
        reach: of 1 - tanh(distance / 0.1 m) between fingers and block.
        lift: of the block being lifted.
        topple: cost of each step in which a red block lies.
        joint_speed: cost of the sum of squared joint velocities, rad^2/s^2.
        action_rate: cost of the squared change between actions in [-1, 1].
    """

    reach: float = 1.0
    lift: float = 20.0
    topple: float = 10.0
    joint_speed: float = 1e-3
    action_rate: float = 1e-2

    def reward(self, terms: Tensor) -> Tensor:
        """Terms (..., 5) in the order of `TERMS` -> (...,)."""
        weights = (self.reach, self.lift, -self.topple, -self.joint_speed, -self.action_rate)
        return terms @ terms.new_tensor(weights)


@dataclass
class BehaviorConfig:
    """Sizes and learning of the task policy.

    Attributes:
        hidden, layers: of actor, critic and reward head.
        bins, limit: the heads' outcomes, evenly in symlog space from -limit to limit.
        min_std, max_std: bounds of the actor's spread, actions being in [-1, 1].
        horizon: imagined steps.
        starts: latents of a batch from which imagination starts, at most.
        gamma, trace: discount, and the lambda of the returns.
        entropy: weight of the actor's entropy.
        cloning: weight of imitating the demonstrations in a batch, at all times.
        return_rate: how fast the range of returns is tracked.
        slow_rate: how fast the slow critic, which returns are bootstrapped from, follows.
        model_lr, actor_lr, critic_lr: Adam step sizes.
        rewards: weights of the reward's terms.
    """

    hidden: int = 256
    layers: int = 2
    bins: int = 65
    limit: float = 8.0
    min_std: float = 0.1
    max_std: float = 1.0
    horizon: int = 15
    starts: int = 128
    gamma: float = 0.97
    trace: float = 0.95
    entropy: float = 3e-4
    cloning: float = 0.1
    return_rate: float = 0.01
    slow_rate: float = 0.02
    model_lr: float = 6e-4
    actor_lr: float = 3e-4
    critic_lr: float = 3e-4
    rewards: RewardWeights = field(default_factory=RewardWeights)


def symlog(x: Tensor) -> Tensor:
    """sign(x) log(1 + |x|), which leaves small numbers as they are and squeezes large ones."""
    return x.sign() * x.abs().log1p()


def symexp(x: Tensor) -> Tensor:
    """The inverse of `symlog`."""
    return x.sign() * x.abs().expm1()


def two_hot(x: Tensor, bins: Tensor) -> Tensor:
    """x (...,) as weights of its two nearest evenly spaced bins (K,), whose mean it is: (..., K)."""
    distance = (x.clamp(bins[0], bins[-1])[..., None] - bins).abs() / (bins[1] - bins[0])
    return (1 - distance).clamp(min=0)


class TwoHotHead(nn.Module):
    """A number as a distribution over bins in symlog space: features (..., D) -> its mean (...,)."""

    bins: Tensor

    def __init__(self, feature_dim: int, config: BehaviorConfig):
        super().__init__()
        last = nn.Linear(config.hidden, config.bins)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.net = nn.Sequential(mlp(feature_dim, config.hidden, config.layers), last)
        self.register_buffer("bins", torch.linspace(-config.limit, config.limit, config.bins), persistent=False)

    def forward(self, features: Tensor) -> Tensor:
        """The mean of features (..., D): (...,)."""
        return symexp(self.net(features).softmax(-1) @ self.bins)

    def loss(self, features: Tensor, target: Tensor) -> Tensor:
        """Cross-entropy with the two-hot target: (...,)."""
        return -(two_hot(symlog(target), self.bins) * self.net(features).log_softmax(-1)).sum(-1)


class Actor(nn.Module):
    """pi(a | z): an independent Gaussian for each command, its mean in [-1, 1].

    Args:
        varies: bool (A,), the commands it moves; the others stay at 0.
    """

    varies: Tensor

    def __init__(self, feature_dim: int, varies: Tensor, config: BehaviorConfig):
        super().__init__()
        self.register_buffer("varies", varies, persistent=False)
        self.min_std, self.max_std = config.min_std, config.max_std
        last = nn.Linear(config.hidden, 2 * len(varies))
        with torch.no_grad():
            last.weight.mul_(0.1)
        self.net = nn.Sequential(mlp(feature_dim, config.hidden, config.layers), last)

    def distribution(self, features: Tensor) -> torch.distributions.Normal:
        """Of actions, given features (..., D)."""
        mean, std = self.net(features).chunk(2, -1)
        std = self.min_std + (self.max_std - self.min_std) * torch.sigmoid(std - 2)
        return torch.distributions.Normal(torch.tanh(mean), std, validate_args=False)  # checks wait for the GPU

    def mode(self, features: Tensor) -> Tensor:
        """Features (..., D) -> actions (..., A)."""
        return self.distribution(features).mean * self.varies

    def sample(self, features: Tensor) -> Tensor:
        """Features (..., D) -> actions (..., A), to be clipped into [-1, 1] by whoever executes them."""
        spread = self.distribution(features)
        return (spread.mean + spread.stddev * torch.randn_like(spread.mean)) * self.varies

    def log_prob(self, features: Tensor, action: Tensor) -> Tensor:
        """Log density of actions (..., A): (...,)."""
        return (self.distribution(features).log_prob(action) * self.varies).sum(-1)

    def entropy(self, features: Tensor) -> Tensor:
        """Of the actions given features (..., D): (...,)."""
        return (self.distribution(features).entropy() * self.varies).sum(-1)


@torch.no_grad()
def imagine(world_model: WorldModel, actor: Actor, start: Latent, horizon: int) -> tuple[Tensor, Tensor]:
    """Follow the actor from N latents: features (H + 1, N, D) and actions (H, N, A) before clipping."""
    latent, features, actions = start, [world_model.features(start)], []
    for _ in range(horizon):
        actions.append(actor.sample(features[-1]))
        latent = world_model.sample_step(latent, actions[-1].clamp(-1, 1))
        features.append(world_model.features(latent))
    return torch.stack(features), torch.stack(actions)


def lambda_returns(reward: Tensor, value: Tensor, gamma: float, trace: float) -> Tensor:
    """R_t = r_{t+1} + gamma ((1 - lambda) v_{t+1} + lambda R_{t+1}) with R_H = v_H.

    Args:
        reward: r_1 .. r_H, (H, N).
        value: v_1 .. v_H, (H, N).

    Returns:
        R_0 .. R_{H-1}, (H, N).
    """
    later, returns = value[-1], []
    for r, v in zip(reward.flip(0), value.flip(0)):
        later = r + gamma * ((1 - trace) * v + trace * later)
        returns.append(later)
    return torch.stack(returns[::-1])


class ReturnRange(nn.Module):
    """Tracks the range from the 5th to the 95th percentile of returns; advantages are divided by it if it exceeds 1."""

    range: Tensor

    def __init__(self, rate: float):
        super().__init__()
        self.rate = rate
        self.register_buffer("range", torch.zeros(()))

    @torch.no_grad()
    def update(self, returns: Tensor) -> Tensor:
        """Returns of any shape -> the divisor ()."""
        ordered = returns.flatten().sort().values
        low, high = (ordered[round(share * (len(ordered) - 1))] for share in (0.05, 0.95))
        self.range.lerp_(high - low, self.rate)
        return self.range.clamp(min=1)
