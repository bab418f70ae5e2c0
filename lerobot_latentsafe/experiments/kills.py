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
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import torch
from lerobot.scripts import lerobot_train
from safetensors.torch import load_file

from lerobot_latentsafe.collection import dubins, franka, so101
from lerobot_latentsafe.experiments.blocks import dreamer_training  # noqa: F401
from lerobot_latentsafe.franka.scenes import SCENES
from lerobot_latentsafe.labeling.store import LabelStore

LONGEST_S = 600
"""A run that takes longer hangs."""
CAR, DEMONSTRATIONS, MODEL, FILTER = "car", "demonstrations", "world_model", "filter"
"""Folders of what the verbs start from."""
SMALL = {"type": "rssm", "deterministic": 16, "stochastic": 4, "hidden": 16, "units": 16, "clip_length": 6}
SIZES = [f"world_model.{name}={value}" for name, value in SMALL.items()]
SIZES += ["margin.clips=64", "reachability.critic_hidden=[16]", "reachability.actor_hidden=[16]"]
SIZES += ["reachability.steps=60", "reachability.pool=512", "reachability.horizon=4", "reachability.batch_size=32"]
SIZES += ["reachability.refresh=10"]
OF_LEROBOTS_RUN = ("train_config.json", "rng_state.safetensors")
"""Of a lerobot-train: what was typed, and random numbers, of which a new data loader takes one more."""
Run = Callable[[list[str]], None]
"""The command `latentsafe`, given what is typed after it."""


@dataclass(frozen=True)
class Verb:
    """A verb with options that take seconds, `{made}` and `{out}` for the folder to read from and to write into.

    Attributes:
        typed: verb and options.
        product: what it leaves in `{out}`.
        again: what is typed after a kill, given `{out}`; None: the same.
        within: a dataset of `{made}` that it writes into, of which each run has a copy in `{out}/out`.
    """

    typed: str
    product: str = "out"
    again: Callable[[Path], list[str]] | None = None
    within: str | None = None


def data(name: str) -> str:
    """Options that name a dataset of the folder to read from."""
    return f"--dataset.repo_id=me/{name} --dataset.root={{made}}/{name}"


TRAIN = f"lerobot-train --policy.type=latentsafe --policy.device=cpu --policy.push_to_hub=false {data('car_cache')} "
TRAIN += " ".join(f"--policy.{size}" for size in SIZES)
TRAIN += " --policy.fallback.action_candidates=[[-1.25,1.0],[0.0,1.0],[1.25,1.0]] --log_freq=1 --batch_size=8"
TRAIN += " --num_workers=0 --seed=1 --output_dir={out}/out"
COLLECT = "collect --dataset.repo_id=me/new --dataset.root={out}/out"
DREAMER = (
    "train-dreamer --config_path=configs/blocks_dreamer.yaml --output_dir={out}/out --model.world_model.image_size=16"
)
DREAMER += " --model.world_model.classes=4 --model.world_model.encoder=mlp --policy.behavior.hidden=16"
DREAMER += (
    " --policy.behavior.bins=17 --policy.behavior.horizon=3 --policy.behavior.starts=8 --model.world_model.hidden=16"
)
DREAMER += " --model.world_model.deterministic=16 --model.world_model.clip_length=6 --model.world_model.stochastic=4"
DREAMER += " --demonstrations=4 --pretraining=6 --steps=20 --collect_every=4 --n_envs=2 --batch_size=4 --save_every=3"
DREAMER += " --log_every=1 --cuda_graph=false"


def _resumed_training(out: Path) -> list[str]:
    """LeRobot goes on from its last checkpoint; a run that was killed before its first is one to start anew."""
    checkpoints = out / "out" / "checkpoints"
    last = checkpoints / "last" / "pretrained_model" / "train_config.json"
    if last.exists():
        return ["lerobot-train", f"--config_path={last}", "--resume=true"]
    whole = sorted(checkpoints.glob("0*"))[:-1]  # LeRobot names the last one anew after each
    if whole:
        return ["lerobot-train", f"--config_path={whole[-1]}/pretrained_model/train_config.json", "--resume=true"]
    shutil.rmtree(out / "out", ignore_errors=True)
    return []


