#!/usr/bin/env python
"""CPU time from recordings to a filter, of two checkouts in turn: each step is timed at two sizes, and what it would
take at full size follows.

    git worktree add ../before 2d9faaf
    scripts/bench_recipe.py --before=../before --dataset=data/bag_swings --frames=128962

Both checkouts run with this Python, each with its own configs/bag_gru.yaml. What a cache costs is a line through two
numbers of episodes, a training one through two numbers of steps; of several rounds the least seconds of each run count,
for other work and a cold start only add. Writes results/bag/bench_recipe.json: CPU seconds of each run, and minutes at
full size.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import yaml

from lerobot_latentsafe.evaluation.statistics import provenance, write_json

BIN, HERE = Path(sys.executable).parent, Path(__file__).parents[1]
EPISODES, STEPS, CRITIC_STEPS = (50, 120), (60, 260), (250, 1250)
"""Sizes at which steps are timed; of 45 episodes or more, as many frames are sampled as of all."""
ENCODING: dict[str, tuple[str, ...]] = {"before": (), "now": ("--engine=onnx",)}
"""How a cache is made, beyond what both can."""


def cpu_seconds(checkout: Path, log: Path, *command: str) -> float:
    """Of a command of a checkout.

    Raises:
        SystemExit: it failed; with the end of its output.
    """
    environment = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
    before = os.times()
    with log.open("a") as stream:
        program = [str(BIN / command[0]), *command[1:]]
        code = subprocess.run(program, cwd=checkout, env=environment, stdout=stream, stderr=stream).returncode
    if code:
        raise SystemExit(f"{' '.join(command)} failed in {checkout}; the end of its output:\n{log.read_text()[-2000:]}")
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def commands(dataset: Path, work: Path, encoding: Sequence[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """The steps of the recipe, each at its sizes, in order: its name and its command.

    Args:
        encoding: further options of `latentsafe cache`.
    """
    cache = work / str(EPISODES[1])
    for n in EPISODES:
        some = f"--dataset.episodes={json.dumps([*range(n)])}"
        source = ("--dataset.repo_id=me/bag", f"--dataset.root={dataset}", some)
        how = ("--encoder=efficientnet_lite0", *encoding, f"--output_dir={work}/{n}")
        yield "cache", ("latentsafe", "cache", *source, *how)
    of_cache = ("--dataset.repo_id=me/bag", f"--dataset.root={cache}")
    for n in STEPS:
        how = (f"--steps={n}", f"--save_freq={n}", f"--output_dir={work}/wm_{n}", f"--policy.frame_cache={cache}")
        yield "world model", ("lerobot-train", "--config_path=configs/bag_gru.yaml", *of_cache, *how)
    trained = f"--policy.path={work}/wm_{STEPS[1]}/checkpoints/last/pretrained_model"
    yield "margin", ("latentsafe", "train-margin", trained, *of_cache, f"--output_dir={work}/margin")
    for n in CRITIC_STEPS:
        how = (f"--policy.path={work}/margin", f"--steps={n}", f"--output_dir={work}/filter_{n}")
        yield "reachability", ("latentsafe", "train-reachability", *how, *of_cache)


def seconds_in_turn(checkouts: dict[str, Path], dataset: Path) -> dict[str, dict[str, list[float]]]:
    """Checkout -> step of the recipe -> CPU seconds at each of its sizes. At each step all take their turn."""
    timed: dict[str, dict[str, list[float]]] = {name: {} for name in checkouts}
    with TemporaryDirectory() as folder:
        works = {name: Path(folder) / name for name in checkouts}
        for work in works.values():
            work.mkdir()
        for turn in zip(*(commands(dataset, work, ENCODING[name]) for name, work in works.items()), strict=True):
            for (name, checkout), (step, command) in zip(checkouts.items(), turn):
                took = cpu_seconds(checkout, works[name] / "log", *command)
                timed[name].setdefault(step, []).append(took)
                print(f"{name} {step}: {took:.1f} CPU-seconds", flush=True)
    return timed


def least(rounds: list[dict[str, list[float]]]) -> dict[str, list[float]]:
    """Step -> its seconds at each size, of several rounds the least."""
    return {step: [min(at_size) for at_size in zip(*(timed[step] for timed in rounds))] for step in rounds[0]}


def at_full_size(
    timed: dict[str, list[float]], checkout: Path, n_frames: int, frames: tuple[int, int]
) -> dict[str, float]:
    """Step -> minutes, by a line through its two sizes."""
    config = yaml.safe_load((checkout / "configs/bag_gru.yaml").read_text())
    sizes = {
        "cache": (frames, n_frames),
        "world model": (STEPS, config["steps"]),
        "reachability": (CRITIC_STEPS, config["policy"]["reachability"]["steps"]),
    }
    minutes = {"margin": timed["margin"][0] / 60}
    for step, ((few, many), full) in sizes.items():
        less, more = timed[step]
        minutes[step] = (less + (more - less) / (many - few) * (full - few)) / 60
    return {**minutes, "all": sum(minutes.values())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, required=True, help="a checkout to compare with")
    parser.add_argument("--dataset", type=Path, required=True, help=f"of the bag, of {EPISODES[1]} episodes or more")
    parser.add_argument("--frames", type=int, required=True, help="of the recordings at full size")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--output", type=Path, default=Path("results/bag/bench_recipe.json"))
    arguments = parser.parse_args()
    dataset = arguments.dataset.absolute()
    length = json.loads((dataset / "meta/info.json").read_text())
    a_frame = length["total_frames"] / length["total_episodes"]
    frames = (round(EPISODES[0] * a_frame), round(EPISODES[1] * a_frame))
    checkouts = {"before": arguments.before.absolute(), "now": HERE}
    rounds = [seconds_in_turn(checkouts, dataset) for _ in range(arguments.rounds)]
    minutes = {
        name: at_full_size(least([timed[name] for timed in rounds]), at, arguments.frames, frames)
        for name, at in checkouts.items()
    }
    ratio = minutes["now"]["all"] / minutes["before"]["all"]
    print(minutes, f"now, against before: {ratio:.2f}")
    spent = sum(sum(seconds) for timed in rounds for steps in timed.values() for seconds in steps.values()) / 60
    settings = {
        "frames": arguments.frames,
        "sizes": {"cache": frames, "world model": STEPS, "reachability": CRITIC_STEPS},
    }
    measured = {"seconds": rounds, "minutes": minutes, "now_over_before": ratio}
    write_json(arguments.output, {**measured, **settings, **provenance([0], spent)})


if __name__ == "__main__":
    main()
