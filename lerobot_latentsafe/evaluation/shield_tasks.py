"""Running a policy bare and shielded in tasks, on one computer or several.

A piece is a batch of episodes that run side by side, from the seed of its first on: what a policy draws depends on who
runs beside it, and not on the task.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from lerobot.envs.configs import EnvConfig

from lerobot_latentsafe.decision import LawConfig
from lerobot_latentsafe.evaluation.rollouts import Episodes, check_shielding, compared, run_episodes
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.runtime.tasks import Pieces


class Batch(NamedTuple):
    """Episodes from the same starts, the filter's law, and the CPU seconds that they took."""

    bare: Episodes
    shielded: Episodes
    law: LawConfig
    cpu_s: float


@dataclass(frozen=True)
class CutComparison(Pieces[LatentSafePolicy, Batch]):
    """A comparison of a policy bare and shielded that is cut into tasks; see `rollouts.compare`.

    Attributes:
        load: the filter, with the policy to shield.
        tell: hears what `compared` returns, the filter's law, and `made` with the CPU minutes of all tasks.
        made: where the numbers come from; see `statistics.provenance`.
    """

    output: Path
    load: Callable[[], LatentSafePolicy]
    env: EnvConfig
    n_episodes: int
    seed: int
    batch_size: int
    n_videos: int
    tell: Callable[[dict, LawConfig, dict], None]
    made: dict[str, Any]

    name = "episodes"

    @property
    def numbers(self) -> Sequence[int]:
        """The first episode of each batch."""
        return range(0, self.n_episodes, self.batch_size)

    def begin(self) -> LatentSafePolicy:
        """The filter, if it fits the environment.

        Raises:
            ValueError: nothing to shield, or an environment that is not the filter's.
        """
        policy = self.load()
        check_shielding(policy, self.env)
        return policy

    def made_of(self, policy: LatentSafePolicy) -> dict[str, Any]:
        """The filter and the policy by their weights, and the options."""
        own = {name: getattr(self, name) for name in ("n_episodes", "seed", "batch_size", "n_videos")}
        return {"filter": policy.belonging(), "law": asdict(policy.config.law), "env": repr(self.env), **own}

    def do(self, policy: LatentSafePolicy, numbers: Sequence[int]) -> Iterator[Batch]:
        """Run some batches."""
        for first in numbers:
            began = time.process_time()
            n, n_videos = min(self.batch_size, self.n_episodes - first), max(0, self.n_videos - first)
            bare, shielded = (
                # Latents, which only a report shows, would have to lie on the device that made them.
                replace(run_episodes(actor, self.env, n, self.seed + first, n, n_videos), latents=[])
                for actor in (policy.base, policy)
            )
            yield Batch(bare, shielded, policy.config.law, time.process_time() - began)

    def finish(self, results: list[Batch]) -> dict[str, Any]:
        """Compare all episodes, and tell."""
        result = compared(*(Episodes.joined([getattr(b, name) for b in results]) for name in ("bare", "shielded")))
        minutes = round(sum(batch.cpu_s for batch in results) / 60, 2)
        self.tell(result, results[0].law, {**self.made, "cpu_minutes": minutes})
        return result
