#!/usr/bin/env python
"""Time of a whole tick at the robot's rate: the filter, and a diffusion policy whose chunks are made in another thread.

    OMP_NUM_THREADS=1 scripts/bench_tick.py --policy=bag --base=outputs/bag/diffusion_weak

Runs the bag at 15 Hz for some episodes, with chunks made on the control thread and off it in turns, and writes
results/bag/bench_tick.json: wall milliseconds from having the cameras' pictures to having an action (median and 99th
percentile), of the filter alone and of filter and policy together, and the share of ticks later than a period.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from tqdm import trange

from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.experiments.bag.runs import FIRST_SEED, WARM_UP, observe
from lerobot_latentsafe.franka.bag import BagScene
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy

DENOISING_STEPS = 10


def shielded(path: str, base: str, ahead: int) -> LatentSafePolicy:
    policy = LatentSafePolicy.from_pretrained(path).eval()
    policy.config.base_ahead = ahead
    policy.attach(base)
    policy.base.policy.diffusion.num_inference_steps = DENOISING_STEPS
    return policy


@torch.no_grad()
def episode(policy: LatentSafePolicy, scene: BagScene, steps: int, alone: bool) -> list[float]:
    """Wall seconds of each tick; a tick begins no sooner than a period after the last."""
    policy.reset()
    period, ticks, moving = 1 / scene.fps, [], policy.hold_action(1)
    for i in range(steps):
        moving[0, 2] = 0.005 * np.cos(i)  # up and down, for a picture that repeats itself is not encoded again
        seen, began = observe(scene), time.perf_counter()
        action = policy.shield(seen, moving).action if alone else policy.select_action(seen)
        ticks.append(time.perf_counter() - began)
        scene.step(action[0].double().numpy())
        time.sleep(max(0.0, period - (time.perf_counter() - began)))
    return ticks[WARM_UP:]


def row(ticks: list[float], period: float) -> dict[str, float]:
    ms = np.array(ticks) * 1e3
    late = float((ms > period * 1e3).mean())
    return {"n": len(ms), "p50_ms": float(np.median(ms)), "p99_ms": float(np.quantile(ms, 0.99)), "late": late}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="bag")
    parser.add_argument("--base", required=True, help="a diffusion policy of the bag")
    parser.add_argument("--ahead", type=int, default=3, help="actions still to come when the next chunk is begun")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=90)
    parser.add_argument("--output", type=Path, default=Path("results/bag/bench_tick.json"))
    arguments = parser.parse_args()
    scene = BagScene()
    on, off = (shielded(arguments.policy, arguments.base, ahead) for ahead in (0, arguments.ahead))
    variants = {"filter alone": (on, True), "chunks on the control thread": (on, False), "chunks ahead": (off, False)}
    ticks: dict[str, list[float]] = {name: [] for name in variants}
    for i in trange(arguments.rounds, unit="round"):
        for name, (policy, alone) in variants.items():
            scene.reset(FIRST_SEED + i)
            torch.manual_seed(i)
            ticks[name] += episode(policy, scene, arguments.steps, alone)
    rows = {name: row(values, 1 / scene.fps) for name, values in ticks.items()}
    for name, values in rows.items():
        print(name, {key: round(value, 3) for key, value in values.items()})
    settings = {"threads": torch.get_num_threads(), "denoising_steps": DENOISING_STEPS, "ahead": arguments.ahead}
    seeds = [FIRST_SEED, FIRST_SEED + arguments.rounds - 1]
    write_json(arguments.output, {**rows, **settings, **provenance(seeds)})


if __name__ == "__main__":
    main()
