"""Long verbs, killed at random moments and started again: do they end as if they had never been killed?

Every run is a process of its own, forked from one that has imported all, so that a kill comes while it works. SIGKILL
goes to the process and to all that it has started.
"""

import json
import os
import re
import shutil
import signal
import sys
import time
import traceback
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from lerobot_latentsafe.collection import dubins, franka, so101
from lerobot_latentsafe.evaluation.statistics import provenance
from lerobot_latentsafe.experiments.blocks import dreamer_training  # noqa: F401
from lerobot_latentsafe.experiments.kills.courses import Course, LeRobotTraining, Run
from lerobot_latentsafe.experiments.kills.files import differences, left_by
from lerobot_latentsafe.experiments.kills.verbs import (
    CAR,
    DEMONSTRATIONS,
    FILTER,
    MODEL,
    TRAIN,
    VERBS,
    Verb,
    data,
)
from lerobot_latentsafe.franka.scenes import SCENES
from lerobot_latentsafe.labeling.store import LabelStore

LONGEST_S = 600
"""A run that takes longer hangs."""


# -- a process that is killed ---


def shrink() -> None:
    """Make the scenes small and the parts of a recording few episodes, in this process."""
    torch.set_num_threads(1)
    os.environ["TQDM_DISABLE"] = "1"
    dubins.EPISODES_A_PART, franka.EPISODES_A_PART, so101.EPISODES_A_PART = 3, 1, 1
    so101.EPISODE_SECONDS = 1.0
    SCENES["blocks"] = replace(SCENES["blocks"], episode_seconds=12 / SCENES["blocks"].fps)
    # A data loader draws from torch's generator when it is made, so a resumed lerobot-train samples other latents.
    torch.randn_like = torch.zeros_like


