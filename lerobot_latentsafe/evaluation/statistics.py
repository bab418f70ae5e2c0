"""Numbers every evaluation reports: intervals, confusion tables, and where they came from."""

import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from datetime import date
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from lerobot_latentsafe.runtime.files import locked_folder, replacing

_STARTED = time.process_time()


def wilson(k: int, n: int, confidence: float = 0.95) -> dict[str, float]:
    """Wilson score interval of a share k / n: {k, n, low, high}."""
    from scipy.stats import binomtest

    if n == 0:
        raise ValueError("no rollouts: a share of nothing has no interval")
    interval = binomtest(int(k), int(n)).proportion_ci(confidence, method="wilson")
    return {"k": int(k), "n": int(n), "low": float(interval.low), "high": float(interval.high)}


def paired_p_value(first: np.ndarray, second: np.ndarray) -> float:
    """Exact McNemar test on pairs of outcomes, bool (N,) each: how likely so lopsided a difference is by chance."""
    from scipy.stats import binomtest

    first, second = np.asarray(first, bool), np.asarray(second, bool)
    gone, come = int((first & ~second).sum()), int((~first & second).sum())
    return float(binomtest(come, gone + come).pvalue) if gone + come else 1.0


def confusion(predicted_safe: np.ndarray, truly_safe: np.ndarray) -> dict[str, float]:
    """Agreement of a monitor's verdicts with the truth, bool (N,) each.

    Returns:
        The four cells as shares (Table 1), F1 with either class positive, balanced accuracy, the share of truly
        unsafe states called safe (false_safe_rate) and of truly safe ones called unsafe (false_unsafe_rate).
    """
    safe, truth = np.asarray(predicted_safe, bool), np.asarray(truly_safe, bool)
    if safe.shape != truth.shape or not len(safe):
        raise ValueError(f"verdicts {safe.shape} and truth {truth.shape} must be equally long and not empty")
    true_safe, false_safe = (safe & truth).mean(), (safe & ~truth).mean()
    false_unsafe, true_unsafe = (~safe & truth).mean(), (~safe & ~truth).mean()
    ratio = lambda a, b: float(a / b) if b > 0 else float("nan")  # noqa: E731
    false_safe_rate = ratio(false_safe, false_safe + true_unsafe)
    false_unsafe_rate = ratio(false_unsafe, false_unsafe + true_safe)
    return {
        "true_safe": float(true_safe),
        "false_safe": float(false_safe),
        "false_unsafe": float(false_unsafe),
        "true_unsafe": float(true_unsafe),
        "f1_safe": ratio(2 * true_safe, 2 * true_safe + false_safe + false_unsafe),
        "f1_unsafe": ratio(2 * true_unsafe, 2 * true_unsafe + false_safe + false_unsafe),
        "balanced_accuracy": 1 - (false_safe_rate + false_unsafe_rate) / 2,
        "false_safe_rate": false_safe_rate,
        "false_unsafe_rate": false_unsafe_rate,
        "n": len(safe),
    }


def provenance(seeds: list[int], cpu_minutes: float | None = None) -> dict:
    """What every results file carries: command, commit, seeds, CPU minutes, machine, date."""
    minutes = (time.process_time() - _STARTED) / 60 if cpu_minutes is None else cpu_minutes
    return {
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "commit": _commit(),
        "seeds": seeds,
        "cpu_minutes": round(minutes, 2),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "date": date.today().isoformat(),
    }


def write_rows(path: Path, summary: dict[str, dict], made_by: dict, **more: object) -> None:
    """Write the rows of a table, where other rows that the file held stay; `runs` says how each row was made.

    Args:
        made_by: provenance of these rows; of the file, too, if it is new.
        more: of the file.
    """
    before = json.loads(path.read_text()) if path.exists() else made_by
    rows = {
        name: {**before.get(name, {}), **new}
        for name, new in (("summary", summary), ("runs", dict.fromkeys(summary, made_by)))
    }
    write_json(path, {**before, **rows, **more})


def _commit() -> str:
    """Of the working tree this package lies in; unknown where there is none, or no git."""
    if not shutil.which("git"):
        return "unknown"
    command = ["git", "rev-parse", "--short", "HEAD"]
    head = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True)
    return head.stdout.strip() or "unknown"


def write_json(path: str | Path, content: dict) -> None:
    """Write results, lists of numbers on one line and what is not a number as null, making folders as needed."""
    content = json.loads(json.dumps(content), parse_constant=lambda name: None if name == "NaN" else float(name))
    text = json.dumps(content, indent=2)
    text = re.sub(r'\[\n([^\[\]{}":]*)\]', lambda numbers: f"[{' '.join(numbers[1].split())}]", text)
    with replacing(path) as partial:
        partial.write_text(text + "\n")


def run_resumable(path: Path, jobs: list[dict], run: Callable[[dict], dict], workers: int = 1) -> list[dict]:
    """Rows of all jobs, in their order; each is kept in a file as soon as it ends, so that a killed run goes on.

    Args:
        path: of a JSONL file, a job and its row a line; jobs that it holds are not run again.
        jobs: JSON-able, and all that a row depends on.
        run: job -> JSON-able row; a function of a module, if there are several workers.
        workers: processes.

    Returns:
        What `run` returned, and cpu_s, its CPU seconds.
    """
    with ExitStack() as stack:
        stack.enter_context(locked_folder(path))
        rows = dict(_kept_rows(path))
        missing = [job for job in jobs if _key(job) not in rows]
        stream = stack.enter_context(path.open("a"))
        apply = stack.enter_context(get_context("spawn").Pool(workers)).imap_unordered if workers > 1 else map
        for done, (job, row) in enumerate(apply(partial(_ran, run), missing), 1):
            stream.write(json.dumps({"job": job, "row": row}) + "\n")
            stream.flush()
            os.fsync(stream.fileno())
            rows[_key(job)] = row
            print(f"\r{done} of {len(missing)} episodes", end="\n" if done == len(missing) else "", flush=True)
    return [rows[_key(job)] for job in jobs]


def _ran(run: Callable[[dict], dict], job: dict) -> tuple[dict, dict]:
    began = time.process_time()
    row = run(job)
    return job, {**row, "cpu_s": round(time.process_time() - began, 3)}


def _key(job: dict) -> str:
    return json.dumps(job, sort_keys=True)


def _kept_rows(path: Path) -> Iterator[tuple[str, dict]]:
    """The rows of a file; its last line may be torn, and is then cut off."""
    if not path.exists():
        return
    *lines, torn = path.read_text().split("\n")
    if torn:
        os.truncate(path, path.stat().st_size - len(torn.encode()))
    for line in lines:
        entry = json.loads(line)
        yield _key(entry["job"]), entry["row"]
