"""What the demonstrations share: commands run one by one, each with a log and a line on the screen."""

import os
import runpy
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import psutil
import torch

from lerobot_latentsafe.reports import html

SIDE_BY_SIDE = "bare | shielded; orange: the filter acts"
NO_GUARANTEE = "A learned filter is not a certified safety device: it carries no guarantee."
MIXED_PRECISION = ("env", "ACCELERATE_MIXED_PRECISION=bf16")
"""Before lerobot-train: large products in 16 bits, as `accelerate launch --mixed_precision=bf16` would have them."""
ENVIRONMENT = {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "TQDM_DISABLE": "1", "DIFFUSERS_VERBOSITY": "error"}
STARTING = "starting Python and LeRobot, once"


class Demo:
    """Runs commands of this Python's environment, with their output in a log each and one line a step on the screen.

    Each has a process of its own, which is forked from one that has imported what all of them need.

    Args:
        out: folder, new, for logs and whatever the commands write.
        modules: what they need. None of them may have drawn: MuJoCo does not draw in a process that was forked then.
        usual: step -> minutes of CPU time that it usually takes, for the progress bar.

    Attributes:
        minutes: step -> minutes of CPU time that it took.
    """

    def __init__(self, out: Path, modules: Sequence[str] = (), usual: dict[str, float] | None = None):
        self.out, self.started, self.usual = out, time.time(), usual or {}
        self.minutes: dict[str, float] = {}
        (out / "logs").mkdir(parents=True)
        os.environ.update(ENVIRONMENT)
        self.context = get_context("forkserver")
        self.context.set_forkserver_preload(list(modules))

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.time() - self.started

    def run(self, what: str, *command: str) -> None:
        """Run a command, such as `latentsafe cache ...`, to its end; what is before a colon names its log.

        Raises:
            SystemExit: it failed; with the end of its output.
        """
        step = what.split(":")[0]
        log = self.out / "logs" / f"{step.replace(' ', '_')}.log"
        log.touch()
        self.say(what)
        answer = self._asked(run_command, log, *command)
        self.minutes[step] = self.minutes.get(step, 0.0) + (answer or 0.0)
        if answer is None:
            tail = "\n".join(log.read_text().splitlines()[-15:])
            raise SystemExit(f"demo: '{what}' failed; the end of {log}:\n{tail}")

    def say(self, what: str) -> None:
        """Print a line, after the time and how far the demonstration is."""
        done, all_steps = (sum(self.usual.get(step, 0.0) for step in steps) for steps in (self.minutes, self.usual))
        bar = f" {progress_bar(done / all_steps)}" if all_steps else ""
        print(f"[{self.seconds:4.0f} s]{bar} {what}", flush=True)

    def finish(self) -> None:
        """Count the time that starting took."""
        self.minutes[STARTING] = (self._asked(parent_minutes) or 0.0) + _minutes()

    def _asked(self, function: Callable[..., float | None], *arguments: object) -> float | None:
        """What a function answers in a process of its own; None if that process died."""
        answer, asking = self.context.Pipe(duplex=False)
        process = self.context.Process(target=_answer, args=(asking, function, *arguments))
        process.start()
        asking.close()
        try:
            return answer.recv()
        except EOFError:
            return None
        finally:
            process.join()


def _answer(asking: Connection, function: Callable[..., float | None], *arguments: object) -> None:
    asking.send(function(*arguments))


def run_command(log: Path, *command: str) -> float | None:
    """Run a command in this process, which it has for itself; its output is added to a log.

    Returns:
        The minutes of CPU time that it took; None if it failed.
    """
    with log.open("a") as stream:
        for descriptor in (1, 2):
            os.dup2(stream.fileno(), descriptor)
    print("$", *command, flush=True)
    succeeded = False
    try:
        _run(*command)
        succeeded = True
    except SystemExit as stopped:
        succeeded = stopped.code in (None, 0)
        print("" if succeeded else stopped.code)
    except BaseException:  # whatever it is, the log holds it
        traceback.print_exc()
    sys.stdout.flush()
    return _minutes() if succeeded else None


def _run(program: str, *options: str) -> None:
    """What a shell would start: a script, or an installed command, with a variable of its environment before it."""
    if program == "python":
        sys.argv = list(options)
        runpy.run_path(options[0], run_name="__main__")
    elif program == "env":
        setting, *command = options
        name, _, value = setting.partition("=")
        os.environ[name] = value
        _run(*command)
    else:
        sys.argv = [program, *options]
        (entry,) = entry_points(group="console_scripts", name=program)
        entry.load()()


def in_16_bits() -> tuple[str, ...]:
    """What to put before a training command where the processor multiplies 16-bit numbers faster than 32-bit ones."""
    able = torch.cpu.get_capabilities()
    return MIXED_PRECISION if able.get("avx512_bf16") or able.get("amx_bf16") else ()


def parent_minutes() -> float:
    """CPU time of the process that this one was forked from."""
    used = psutil.Process(os.getppid()).cpu_times()
    return (used.user + used.system) / 60


def _minutes() -> float:
    """CPU time of this process, and of those that it started and that have ended."""
    return sum(os.times()[:4]) / 60


def progress_bar(share: float, width: int = 20) -> str:
    """`[#####...............]  25%` of a share."""
    return f"[{'#' * round(share * width):.<{width}}] {share:4.0%}"


def durations(seconds: float, minutes: dict[str, float]) -> dict[str, float | dict]:
    """What metrics.json holds of the time it took: on the clock, and of the processor."""
    spent = {step: round(minutes[step], 2) for step in minutes}
    return {"minutes": round(seconds / 60, 1), "cpu_minutes": round(sum(minutes.values()), 1), "cpu_minutes_of": spent}


def told(out: Path, metrics: dict) -> str:
    """The last line on the screen."""
    took = f"{metrics['minutes']} minutes, {metrics['cpu_minutes']} of CPU time"
    return f"{took}. Open {out / 'report.html'}; numbers in {out / 'metrics.json'}"


def where_the_minutes_went(minutes: dict[str, float]) -> list[str]:
    """The part of a report that says which step took how many minutes of CPU time."""
    rows = [[step, f"{spent:.1f}"] for step, spent in sorted(minutes.items(), key=lambda entry: -entry[1])]
    total = ["all together", f"{sum(minutes.values()):.1f}"]
    return [html.heading("Where the minutes went"), html.table(["step", "minutes of CPU time"], [*rows, total])]
