"""Hamilton-Jacobi reachability in imagination: the safety value and the fallback policy (Eq. 4 and 5).

The learner never sees an environment. It needs an `Imagination`: something that steps latents under actions and
knows their margin. A world model is one, the true car is another, and both are learned by the same code.

V(z) = min(l(z), max_a Q(z, a)), where Q(z, a) is the value *after* a: Q(z, a) = V(z') for z' = step(z, a).
"""

import copy
import math
from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from lerobot_latentsafe.critic import HINGE_ABOVE, ReachabilityConfig, SafetyCritic, safety_bellman_target
from lerobot_latentsafe.latent import FRAME, Latent, Recorded, map_latent, replace_rows, select
from lerobot_latentsafe.runtime.distributed import (
    any_rank,
    average_over_ranks,
    from_first_rank,
    gathered,
    share,
    sum_over_ranks,
)

Starts = Callable[[int], Latent]
"""Draws a batch of latents from which imagination starts: encoded dataset windows. Of several ranks, each gets its
share of the batch (see `ranks.py`)."""


class Imagination(Protocol):
    """What reachability needs to know of the world; latents are batch-first structures of tensors.

    Attributes:
        sampled: whether `step` draws one of several futures, so that what came of an action once need not come again.
    """

    sampled: bool

    def step(self, latent: Latent, action: Tensor) -> Latent:
        """Next latent under actions (B, A) in [-1, 1]."""

    def follow(self, latent: Latent, actions: Tensor) -> Latent:
        """Next latent under the actions of a step's ticks, side by side (B, K A)."""

    def features(self, latent: Latent) -> Tensor:
        """(B, D), what actor and critic read."""

    def margin(self, latent: Latent) -> Tensor:
        """Bounded margin l(z): (B,)."""

    def judged(self, latent: Latent) -> tuple[Tensor, Tensor]:
        """Features (B, D) and bounded margin (B,), both at once."""

    def ended(self, latent: Latent) -> Tensor:
        """Whether the episode is over in this latent: bool (B,). Nothing can fail after that."""

    def complete(self, latent: Latent, action: Tensor) -> Tensor:
        """The action (B, A) with the commands that a fallback leaves as they were before this latent."""


@torch.no_grad()
def look_ahead(
    imagination: Imagination, latent: Latent, held: Tensor, horizon: int, critic: SafetyCritic | None = None
) -> tuple[Tensor, Tensor]:
    """V by imagining what could be done from here: the best of a few policies, each followed for `horizon` steps.

    The policies hold one action each; given a critic, its fallback policy is one more, and its value stands for all
    that comes after the horizon. Each outcome is a lower bound of V in the imagined world, up to the error of that
    last value. With horizon 0 and a critic this is min(l, max_a Q).

    Args:
        latent: N latents.
        held: (K, A) actions in [-1, 1].

    Returns:
        V (N,), and the first action of the best policy (N, A).
    """
    features, margin = imagination.judged(latent)
    if horizon == 0 and critic is not None:
        return critic.value(features, margin), imagination.complete(latent, critic.fallback(features))
    n, n_policies = len(margin), len(held) + (critic is not None)
    z = map_latent(latent, lambda t: t.repeat(n_policies, *[1] * (t.dim() - 1)))
    worst, over = margin.repeat(n_policies), torch.zeros(n * n_policies, dtype=torch.bool, device=margin.device)
    action = first = held.repeat_interleave(n, 0)
    for t in range(horizon):
        if critic is not None:  # the last n follow its fallback policy
            action = torch.cat([action[: len(held) * n], critic.fallback(features[-n:])])
        action = imagination.complete(z, action)
        first = action if t == 0 else first
        z = imagination.step(z, action)
        features, margin = imagination.judged(z)
        worst = torch.where(over, worst, torch.minimum(worst, margin))
        over = over | imagination.ended(z)
    if critic is not None:
        worst = torch.where(over, worst, torch.minimum(worst, critic.value(features, margin)))
    best = worst.view(n_policies, n).max(0)
    return best.values, first.view(n_policies, n, -1)[best.indices, torch.arange(n, device=worst.device)]


def discount(progress: float, config: ReachabilityConfig) -> float:
    """gamma at a share of the run: 0, then 1 - gamma falls geometrically from gamma_start's to gamma's."""
    if progress < config.warmup:
        return 0.0
    share = min(1.0, (progress - config.warmup) / config.anneal)
    first, last = 1 - config.gamma_start, 1 - config.gamma
    return 1 - first * (last / first) ** share


