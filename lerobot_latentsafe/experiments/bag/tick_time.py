"""Time of a whole tick at the robot's rate: the filter, and a policy whose chunks are made in another thread."""

import gc
import resource
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import trange

from lerobot_latentsafe.base_policy import BasePolicy
from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.evaluation.rollouts import Choice, steps
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.bag.runs import FIRST_SEED, WARM_UP
from lerobot_latentsafe.experiments.scene_world import SceneWorld
from lerobot_latentsafe.franka.bag import BagScene
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, load_filter

DENOISING_STEPS = 10


def shielded(path: str, base: str, ahead: int, engine: str) -> LatentSafePolicy:
    """A filter over a diffusion policy whose chunks are made so many actions ahead; 0: on the control thread."""
    policy = load_filter(path, law=LawOptions(engine=engine))
    policy.attach(BasePolicy.load(base, policy.config.device, ahead))
    policy.base.policy.diffusion.num_inference_steps = DENOISING_STEPS
    return policy


class Tick(NamedTuple):
    """What a tick took, and what may have made it slow, in all threads of this process.

    Attributes:
        wall_s: seconds.
        faults: pages that were not in memory yet.
        preempted: times that another process or thread took the core.
        collected: garbage collections.
    """

    wall_s: float
    faults: int
    preempted: int
    collected: int

    @classmethod
    def now(cls) -> "Tick":
        """Totals until now."""
        usage = resource.getrusage(resource.RUSAGE_SELF)
        collected = sum(generation["collections"] for generation in gc.get_stats())
        return cls(time.perf_counter(), usage.ru_minflt, usage.ru_nivcsw, collected)

    def since(self, earlier: "Tick") -> "Tick":
        """What came after an earlier total."""
        counts = (int(now - before) for now, before in zip(self[1:], earlier[1:]))
        return Tick(self.wall_s - earlier.wall_s, *counts)


class TimedShield:
    """A filter over its base policy, or alone over a small motion.

    Attributes:
        began: totals when the last tick did.
        ticks: what each took.
    """

    def __init__(self, policy: LatentSafePolicy, alone: bool):
        policy.reset()
        units = policy.model.units
        self.policy, self.alone, self.moving = policy, alone, units.denormalise_action(units.still)
        self.ticks: list[Tick] = []

    @torch.no_grad()
    def __call__(self, seen: dict[str, Tensor]) -> Choice:
        # Up and down, for a picture that repeats itself is not encoded again.
        self.moving[0, 2] = 0.005 * np.cos(len(self.ticks))
        self.began = Tick.now()
        shield, policy = self.policy.shield, self.policy
        action = shield(seen, self.moving).action if self.alone else policy.select_action(seen)
        self.ticks.append(Tick.now().since(self.began))
        return Choice(action.numpy())


def episode(policy: LatentSafePolicy, scene: BagScene, n_steps: int, alone: bool) -> list[Tick]:
    """All ticks but the first; a tick begins no sooner than a period after the last."""
    actor = TimedShield(policy, alone)
    for _ in steps(SceneWorld(scene, n_steps), actor):
        time.sleep(max(0.0, 1 / scene.fps - (time.perf_counter() - actor.began.wall_s)))
    return actor.ticks[WARM_UP:]


def in_ms(ticks: list[Tick], period: float) -> dict:
    """Median, 99th percentile, the share that is later than a period, and of all ticks and of the slowest hundredth
    what happened in them, on average."""
    ms = np.array([tick.wall_s for tick in ticks]) * 1e3
    slow = ms >= np.quantile(ms, 0.99)
    happened = {name: np.array([getattr(tick, name) for tick in ticks], float) for name in Tick._fields[1:]}
    return {
        "n": len(ms),
        "p50_ms": float(np.median(ms)),
        "p99_ms": float(np.quantile(ms, 0.99)),
        "late": float((ms > period * 1e3).mean()),
        "in_all": {name: float(values.mean()) for name, values in happened.items()},
        "in_the_slowest": {name: float(values[slow].mean()) for name, values in happened.items()},
    }


def write_times(path: str, base: str, ahead: int, n_rounds: int, n_steps: int, output: Path) -> None:
    """Run each variant in turns, and write its times.

    Args:
        path, base: of a filter, and of a diffusion policy of the bag.
        ahead: actions still to come when the next chunk is begun.
        n_rounds, n_steps: episodes of each variant, and their length.
    """
    scene = BagScene()
    variants: dict[str, tuple[LatentSafePolicy, bool]] = {}
    for engine, suffix in (("torch", ""), ("onnx", ", compiled")):
        on, off = (shielded(path, base, actions, engine) for actions in (0, ahead))
        alone, here, elsewhere = "filter alone", "chunks on the control thread", "chunks ahead"
        variants |= {alone + suffix: (on, True), here + suffix: (on, False), elsewhere + suffix: (off, False)}
    ticks: dict[str, list[Tick]] = {name: [] for name in variants}
    for i in trange(n_rounds, unit="round"):
        for name, (policy, is_alone) in variants.items():
            scene.reset(FIRST_SEED + i)
            torch.manual_seed(i)
            ticks[name] += episode(policy, scene, n_steps, is_alone)
    rows = {name: in_ms(values, 1 / scene.fps) for name, values in ticks.items()}
    for name, values in rows.items():
        print(name, values)
    settings = {"threads": torch.get_num_threads(), "denoising_steps": DENOISING_STEPS, "ahead": ahead}
    write_json(output, {**rows, **settings, **provenance([FIRST_SEED, FIRST_SEED + n_rounds - 1])})