VERBS = {
    "collect, car": Verb(f"{COLLECT} --source=random --dataset.num_episodes=9"),
    "collect, Franka": Verb(f"{COLLECT} --source=blocks_demos --dataset.num_episodes=4"),
    "collect, SO-101": Verb(f"{COLLECT} --source=so101_mix --dataset.num_episodes=4"),
    "cache": Verb(f"cache {data(CAR)} --image_size=64 --output_dir={{out}}/out"),
    "lerobot-train": Verb(f"{TRAIN} --steps=8 --save_freq=1", "out/checkpoints", _resumed_training),
    "train-margin": Verb(f"train-margin --policy.path={{made}}/{MODEL} {data('car_cache')} --output_dir={{out}}/out"),
    "train-reachability": Verb(
        f"train-reachability --policy.path={{made}}/{MODEL} {data('car_cache')} --output_dir={{out}}/out --steps=300"
    ),
    "train-dreamer": Verb(DREAMER),
    "calibrate": Verb(f"calibrate --policy.path={{made}}/{FILTER} {data('car_cache')} --output_dir={{out}}/out"),
    "report": Verb(
        f"report --policy.path={{made}}/{FILTER} --env.type=latentsafe_dubins --env.episode_length=8 --n_episodes=2 "
        "--base_policy_path=dubins_diffusion_reckless --output={out}/out/report.html"
    ),
    "auto-label": Verb(
        f"auto-label --dataset.repo_id=me/{DEMONSTRATIONS} --dataset.root={{out}}/out --labeller=dubins_truth "
        "--specification=crashed",
        within=DEMONSTRATIONS,
    ),
    "write-labels": Verb(
        f"write-labels {data(CAR)} --specifications=[crashed] --new_repo_id=me/labelled --output_dir={{out}}/out"
    ),
}


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


def start(words: list[str], log: Path, run: Run) -> int:
    """The number of a new process, leader of its group, that runs a command."""
    process = os.fork()
    if process:
        return process
    status = 1
    try:
        os.setsid()
        descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
        shrink()
        if words[0] == "lerobot-train":
            sys.argv = words
            lerobot_train.main()
        else:
            run(words)
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


def finished(words: list[str], log: Path, run: Run) -> float:
    """Run a command to its end; the seconds that it took.

    Raises:
        RuntimeError: it failed, with what it said.
    """
    began = time.monotonic()
    status = ended(start(words, log, run), LONGEST_S)
    if status != 0:
        raise RuntimeError(f"{' '.join(words)}: status {status}: {log.read_text()[-2000:]}")
    return time.monotonic() - began


# -- what it left ---