class LatentReachability:
    """DDQN (discrete actions) or DDPG (continuous) on thousands of imagined states in parallel.

    Imagined states live in a pool of tensors; every `refresh` steps a slice of it is imagined anew from fresh starts.
    With discrete actions the successors under *all* actions are imagined, so each update backs up every action.

    Several ranks learn what one learns: they make the same draws, of which each imagines and backs up its share. What
    they imagine is gathered in the pool of each, and gradients are summed. With `local_updates`, each follows its own
    gradient for so many updates, after which their weights are averaged.

    Args:
        succeeding: (M, D), features of latents from which a recorded episode went on to succeed, for the hinge.
        recorded: what the recordings did, where a share of trajectories goes on like them; starts then hold `FRAME`.
    """

    def __init__(
        self, imagination: Imagination, critic: SafetyCritic, starts: Starts, config: ReachabilityConfig,
        generator: torch.Generator | None = None, succeeding: Tensor | None = None, recorded: Recorded | None = None,
    ):  # fmt: skip
        self.succeeding, self.recorded = succeeding, recorded
        self.imagination, self.critic, self.starts, self.config = imagination, critic, starts, config
        self.generator = generator
        self.target = copy.deepcopy(critic).requires_grad_(False)
        groups = [{"params": critic.q.parameters(), "lr": config.lr}]
        if critic.actor is not None:
            groups.append({"params": critic.actor.parameters(), "lr": config.actor_lr})
        fused = critic.feature_mean.device.type in ("cpu", "cuda")
        self.optimizer = torch.optim.AdamW(groups, weight_decay=0.0, fused=fused)
        self.step_count = 0
        self.learned_steps = min(config.learned_steps, config.horizon)
        self.chunk = max(1, min(2048, config.pool // self.learned_steps))
        self.pool: dict[str, Tensor] = {}
        self._fill_pool()

    # -- imagination ---

    @torch.no_grad()
    def imagine(self) -> dict[str, Tensor]:
        """Roll `chunk` starts out for `horizon` steps and keep the first `learned_steps` of them.

        Returns:
            x (N, C) projected features and the action taken (N, A); next_x (N, K, C), next_l and ended (N, K), where
            the K successors are those of all candidates, of which `choice` (N,) was taken, or the only one when actions
            are continuous; and what `_add_outcomes` says of the rest of the trajectory.
        """
        critic, config = self.critic, self.config
        latent, frame = self._start()
        greedy = self._rand() < config.greedy
        as_recorded = None if self.recorded is None else self._rand() < config.recorded
        held, n = self._random_actions(), len(greedy)
        rows: list[dict[str, Tensor]] = []
        for t in range(config.horizon):
            features = self.imagination.features(latent)
            x = critic.project(features)
            held = torch.where((self._rand() < config.switch)[:, None], self._random_actions(), held)
            action, choice = self._explore(x, greedy, held)
            action = self.imagination.complete(latent, action)
            if critic.discrete and t < self.learned_steps:
                tried = critic.candidates.unsqueeze(0).expand(n, -1, -1)
            else:
                tried, choice = action[:, None], torch.zeros_like(choice)
            k = tried.shape[1]
            repeated = map_latent(latent, lambda t, k=k: t.repeat_interleave(k, 0))
            after = self.imagination.step(repeated, tried.flatten(0, 1))
            next_features, ended = self.imagination.features(after), self.imagination.ended(after)
            rows.append(
                {
                    "x": x,
                    "action": action,
                    "choice": choice,
                    "next_x": critic.project(next_features).unflatten(0, (n, k)),
                    "next_l": self.imagination.margin(after).unflatten(0, (n, k)),
                    "ended": ended.unflatten(0, (n, k)),
                }
            )
            taken = torch.arange(n, device=x.device) * k + choice
            before, latent, over = latent, select(after, taken), ended[taken]
            if self.recorded is not None:
                followed = self.imagination.follow(before, self.recorded.action[frame])
                latent, frame = replace_rows(latent, followed, where=as_recorded), self.recorded.following[frame]
                over = self.imagination.ended(latent)
            if any_rank(over.any()):
                fresh, at = self._start()
                latent, frame = replace_rows(latent, fresh, where=over), torch.where(over, at, frame)
        self._add_outcomes(rows, as_recorded)
        columns = {key: torch.stack([row[key] for row in rows[: self.learned_steps]], 1) for key in rows[0]}
        return {key: gathered(column).transpose(0, 1).flatten(0, 1) for key, column in columns.items()}

    def _start(self) -> tuple[Latent, Tensor]:
        """Latents (n,) from which trajectories start, and which frame each is; 0 where that was not asked for."""
        latent = dict(self.starts(self.chunk))
        n = len(next(iter(latent.values())))
        return latent, latent.pop(FRAME, torch.zeros(n, dtype=torch.long, device=self.critic.feature_mean.device))

    @staticmethod
    def _add_outcomes(rows: list[dict[str, Tensor]], as_recorded: Tensor | None = None) -> None:
        """What came of each action taken: the worst margin until the trajectory's end, and the latent it ended in.

        Adds worst (N,), end_x (N, C) and end_over (N,): whether the episode was over there. Nothing is known of what
        was tried where the trajectory went on `as_recorded` (N,): the worst is then the least margin there is.
        """
        later: dict[str, Tensor] | None = None
        for row in reversed(rows):
            each = torch.arange(len(row["choice"]), device=row["choice"].device)
            margin, over, x = (row[key][each, row["choice"]] for key in ("next_l", "ended", "next_x"))
            if later is None:
                row |= {"worst": margin, "end_x": x, "end_over": over}
            else:
                row["worst"] = torch.where(over, margin, torch.minimum(margin, later["worst"]))
                row["end_x"] = torch.where(over[:, None], x, later["end_x"])
                row["end_over"] = over | later["end_over"]
            later = row
        if as_recorded is not None:
            for row in rows:
                row["worst"] = torch.where(as_recorded, -1.0, row["worst"])

    def _random_actions(self) -> Tensor:
        """(n, A): the index of a candidate in the first column, or an action if they are continuous."""
        critic = self.critic
        if critic.discrete:
            return self._draw(torch.randint, len(critic.candidates), (self.chunk, 1))
        return critic.between(self._rand(len(critic.low)))

    def _explore(self, x: Tensor, greedy: Tensor, held: Tensor) -> tuple[Tensor, Tensor]:
        """Actions (n, A) and the index of the successor they lead to (n,)."""
        critic = self.critic
        if critic.discrete:
            choice = torch.where(greedy, critic.q(x).argmax(-1), held[:, 0])
            return critic.candidates[choice], choice
        action = critic.act(x)
        noise = 0.15 * self._draw(torch.randn, (self.chunk, action.shape[1]))
        action = (action + noise * (critic.high - critic.low)).clamp(critic.low, critic.high)
        action = torch.where(greedy[:, None], action, held)
        return action, torch.zeros(len(x), dtype=torch.long, device=x.device)

    def _rand(self, *shape: int) -> Tensor:
        """Uniform in [0, 1), for each of this rank's n trajectories: (n, *shape)."""
        return self._draw(torch.rand, (self.chunk, *shape))

    def _draw(self, function: Callable[..., Tensor], *arguments: object) -> Tensor:
        """This rank's share of what all ranks draw."""
        return share(function(*arguments, generator=self.generator, device=self.critic.feature_mean.device))

    @torch.no_grad()
    def _fill_pool(self) -> None:
        self.critic.set_projection(gathered(self.imagination.features(self.starts(4096))))
        for tensor in self.critic.state_dict().values():
            from_first_rank(tensor)  # the same to the last bit, whatever computes the others
        self.target.load_state_dict(self.critic.state_dict())
        n_chunks = max(1, self.config.pool // (self.chunk * self.learned_steps))
        chunks = [self.imagine() for _ in range(n_chunks)]
        self.pool = {key: torch.cat([c[key] for c in chunks]) for key in chunks[0]}
        self._oldest = 0

    @torch.no_grad()
    def _refresh_pool(self) -> None:
        fresh = self.imagine()
        n, size = len(fresh["choice"]), len(self.pool["choice"])
        for key, value in fresh.items():
            self.pool[key][self._oldest : self._oldest + n] = value
        self._oldest = (self._oldest + n) % size

    # -- learning ---

    def update(self) -> dict[str, float]:
        """One gradient step; returns metrics."""
        config = self.config
        progress = self.step_count / config.steps
        decay = min(1.0, (self.step_count + 1) / 200) * (1.0 if progress < 0.5 else 0.02 ** (2 * progress - 1))
        for group, lr in zip(self.optimizer.param_groups, (config.lr, config.actor_lr)):
            group["lr"] = lr * decay
        if self.step_count and self.step_count % config.refresh == 0:
            self._refresh_pool()
        gamma = discount(progress, config)
        picked = self._draw(torch.randint, len(self.pool["choice"]), (config.batch_size,))
        together = config.local_updates == 1
        weight = len(picked) / config.batch_size if together else 1.0  # of this rank's means
        batch = {key: value[picked] for key, value in self.pool.items()}
        target = self._td_target(batch, gamma)
        critic_loss = self._cautious_loss(self._predict(batch) - target)
        loss = critic_loss
        if self.succeeding is not None:
            loss = loss + config.hinge * self._hinge(self.succeeding)
        metrics = weight * torch.stack([critic_loss.detach(), target.mean()])
        self.optimizer.zero_grad(set_to_none=True)
        (weight * loss).backward(inputs=list(self.critic.q.parameters()))
        if self.critic.actor is not None:
            through_model = config.actor_through == "world_model"
            aim = self._imagined_value() if through_model else self._actor_objective(batch["x"])
            (-weight * aim).backward(inputs=list(self.critic.actor.parameters()))
        learned = [p for group in self.optimizer.param_groups for p in group["params"]]
        if together:
            sum_over_ranks([*(p.grad for p in learned), metrics])
        self.optimizer.step()
        with torch.no_grad():
            for old, new in zip(self.target.parameters(), self.critic.parameters()):
                old.lerp_(new, config.tau)
        self.step_count += 1
        if not together and (self.step_count % config.local_updates == 0 or self.step_count == config.steps):
            average_over_ranks([*learned, *self.target.parameters(), metrics])
        error, value = metrics.tolist()
        if not math.isfinite(error):
            raise FloatingPointError(f"critic loss is {error} at step {self.step_count}; lower --reachability.lr")
        return {"critic_loss": error, "gamma": gamma, "value": value}

    def _cautious_loss(self, error: Tensor) -> Tensor:
        """Squared error in which an overestimate, a danger missed, weighs `caution` times an underestimate."""
        return (torch.where(error > 0, self.config.caution, 1.0) * error.square()).mean()

    def _hinge(self, succeeding: Tensor) -> Tensor:
        """Mean square of what V lacks where recorded episodes went on to succeed; the actor is not changed by it."""
        picked = self._draw(torch.randint, len(succeeding), (self.config.batch_size,))
        x, critic = self.critic.project(succeeding[picked]), self.critic
        best = critic.best_q(x) if critic.discrete else critic.q_of(x, critic.act(x).detach())
        return torch.relu(HINGE_ABOVE - best).square().mean()

    def _predict(self, batch: dict[str, Tensor]) -> Tensor:
        if self.critic.discrete:
            return self.critic.q(batch["x"])
        return self.critic.q_of(batch["x"], batch["action"])[:, None]

    @torch.no_grad()
    def _td_target(self, batch: dict[str, Tensor], gamma: float) -> Tensor:
        """Targets of Q(z, a) = V(z'), Eq. 5 read at the successor: (batch, K).

        What an imagined trajectory achieved bounds the value of its first action from below: where that is more than
        the one-step target, it is the target. Otherwise the errors of 25 chained minima add up to false alarms.
        """
        x, l, ended = batch["next_x"], batch["next_l"], batch["ended"]
        if self.critic.discrete:  # double Q: the online network chooses, the target network judges
            choice = self.critic.q(x).argmax(-1, keepdim=True)
            future = self.target.q(x).gather(-1, choice).squeeze(-1)
        else:
            future = self.target.best_q(x)
        # No margin is below -1: a Q that is would draw all others after it.
        target = self.critic.backup(l, torch.where(ended, torch.inf, future.clamp(min=-1)), gamma)
        if self.imagination.sampled or self.critic.backup is not safety_bellman_target:
            return target  # what was achieved once bounds neither what is drawn again nor a probability
        beyond = torch.where(batch["end_over"], torch.inf, self.target.best_q(batch["end_x"]))
        achieved = torch.minimum(batch["worst"], beyond)[:, None]
        taken = batch["choice"][:, None]
        return target.scatter(1, taken, torch.maximum(target.gather(1, taken), achieved))

    def _actor_objective(self, x: Tensor) -> Tensor:
        """Mean Q of the actor's actions, with the critic's weights held fixed."""
        frozen = {name: p.detach() for name, p in self.critic.q.named_parameters()}
        inputs = torch.cat([x, self.critic.act(x) * (self.critic.high > self.critic.low)], -1)
        return torch.func.functional_call(self.critic.q, frozen, (inputs,)).mean()

    def _imagined_value(self) -> Tensor:
        """Mean V of the latents that the actor's actions lead to from fresh starts; its gradient runs through them."""
        latent = self.starts(self.config.batch_size)
        action = self.imagination.complete(latent, self.critic.fallback(self.imagination.features(latent)))
        after = self.imagination.step(latent, action)
        return self.target.value(self.imagination.features(after), self.imagination.margin(after)).mean()
