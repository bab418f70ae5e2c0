"""What a tick takes on this machine, part by part: of a filter and the policy that it shields, at the robot's rate.

The robot shows noise. What the guard finds wrong with that is left aside, so every tick is decided as a healthy one.
"""

import gc
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_latentsafe.decision import ENGINES, LawOptions
from lerobot_latentsafe.guard import Guard, Seen, standing_still
from lerobot_latentsafe.latent import Belief, Latent
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.nearest import Found
from lerobot_latentsafe.safety_model import SafetyModel
from lerobot_latentsafe.shield import Shield
from lerobot_latentsafe.tick import Thought

PICTURES = 8
"""Different ones that are shown in turns: what repeats itself at once is not encoded again."""
WARM_UP = 10
"""First ticks of a run, which do not count."""
SMALL = 0.1
"""Of the range of each command: what is proposed where no policy is shielded."""


@dataclass(frozen=True)
class TickTimes:
    """Seconds of ticks at a rate.

    Attributes:
        period: seconds from tick to tick.
        parts: name -> (N,), of each part; `all` is the whole tick.
    """

    period: float
    parts: dict[str, np.ndarray]

    def summary(self) -> dict[str, dict[str, float]]:
        """Part -> milliseconds: median, 99th percentile, and mean in the slowest hundredth of ticks."""
        whole = self.parts["all"]
        slowest = np.argsort(whole)[-max(1, len(whole) // 100) :]
        return {
            name: {
                "median_ms": 1e3 * float(np.median(took)), "p99_ms": 1e3 * float(np.quantile(took, 0.99)),
                "in_the_slowest_ms": 1e3 * float(took[slowest].mean()),
            }
            for name, took in self.parts.items()
        }  # fmt: skip

    @property
    def late(self) -> float:
        """Share of ticks that took longer than a period."""
        return float((self.parts["all"] > self.period).mean())


class TrustingGuard(Guard):
    """Checks what it sees, and finds nothing."""

    def observe(self, observation: dict[str, Tensor]) -> Seen:
        """See the base class."""
        seen = super().observe(observation)
        return replace(seen, fault=np.zeros_like(seen.fault))


class TimedShield(Shield):
    """A shield that nothing is late to, and that notes what each part of a tick took.

    Attributes:
        took: name -> seconds, of each tick.
    """

    def __init__(self, model: SafetyModel):
        super().__init__(model, clock=standing_still)
        self.guard = TrustingGuard(model)
        self.guard.begun = True
        self.took: dict[str, list[float]] = defaultdict(list)

    def _timed[Answer](self, name: str, work: Callable[..., Answer], *given) -> Answer:
        began = time.perf_counter()
        answer = work(*given)
        self.took[name].append(time.perf_counter() - began)
        return answer

    def _perceive(self, seen: Seen) -> dict[str, Tensor]:
        return self._timed("encode", super()._perceive, seen)

    def _think(self, percepts: Latent, *given) -> tuple[Belief, Thought]:
        return self._timed("imagine", super()._think, percepts, *given)

    def _look_for_the_unknown(self, seen: Seen, faults: np.ndarray) -> np.ndarray:
        return self._timed("monitor of the unknown", super()._look_for_the_unknown, seen, faults)

    def _find_nearest(self, latent: Latent, *given) -> Found:
        return self._timed("nearest action", super()._find_nearest, latent, *given)


def compare_engines(policy: LatentSafePolicy, fps: float, n_ticks: int) -> Iterator[tuple[str, TickTimes]]:
    """Ticks of a filter with each of its engines, by name; one that cannot be had is left out.

    Args:
        n_ticks: of each.
    """
    for engine in ENGINES:
        policy.config.change(law=policy.config.law.changed(LawOptions(engine=engine)))
        policy.shield = TimedShield(policy.model)
        policy.reset()
        if engine == "torch" or policy.shield.nearest.thinking.compiled:
            yield engine, measure(policy, fps, n_ticks)


@torch.no_grad()
def measure(policy: LatentSafePolicy, fps: float, n_ticks: int) -> TickTimes:
    """Wall time of ticks of a policy with a `TimedShield`, each begun a period after the last, or when that ended."""
    shield, shown = cast(TimedShield, policy.shield), list(_shown(policy))
    still, took = policy.model.units.still, shield.took
    with _collecting() as garbage:
        for i in range(WARM_UP + n_ticks):
            seen = shown[i % len(shown)]
            began, before = time.perf_counter(), garbage[0]
            if policy.base is None:
                robot = policy.model.units.denormalise_action(still + SMALL * np.cos(i), seen[OBS_STATE])
                shield(seen, robot)
            else:
                policy.decide(seen)
            took["all"].append(time.perf_counter() - began)
            took["of it Python's garbage"].append(garbage[0] - before)
            time.sleep(max(0.0, 1 / fps - took["all"][-1]))
    return TickTimes(1 / fps, {name: np.array(seconds[-n_ticks:]) for name, seconds in took.items()})


@contextmanager
def _collecting() -> Iterator[list[float]]:
    """Seconds that Python has spent collecting garbage so far: a list of one, which grows meanwhile."""
    spent, began = [0.0], [0.0]

    def note(phase: str, _: dict) -> None:
        if phase == "start":
            began[0] = time.perf_counter()
        else:
            spent[0] += time.perf_counter() - began[0]

    gc.callbacks.append(note)
    try:
        yield spent
    finally:
        gc.callbacks.remove(note)


def _shown(policy: LatentSafePolicy) -> Iterator[dict[str, Any]]:
    """What a robot that stands somewhere shows, with pictures of noise."""
    config, model = policy.config, policy.model
    generator = torch.Generator().manual_seed(0)
    for _ in range(PICTURES):
        pictures = {
            key: torch.rand(1, *config.input_features[key].shape, generator=generator).to(model.device)
            for key in model.world_model.image_keys
        }
        yield {**pictures, OBS_STATE: model.units.state_mean[None].clone(), "task": [config.trained_on.task or ""]}
