#!/usr/bin/env python
"""Tries ten thousand random observations, actions, base policies and settings on small filters.

    scripts/fuzz.py --examples=10000 --seed=0

Runs tests/test_fuzz.py with other examples than the test suite's, and writes results/reliability/fuzz.json: how many
were tried, what came of them, and how many ended as they must not: something unusable that passed, or an error that
does not say what is wrong.
"""

import argparse
import sys
import time
from pathlib import Path

import pytest
from hypothesis import settings

from lerobot_latentsafe.evaluation.statistics import provenance, write_json

TESTS = Path(__file__).parents[1] / "tests"
PARTS = 4
"""Tests among which the examples are divided."""


class Outcomes:
    """A plugin of pytest that keeps what the examples came to, and which tests failed."""

    def __init__(self) -> None:
        self.failed: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note a failure."""
        if report.failed:
            self.failed.append(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        """Read what the tests counted."""
        counted = sys.modules.get("test_fuzz")
        self.counts = dict(counted.OUTCOMES.most_common()) if counted else {}


def main() -> int:
    """The command line; 1 where an example ended as it must not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("results/reliability/fuzz.json"))
    arguments = parser.parse_args()
    settings.register_profile("many", max_examples=-(-arguments.examples // PARTS), database=None)
    outcomes, began = Outcomes(), time.monotonic()
    options = ["--hypothesis-profile=many", f"--hypothesis-seed={arguments.seed}", "-p", "no:cacheprovider"]
    pytest.main([str(TESTS / "test_fuzz.py"), f"--rootdir={TESTS.parent}", *options], plugins=[outcomes])
    result = {
        "examples": arguments.examples,
        "failed": outcomes.failed,
        "outcomes": outcomes.counts,
        "minutes": round((time.monotonic() - began) / 60, 2),
    }
    write_json(arguments.output, {**result, **provenance(seeds=[arguments.seed])})
    return int(bool(outcomes.failed))


if __name__ == "__main__":
    sys.exit(main())