def left_by(folder: Path) -> dict[str, object]:
    """All that a verb has left: name of a file -> its content, as far as it does not tell of time and place."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and "last" not in path.parts]
    kept = [path for path in files if path.name not in OF_LEROBOTS_RUN and path.suffix != ".lock"]
    return {path.relative_to(folder).as_posix(): _content(path) for path in kept}


def _content(path: Path) -> object:
    if path.suffix == ".parquet":
        table = pq.read_table(path)
        return table.drop_columns([name for name in table.column_names if name == "labelled_at"]).to_pydict()
    if path.suffix == ".safetensors":
        return {name: (str(t.dtype), t.shape, t.reshape(-1).view(torch.uint8).numpy().tobytes())
                for name, t in load_file(path).items()}  # fmt: skip
    if path.suffix == ".npy":
        return np.load(path).tobytes()
    if path.suffix in (".json", ".jsonl", ".html"):
        text = re.sub(
            r'"(cpu_s|pretrained_path|output_dir|checkpoint_path|resume|config_path|update_s|data_s)": [^,}\n]*',
            "",
            path.read_text(),
        )
        return re.sub(r"Made by .*? at commit .*?<", "", text)
    return path.read_bytes()


def differences(one: dict[str, object], other: dict[str, object]) -> list[str]:
    """Names of files that one has and the other has not, or that are not the same."""
    return sorted(name for name in {*one, *other} if repr(one.get(name)) != repr(other.get(name)))


# -- the measurement ---


def make(made: Path, run: Run) -> None:
    """What the verbs start from: a dataset with labels, its cache, a world model, a filter and a policy."""
    made.mkdir(parents=True)
    places = {"made": made, "out": made}
    for words in (
        f"collect --source=random --dataset.repo_id=me/{CAR} --dataset.root={{made}}/{CAR} --dataset.num_episodes=24",
        f"collect --source=reckless --dataset.repo_id=me/{DEMONSTRATIONS} --dataset.root={{made}}/{DEMONSTRATIONS} "
        "--dataset.num_episodes=24",
        f"cache {data(CAR)} --output_dir={{made}}/car_cache",
        f"{TRAIN} --steps=4 --save_freq=4",
    ):
        finished(words.format(**places).split(), made / "log.txt", run)
    shutil.copytree(made / "out" / "checkpoints" / "last" / "pretrained_model", made / MODEL)
    store = LabelStore(made / CAR, f"me/{CAR}", ["crashed"])
    for episode in range(len(store)):
        store.label("crashed", episode, episode % 5, "somebody")
    store.close()
    words = f"train-reachability --policy.path={{made}}/{MODEL} {data('car_cache')} --output_dir={{made}}/{FILTER}"
    finished(words.format(**places).split(), made / "log.txt", run)


def kills(verb: Verb, made: Path, folder: Path, n: int, rng: np.random.Generator, run: Run) -> dict:
    """Kill a verb n times at a random moment of its course, start it again each time, and compare.

    Returns:
        seconds of an undisturbed run, kills that came in time, runs that ended as that one, and what differs or was
        said in the others.
    """
    log = folder / "log.txt"
    whole = _begun(verb, made, folder / "whole")
    seconds = finished(_typed(verb, made, whole), log, run)
    expected, equal, in_time, wrong = left_by(whole / verb.product), 0, 0, []
    for trial in range(n):
        out = _begun(verb, made, folder / f"killed_{trial}")
        moment = rng.uniform(0.05, 0.95) * seconds
        in_time += ended(start(_typed(verb, made, out), log, run), moment) is None
        words = (verb.again(out) if verb.again else []) or _typed(verb, made, out)
        status = ended(start(words, log, run), LONGEST_S)
        found = differences(left_by(out / verb.product), expected)
        # A run that had come to its end is told that it has.
        if not found and (status == 0 or "exists already" in log.read_text()) and not _left_over(out):
            equal += 1
            shutil.rmtree(out)
        else:
            wrong.append({"at_s": moment, "status": status, "differs": found[:5], "left": _left_over(out),
                          "said": log.read_text()[-300:]})  # fmt: skip
    return {"seconds": round(seconds, 2), "kills": n, "in_time": in_time, "equal": equal, "wrong": wrong}


def _begun(verb: Verb, made: Path, out: Path) -> Path:
    """The folder of a new run."""
    out.mkdir(parents=True)
    if verb.within:
        shutil.copytree(made / verb.within, out / "out")
    return out


def _typed(verb: Verb, made: Path, out: Path) -> list[str]:
    return verb.typed.format(made=made, out=out).split()


def _left_over(out: Path) -> list[str]:
    """What lies where nobody asked for it."""
    return sorted(p.name for p in out.iterdir() if p.name != "out")


def kill_verbs(folder: Path, names: list[str], n: int, seed: int, run: Run) -> dict[str, dict]:
    """The table: verb -> see `kills`; what is done already is read from a file, so that this goes on after a kill."""
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
            rng = np.random.default_rng([seed, *name.encode()])
            note.write_text(json.dumps(kills(VERBS[name], made, work, n, rng, run)))
        rows[name] = json.loads(note.read_text())
        print(name, {key: value for key, value in rows[name].items() if key != "wrong"}, flush=True)
    return rows
