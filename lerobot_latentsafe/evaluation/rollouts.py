"""Numbers every evaluation reports: intervals, confusion tables, and where they came from."""

import json
import os
import platform
import subprocess
import sys
import time
from datetime import date
from pathlib import Path

import numpy as np

_STARTED = time.process_time()


def wilson(k: int, n: int, confidence: float = 0.95) -> dict[str, float]:
    """Wilson score interval of a share k / n: {k, n, low, high}."""
    from scipy.stats import binomtest

    if n == 0:
        raise ValueError("no rollouts: a share of nothing has no interval")
    interval = binomtest(int(k), int(n)).proportion_ci(confidence, method="wilson")
    return {"k": int(k), "n": int(n), "low": float(interval.low), "high": float(interval.high)}


def mcnemar(before: np.ndarray, after: np.ndarray) -> float:
    """Exact McNemar test of paired outcomes, bool (N,) each: the p-value of both being as frequent."""
    from scipy.stats import binomtest

    lost, gained = int((before & ~after).sum()), int((~before & after).sum())
    return float(binomtest(gained, lost + gained).pvalue) if lost + gained else 1.0


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
    head = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True
    )
    minutes = (time.process_time() - _STARTED) / 60 if cpu_minutes is None else cpu_minutes
    return {
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "commit": head.stdout.strip() or "unknown",
        "seeds": seeds,
        "cpu_minutes": round(minutes, 2),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "date": date.today().isoformat(),
    }


def write_json(path: str | Path, content: dict) -> None:
    """Write results, making folders as needed."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=2) + "\n")
