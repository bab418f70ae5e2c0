"""The verb that says what a tick takes on the user's machine."""

from dataclasses import dataclass, field
from pathlib import Path

import torch

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.cli.places import PolicySource
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.evaluation.tick_time import TickTimes, compare_engines
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.runtime.options import require_at_least

FPS = 15.0
"""Where neither the filter nor the user says how often it decides."""


@dataclass
class Bench:
    """Measure what a tick takes on this machine, part by part, and how many would be late.

    latentsafe bench --policy.path=bag --base_policy_path=bag_diffusion_weak --base_ahead=3

    The robot shows noise at the given rate, once for each engine (law.engine); nothing moves. With a base policy the
    ticks hold its time, too. Options of --law change the filter's law.
    """

    policy: PolicySource
    base_policy_path: str | None = None
    """The policy to shield: a folder, a Hub id, or the name of a committed checkpoint."""
    base_ahead: int = 0
    """Actions still to come when the base policy begins its next chunk in another thread; 0: on the control thread."""
    law: LawOptions = field(default_factory=LawOptions)
    fps: float | None = None
    """Ticks a second; by default those of the filter's data."""
    n_ticks: int = 200
    """Of each engine."""
    json: Path | None = None
    """Where to write the numbers."""

    def __post_init__(self) -> None:
        require_at_least("--n_ticks", self.n_ticks, 10)
        require_at_least("--base_ahead", self.base_ahead, 0)
        if self.fps is not None and not 0 < self.fps < float("inf"):
            raise ValueError(f"--fps is {self.fps}; expected ticks a second, more than 0")

    def run(self) -> None:
        """Measure, print and write."""
        policy = load_filter(self.policy.path, law=self.law)
        if self.base_policy_path:
            policy.attach(BasePolicy.load(self.base_policy_path, policy.config.device, self.base_ahead))
        fps, rows = self.fps or policy.config.trained_on.fps or FPS, {}
        for engine, times in compare_engines(policy, fps, self.n_ticks):
            print("\n".join(_table(engine, times, fps)), flush=True)
            rows[engine] = {"parts": times.summary(), "late": times.late}
        if self.json:
            settings = {"fps": fps, "n_ticks": self.n_ticks, "threads": torch.get_num_threads()}
            write_json(self.json, {"engines": rows, **settings, **provenance(seeds=[0])})


def _table(engine: str, times: TickTimes, fps: float) -> list[str]:
    rows = [f"law.engine={engine}".ljust(28) + "  median      99%   in the slowest 1%"]
    for name, took in times.summary().items():
        rows.append(f"  {name:26s}" + "".join(f"{milliseconds:6.1f} ms" for milliseconds in took.values()))
    return [
        *rows,
        f"  {times.late:.1%} of {len(times.parts['all'])} ticks later than a period ({1e3 / fps:.0f} ms)",
        "",
    ]
