"""PrivilegedSafe: the same learner on the true state, dynamics and margin of the car (Table 1's other row)."""

import math

import torch
from torch import Tensor

from lerobot_latentsafe.critic import ReachabilityConfig, SafetyCritic
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.latent import Latent
from lerobot_latentsafe.reachability import LatentReachability


class DubinsImagination:
    """The car itself behind the `Imagination` protocol; a latent is {"state": (B, 3)}."""

    sampled = False

    def __init__(self, half_width: float = car.VIEW):
        self.half_width = half_width

    def step(self, latent: Latent, action: Tensor) -> Latent:
        """One Euler step under actions (B, 1) in [-1, 1]."""
        x, y, heading = latent["state"].unbind(-1)
        return {
            "state": torch.stack(
                [
                    x + car.DT * car.SPEED * torch.cos(heading),
                    y + car.DT * car.SPEED * torch.sin(heading),
                    heading + car.DT * car.MAX_TURN_RATE * action[:, 0],
                ],
                -1,
            )
        }

    def follow(self, latent: Latent, actions: Tensor) -> Latent:
        """The same: a step has one tick."""
        return self.step(latent, actions)

    def features(self, latent: Latent) -> Tensor:
        """Position, and the heading's cosine and sine: (B, 4)."""
        x, y, heading = latent["state"].unbind(-1)
        return torch.stack([x, y, torch.cos(heading), torch.sin(heading)], -1)

    def margin(self, latent: Latent) -> Tensor:
        """l(s) in m^2: (B,)."""
        return latent["state"][..., :2].square().sum(-1) - car.RADIUS**2

    def judged(self, latent: Latent) -> tuple[Tensor, Tensor]:
        """Features (B, 4) and margin (B,)."""
        return self.features(latent), self.margin(latent)

    def ended(self, latent: Latent) -> Tensor:
        """Whether the car has left the view: bool (B,)."""
        return latent["state"][..., :2].abs().amax(-1) > self.half_width

    def complete(self, latent: Latent, action: Tensor) -> Tensor:
        """The action: the car has no frozen commands."""
        return action


def train_privileged(config: ReachabilityConfig, seed: int, on_step=None) -> tuple[DubinsImagination, SafetyCritic]:
    """Learn the safety value on true states (x, y, heading), uniform starts in the view."""
    torch.manual_seed(seed)
    imagination = DubinsImagination()
    scale = torch.tensor([car.VIEW, car.VIEW, math.pi])
    candidates = torch.tensor([[-1.0], [0.0], [1.0]])
    critic = SafetyCritic(4, 1, candidates, config)
    learner = LatentReachability(imagination, critic, lambda n: {"state": (2 * torch.rand(n, 3) - 1) * scale}, config)
    for _ in range(config.steps):
        metrics = learner.update()
        if on_step is not None:
            on_step(learner.step_count, metrics, critic)
    return imagination, critic
