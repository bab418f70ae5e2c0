#!/usr/bin/env python
"""CPU time from recordings to a filter, of two checkouts in turn: each step is timed at two sizes, and what it would
take at full size follows.

    git worktree add ../before 2d9faaf
    scripts/bench_recipe.py --before=../before --dataset=data/bag_swings --frames=128962

Both checkouts run with this Python, each with its own configs/bag_gru.yaml. What a cache costs is a line through two
numbers of episodes, a training one through two numbers of steps. Writes results/bag/bench_recipe.json: CPU seconds of
each run, and minutes at full size.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import yaml

from lerobot_latentsafe.evaluation.statistics import provenance, write_json

BIN, HERE = Path(sys.executable).parent, Path(__file__).parents[1]
EPISODES, STEPS, CRITIC_STEPS = (30, 120), (60, 260), (250, 1250)
"""Sizes at which steps are timed."""


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


def seconds_of_steps(checkout: Path, dataset: Path, work: Path) -> dict[str, list[float]]:
    """Step of the recipe -> CPU seconds at each of its sizes."""
    log, cache = work / "log", work / str(EPISODES[1])
    timed: dict[str, list[float]] = {"cache": [], "world model": [], "margin": [], "reachability": []}

    def run(step: str, *command: str) -> None:
        timed[step].append(cpu_seconds(checkout, log, *command))
        print(f"{checkout.name} {step}: {timed[step][-1]:.1f} CPU-seconds", flush=True)

    for n in EPISODES:
        some = f"--dataset.episodes={json.dumps([*range(n)])}"
        source = ("--dataset.repo_id=me/bag", f"--dataset.root={dataset}", some)
        run("cache", "latentsafe", "cache", "--encoder=efficientnet_lite0", *source, f"--output_dir={work}/{n}")
    of_cache = ("--dataset.repo_id=me/bag", f"--dataset.root={cache}")
    for n in STEPS:
        shutil.rmtree(work / "wm", ignore_errors=True)
        how = (f"--steps={n}", f"--save_freq={n}", f"--output_dir={work}/wm", f"--policy.frame_cache={cache}")
        run("world model", "lerobot-train", "--config_path=configs/bag_gru.yaml", *of_cache, *how)
    trained = f"--policy.path={work}/wm/checkpoints/last/pretrained_model"
    run("margin", "latentsafe", "train-margin", trained, *of_cache, f"--output_dir={work}/margin")
    for n in CRITIC_STEPS:
        how = (f"--policy.path={work}/margin", f"--steps={n}", f"--output_dir={work}/filter_{n}")
        run("reachability", "latentsafe", "train-reachability", *how, *of_cache)
    return timed


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
    rounds: list[dict[str, dict]] = []
    for _ in range(arguments.rounds):
        rounds.append({})
        for name, checkout in checkouts.items():
            with TemporaryDirectory() as folder:
                timed = seconds_of_steps(checkout, dataset, Path(folder))
            minutes = at_full_size(timed, checkout, arguments.frames, frames)
            rounds[-1][name] = {"seconds": timed, "minutes": minutes}
            print(name, {step: round(value, 1) for step, value in minutes.items()}, flush=True)
    ratios = [row["now"]["minutes"]["all"] / row["before"]["minutes"]["all"] for row in rounds]
    print("now, against before:", ratios)
    minutes = sum(sum(seconds) for row in rounds for of in row.values() for seconds in of["seconds"].values()) / 60
    settings = {
        "frames": arguments.frames,
        "sizes": {"cache": frames, "world model": STEPS, "reachability": CRITIC_STEPS},
    }
    write_json(arguments.output, {"rounds": rounds, "now_over_before": ratios, **settings, **provenance([0], minutes)})


if __name__ == "__main__":
    main()