def start(course: Course, words: list[str], log: Path, run: Run) -> int:
    """The number of a new process, leader of its group, that runs a command."""
    log.write_text("")  # not in the new process: who waits for what it prints would find what the last one printed
    process = os.fork()
    if process:
        return process
    status = 1
    try:
        os.setsid()
        descriptor = os.open(log, os.O_WRONLY | os.O_APPEND)
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
        shrink()
        course.run(words, run)
        status = 0
    except SystemExit as e:
        print(e, file=sys.stderr)
        status = 0 if e.code in (0, None) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def ended(process: int, within_s: float) -> int | None:
    """The status of a process that ends in time; None: it was killed, with its group."""
    limit = time.monotonic() + within_s
    while time.monotonic() < limit:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    with suppress(ProcessLookupError):
        os.killpg(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return None


def went(course: Course, words: list[str], log: Path, run: Run, within_s: float = LONGEST_S) -> int | None:
    """Run a command in a process; its status, or None if it was killed after that time."""
    process = start(course, words, log, run)
    with course.beside(process, log):
        return ended(process, within_s)


def finished(course: Course, words: list[str], log: Path, run: Run) -> float:
    """Run a command to its end; the seconds that it took.

    Raises:
        RuntimeError: it failed, with what it said.
    """
    began = time.monotonic()
    status = went(course, words, log, run)
    if status != 0:
        raise RuntimeError(f"{' '.join(words)}: status {status}: {log.read_text()[-2000:]}")
    return time.monotonic() - began


# -- the measurement ---


def make(made: Path, run: Run) -> None:
    """What the verbs start from: a dataset with labels, its cache, a world model, a filter and a policy."""
    made.mkdir(parents=True)
    collect = "collect --dataset.num_episodes=24"
    for verb in (
        Verb(f"{collect} --source=random {data(CAR)}"),
        Verb(f"{collect} --source=reckless {data(DEMONSTRATIONS)}"),
        Verb(f"cache {data(CAR)} --output_dir={{made}}/car_cache"),
        Verb(f"{TRAIN} --steps=4 --save_freq=4", course=LeRobotTraining),
    ):
        finished(verb.course(made), verb.words(made, made), made / "log.txt", run)
    shutil.copytree(made / "out" / "checkpoints" / "last" / "pretrained_model", made / MODEL)
    store = LabelStore(made / CAR, f"me/{CAR}", ["crashed"])
    for episode in range(len(store)):
        store.label("crashed", episode, episode % 5, "somebody")
    store.close()
    verb = Verb(f"train-reachability --policy.path={{made}}/{MODEL} {data('car_cache')} --output_dir={{made}}/{FILTER}")
    finished(verb.course(made), verb.words(made, made), made / "log.txt", run)


def kills(verb: Verb, made: Path, folder: Path, n: int, rng: np.random.Generator, run: Run) -> dict:
    """Kill a verb n times at a random moment of its course, start it again each time, and compare.

    Returns:
        seconds of an undisturbed run, kills that came in time, runs that ended as that one, and what differs, was lost
        or was said in the others.
    """
    log = folder / "log.txt"
    for name in ("first", "whole"):  # what is read at first use makes the first run slower than those that are killed
        whole = _begun(verb, made, folder / name)
        with verb.course(whole) as course:
            seconds = finished(course, verb.words(made, whole), log, run)
    expected, equal, in_time, wrong = left_by(whole / verb.product), 0, 0, []
    for trial in range(n):
        out = _begun(verb, made, folder / f"killed_{trial}")
        words, moment = verb.words(made, out), rng.uniform(0.05, 0.95) * seconds
        with verb.course(out) as course:
            in_time += went(course, words, log, run, moment) is None
            lost = course.lost(expected)
            status = went(course, course.again(words), log, run)
        found, left = differences(left_by(out / verb.product), expected), _left_over(out)
        # A run that had come to its end is told that it has.
        if (status == 0 or "exists already" in log.read_text()) and not (found or lost or left):
            equal += 1
            shutil.rmtree(out)
        else:
            wrong.append({"at_s": moment, "status": status, "differs": found[:5], "lost": lost[:5], "left": left,
                          "said": log.read_text()[-300:]})  # fmt: skip
    return {"seconds": round(seconds, 2), "kills": n, "in_time": in_time, "equal": equal, "wrong": wrong}


def _begun(verb: Verb, made: Path, out: Path) -> Path:
    """The folder of a new run."""
    out.mkdir(parents=True)
    if verb.within:
        shutil.copytree(made / verb.within, out / "out")
    return out


def _left_over(out: Path) -> list[str]:
    """What lies where nobody asked for it."""
    return sorted(p.name for p in out.iterdir() if p.name != "out")


def kill_verbs(folder: Path, names: list[str], n: int, seed: int, run: Run) -> dict[str, dict]:
    """The table: verb -> see `kills`, and the commit of the code that was killed.

    What is done already is read from a file, so that this goes on after a kill.
    """
    made, rows = folder / "made", {}
    if not (made / "done").exists():
        shutil.rmtree(made, ignore_errors=True)
        make(made, run)
        (made / "done").touch()
    for name in names:
        note = folder / f"{re.sub('[^a-z0-9]+', '_', name.lower())}.json"
        if not note.exists():
            work = folder / note.stem
            shutil.rmtree(work, ignore_errors=True)
            rng, commit = np.random.default_rng([seed, *name.encode()]), provenance(seeds=[seed])["commit"]
            note.write_text(json.dumps({**kills(VERBS[name], made, work, n, rng, run), "commit": commit}))
        rows[name] = json.loads(note.read_text())
        print(name, {key: value for key, value in rows[name].items() if key != "wrong"}, flush=True)
    return rows


def with_rows(known: dict, rows: dict[str, dict]) -> dict[str, dict]:
    """A table in which these rows take the place of those that a results file has, in the order of the verbs."""
    kept = {name: {"commit": known["commit"], **row} for name, row in known.get("verbs", {}).items()}
    table = {**kept, **rows}
    return {name: table[name] for name in VERBS if name in table}
