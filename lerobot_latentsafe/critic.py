"""The safety critic Q(z, a), the fallback policy that climbs it, and the Bellman targets that it obeys (Eq. 4 and 5).

V(z) = min(l(z), max_a Q(z, a)), where Q(z, a) is the value *after* a: Q(z, a) = V(z') for z' = step(z, a).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import torch
from torch import Tensor, nn

from lerobot_latentsafe.constraints import SetNetwork
from lerobot_latentsafe.runtime.checkpoint import OldLayoutError


def safety_bellman_target(margin: Tensor, next_value: Tensor, gamma: float) -> Tensor:
    """Eq. 5, the time-discounted safety Bellman backup: (1 - gamma) l + gamma min(l, V').

    gamma = 0 gives the margin itself, gamma -> 1 the undiscounted minimum over time.
    """
    return (1 - gamma) * margin + gamma * torch.minimum(margin, next_value)


def risk_bellman_target(margin: Tensor, next_value: Tensor, gamma: float) -> Tensor:
    """SQRL's backup for V = -risk: -(c + (1 - c) gamma risk'), where c is 1 in failures (l < 0), else 0.

    The risk is the discounted probability of failing; a value above 0, such as infinity, says that none is ahead.
    """
    return torch.where(margin >= 0, gamma * next_value.clamp(-1, 0), -1.0)  # what is no number has failed


BACKUPS: dict[str, Callable[[Tensor, Tensor, float], Tensor]] = {
    "reachability": safety_bellman_target,
    "risk": risk_bellman_target,
}
"""What a critic can be trained for: (margin, next value, gamma) -> value, all but gamma of one shape."""


@dataclass
class FallbackConfig:
    """What the fallback policy may do. It belongs to the weights: the critic was trained for it.

    Attributes:
        action_candidates: the discrete action set in robot units, e.g. [[-1.25, 1], [0, 1], [1.25, 1]]; None:
            actions are continuous.
        frozen_commands: commands that the fallback never changes, such as `gripper.pos`: it moves, but keeps its grip.
        moves: the commands that a continuous fallback may move, such as `delta_z.pos`, or in one direction only, such
            as `-delta_z.pos`; None: all. Where the data seldom show a motion, the world model only guesses what it
            does, and the fallback would exploit that.
        low, high: the range of the fallback's continuous actions, in [-1, 1]: that which the data cover. Set by
            `latentsafe train-reachability`.
    """

    action_candidates: list[list[float]] | None = None
    frozen_commands: list[str] = field(default_factory=list)
    moves: list[str] | None = None
    low: list[float] | None = None
    high: list[float] | None = None

    @property
    def named_commands(self) -> list[str]:
        """All commands that are spoken of, without directions."""
        return [*self.frozen_commands, *(name[1:] if name[:1] in ("+", "-") else name for name in self.moves or [])]

    def bounds(self, names: list[str], movable: Tensor) -> tuple[Tensor, Tensor]:
        """Lowest and highest action (A,) in [-1, 1] of a continuous fallback.

        Args:
            names: of the commands.
            movable: bool (A,), commands that vary in the data and are not frozen.
        """
        ends = []
        for sign, end in (("-", self.low), ("+", self.high)):
            allowed = [self.moves is None or name in self.moves or sign + name in self.moves for name in names]
            bound = torch.tensor(end) if end else float(sign + "1") * torch.ones(len(names))
            ends.append((bound * torch.tensor(allowed)).to(movable.device) * movable)
        return ends[0], ends[1]


@dataclass
class ReachabilityConfig:
    """Sizes and schedule of the reachability actor-critic.

    Attributes:
        critic_hidden, actor_hidden: widths of the hidden layers.
        activation: `tanh` or `relu`.
        coverage: share of the data's actions left out at either end of the range that a continuous fallback may use:
            where actions are rare in the data, the world model only guesses.
        components: principal components of the features that actor and critic read.
        horizon: imagined steps before a start is drawn anew (at most 25 in the paper).
        learned_steps: the first steps of these whose states are learned on; the later ones only say what came of
            them. That keeps the pool full of encoded observations, which is where the filter will ask.
        steps: gradient steps.
        batch_size: imagined states a gradient step; with discrete actions each is backed up under all of them.
        lr, actor_lr: AdamW step sizes, decayed over the second half.
        actor_through: what a continuous actor climbs: `critic`, Q(z, a) of the states in the pool; or `world_model`,
            the value of the latent that the world model predicts, through its gradient.
        gamma: the final discount; 1 - gamma is annealed from `gamma_start` geometrically over `anneal` of the run,
            after `warmup` of the run at gamma = 0.
        caution: weight of overestimates of V in the squared error, relative to underestimates.
        hinge: weight of a one-sided hinge on V, which should be above `HINGE_ABOVE` where recorded episodes went on to
            succeed, by their column next.success. It keeps the filter from stopping what is known to go well.
        local_updates: updates that each of several processes makes by itself before their weights are averaged (local
            SGD, Stich 2019), which saves most of the waiting. 1: gradients are summed at each, and together the
            processes learn what one would.
        tau: rate of the target network.
        pool: imagined states kept; a part is imagined anew every `refresh` steps.
        greedy: share of imagined trajectories that follow the current fallback policy, which lets imagination visit
            what the fallback would see; the others act at random, each action held for 1 / `switch` steps on average.
        recorded: share of imagined trajectories that go on as their recording did, whatever they would try: imagination
            then visits what the policies of the data do, among them the one to be shielded. What was tried is learned.
        kept: of configurations before 0.2, which are refused: LeRobot's commands read this group of them first.
    """

    critic_hidden: tuple[int, ...] = (128, 128, 128)
    actor_hidden: tuple[int, ...] = (256, 256)
    activation: str = "relu"
    coverage: float = 0.02
    components: int = 16
    horizon: int = 25
    learned_steps: int = 8
    steps: int = 12_000
    batch_size: int = 512
    lr: float = 1e-3
    actor_lr: float = 3e-4
    actor_through: str = "critic"
    gamma: float = 0.9999
    gamma_start: float = 0.8
    warmup: float = 0.04
    anneal: float = 0.26
    caution: float = 2.0
    hinge: float = 0.0
    local_updates: int = 1
    tau: float = 0.05
    pool: int = 131_072
    refresh: int = 250
    greedy: float = 0.5
    switch: float = 0.1
    recorded: float = 0.0
    kept: int | None = None

    def __post_init__(self) -> None:
        if self.kept is not None:
            raise OldLayoutError(
                "this configuration is of a version before 0.2. Migrate the checkpoint once: latentsafe "
                "migrate-checkpoint --policy.path=<old folder> --output_dir=<new folder>"
            )
        if self.actor_through not in ("critic", "world_model"):
            raise ValueError(f"actor_through is {self.actor_through!r}; expected critic or world_model")
        if not 0 <= self.hinge < math.inf:
            raise ValueError(f"--policy.reachability.hinge is {self.hinge}; expected a weight, 0 or more")
        if not 0 <= self.recorded <= 1:
            raise ValueError(f"--policy.reachability.recorded is {self.recorded}; expected a share, 0 to 1")
        if self.local_updates < 1:
            raise ValueError(f"--policy.reachability.local_updates is {self.local_updates}; expected at least 1")


HINGE_ABOVE = 0.3
"""What V should be at least where a recorded episode went on to succeed."""
LARGEST_Q = 10.0
"""V lies in [-1, 1]; a Q that is larger than this was never learned."""


def _mlp(sizes: list[int], activation: str) -> nn.Sequential:
    layers: list[nn.Module] = []
    for i, (n_in, n_out) in enumerate(pairwise(sizes)):
        layers.append(nn.Linear(n_in, n_out))
        if i < len(sizes) - 2:
            layers.append({"tanh": nn.Tanh, "relu": nn.ReLU}[activation]())
    return nn.Sequential(*layers)


def _network(n_components: int, numbers: int, n_action: int, sizes: list[int], activation: str) -> nn.Module:
    """What reads components, where there are any constraints phi and their set, and an action."""
    if not numbers:
        return _mlp([n_components + n_action, *sizes], activation)
    n_read, width = n_components + numbers, sizes[0] // 2
    return SetNetwork(n_read, numbers, width, _mlp([n_read + width + n_action, *sizes], activation))


class SafetyCritic(nn.Module):
    """Q(z, a) and the fallback policy over projected features, for a discrete or a continuous action space.

    Args:
        feature_dim: D.
        action_dim: A.
        candidates: (K, A) in [-1, 1], the discrete action set, or None for continuous actions.
        low, high: (A,) in [-1, 1], the range of a continuous policy's commands; by default all of it.
        target: which of `BACKUPS` the values obey.
        numbers: m, of a critic that takes constraints: features are then followed by phi (m) and the set, which are
            read as they are (see `Constrained`). 0: it knows one failure.
    """

    feature_mean: Tensor
    projection: Tensor
    candidates: Tensor | None
    low: Tensor
    high: Tensor

    def __init__(
        self,
        feature_dim: int,
        action_dim: int,
        candidates: Tensor | None,
        config: ReachabilityConfig,
        low: Tensor | None = None,
        high: Tensor | None = None,
        target: str = "reachability",
        numbers: int = 0,
    ):
        super().__init__()
        self.backup = BACKUPS[target]
        n_components = min(config.components, feature_dim)
        self.register_buffer("feature_mean", torch.zeros(feature_dim))
        self.register_buffer("projection", torch.eye(feature_dim, n_components))
        self.register_buffer("candidates", candidates)
        self.register_buffer("low", -torch.ones(action_dim) if low is None else low, persistent=False)
        self.register_buffer("high", torch.ones(action_dim) if high is None else high, persistent=False)
        self.discrete = candidates is not None
        n_out, n_action = (len(candidates), 0) if self.discrete else (1, action_dim)
        read = n_components, numbers
        self.q = _network(*read, n_action, [*config.critic_hidden, n_out], config.activation)
        self.actor = (
            None if self.discrete else _network(*read, 0, [*config.actor_hidden, action_dim], config.activation)
        )

    def set_projection(self, features: Tensor) -> None:
        """Read the leading principal components of these features (N, D), all on one scale.

        A world model's latent holds far more numbers than the state has degrees of freedom. A critic of all of them,
        each blown up to unit variance, fits its training states and errs on new ones.
        """
        features = features[:, : len(self.feature_mean)]
        self.feature_mean.copy_(features.mean(0))
        _, spread, axes = torch.linalg.svd(features - self.feature_mean, full_matrices=False)
        kept = self.projection.shape[1]
        scale = spread[:kept].square().mean().sqrt() / len(features) ** 0.5
        # An axis has no sign of its own: rounding errors, which differ among machines and ranks, would choose it.
        largest = axes[:kept].gather(1, axes[:kept].abs().argmax(1, keepdim=True))
        self.projection.copy_((axes[:kept] * largest.sign()).T / scale.clamp(min=1e-6))

    def project(self, features: Tensor) -> Tensor:
        """Features (..., D) -> what q and actor read (..., C); a set of constraints follows them as it is."""
        own, more = features.tensor_split([len(self.feature_mean)], -1)
        projected = (own - self.feature_mean) @ self.projection
        return torch.cat([projected, more], -1) if more.shape[-1] else projected

    def held_actions(self, still: Tensor | None = None) -> Tensor:
        """(K, A) actions worth holding: the candidates, or standing still (1, A) and the extremes of each command."""
        if self.discrete:
            return self.candidates
        extremes = [torch.diag(bound)[bound != 0] for bound in (self.high, self.low)]
        return torch.cat([torch.zeros_like(self.low)[None] if still is None else still, *extremes])

    def between(self, share: Tensor) -> Tensor:
        """Continuous actions at these shares in [0, 1] of their ranges: (..., A)."""
        return torch.lerp(self.low, self.high, share)

    def best_q(self, x: Tensor) -> Tensor:
        """max_a Q over projected features (..., D) -> (...,)."""
        return self.q(x).amax(-1) if self.discrete else self.q_of(x, self.act(x))

    def q_of(self, x: Tensor, action: Tensor) -> Tensor:
        """Q(z, a) for continuous actions (..., A), of which only the commands that this policy moves are read."""
        return self.q(torch.cat([x, action * (self.high > self.low)], -1)).squeeze(-1)

    def act(self, x: Tensor) -> Tensor:
        """The fallback action argmax_a Q in [-1, 1]: (..., D) -> (..., A)."""
        if self.discrete:
            return self.candidates[self.q(x).argmax(-1)]
        return self.between(torch.sigmoid(2 * self.actor(x)))

    def value(self, features: Tensor, margin: Tensor) -> Tensor:
        """V = min(l, max_a Q) at raw features (..., D) with bounded margin (...,); a risk's is -1 where l < 0.

        NaN where Q is absurd: a minimum would hide that.
        """
        q = self.best_q(self.project(features))
        return self.backup(margin, torch.where(q.abs() <= LARGEST_Q, q, torch.nan), 1.0)

    def fallback(self, features: Tensor) -> Tensor:
        """Safety-preserving action in [-1, 1] at raw features: (..., D) -> (..., A)."""
        return self.act(self.project(features))
