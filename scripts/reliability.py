#!/usr/bin/env python3
"""Writes docs/reliability.md: which faults are injected into this version, and what comes of each.

    scripts/reliability.py            run the tests of all faults, and write the page of those that pass
    scripts/reliability.py --check    run nothing; exit 1 where the page is not what the tests say

A test says what it shows by a mark, which is a row of the page:

    @pytest.mark.fault("S18b", "a joint reads 1,000 rad", "The robot stays: `OBSERVATION_OUT_OF_RANGE`")
"""

import argparse
import re
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "reliability.md"
TIME = ("S38", "S39", "S40", "S58", "B11", "B12", "B13", "R06", "R07", "R40")
SETTINGS = ("S60", "C16", "C17")
SECTIONS = {
    "What robots show, and what decides": ("S",),
    "Time": TIME,
    "Base policies": ("B",),
    "Shielded robots": ("R", "A"),
    "The real arm": ("F",),
    "Checkpoints, and what is downloaded": ("C", "H"),
    "Labels": ("L", "M"),
    "Killed, a full disk, two at once": ("K", "D", "P"),
    "Cards, pages and reports": ("X",),
    "Settings and numbers": (*SETTINGS, "N"),
}
"""Title -> numbers of its faults, or their first letter; whole numbers go before letters."""
HEAD = """# When something fails

What is broken, late, foreign or hostile never counts as safe, and nothing recorded, labelled or trained is lost.
This page says what becomes of each fault that the tests inject. The test run writes it (`make reliability`): a line
stands here only if its test passes.

"The robot stays" means: it is told to stay where it is, for as long as the fault lasts, and goes on afterwards. A
delta or a velocity is zero, a joint target is the one of before, a gripper keeps its grip. Where staying is not found
safe, the fallback acts. The word in capitals is the reason that the decision gives ([Deploying](deploying.md)).
What no filter can know is in [Known limits](limits.md).
"""


class Fault(NamedTuple):
    """A row of the page.

    Attributes:
        number: of the fault; those of one number are of one kind.
        what: is injected, in words.
        outcome: what a user gets, in words.
    """

    number: str
    what: str
    outcome: str


def faults_of(item: pytest.Item) -> list[Fault]:
    """What a test says that it shows, if it is expected to pass."""
    if item.get_closest_marker("xfail"):
        return []
    return [Fault(*mark.args) for mark in item.iter_markers("fault")]


class Shown:
    """A plugin of pytest that notes which faults were collected, and whose tests did not pass.

    Attributes:
        collected: every fault.
        failed: those of which a test did not pass.
    """

    def __init__(self) -> None:
        self.collected: set[Fault] = set()
        self.failed: set[Fault] = set()

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Note what there is."""
        self._of = {item.nodeid: faults_of(item) for item in session.items}
        self.collected.update(*self._of.values())

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note what failed, or was left out."""
        if not report.passed:
            self.failed.update(self._of[report.nodeid])


def page(faults: set[Fault]) -> str:
    """The page of these faults."""
    of = {fault: _title(fault.number) for fault in faults}
    tables = [_table(title, [fault for fault in faults if of[fault] == title]) for title in SECTIONS]
    return "\n".join([HEAD, *filter(None, tables)])


def _title(number: str) -> str:
    """The section of a fault: the one that names its number, else the one that names its letter."""
    for key in (number, number[0]):
        for title, kinds in SECTIONS.items():
            if key in kinds:
                return title
    raise ValueError(f"no section of docs/reliability.md takes {number}; add its letter to SECTIONS in {__file__}")


def _table(title: str, faults: list[Fault]) -> str:
    rows = sorted(faults, key=lambda fault: (_in_order(fault.number), fault.what, fault.outcome))
    lines = [f"| {fault.number} | {_upper(fault.what)} | {_upper(fault.outcome)} |" for fault in rows]
    return lines and "\n".join([f"## {title}\n", "| | What is injected | What you get |", "|---|---|---|", *lines, ""])


def _in_order(number: str) -> tuple[str, int, str]:
    letter, digits, rest = re.fullmatch(r"([A-Z])(\d+)(\w*)", number).groups()
    return letter, int(digits), rest


def _upper(text: str) -> str:
    word = text.split()[0]
    return text[0].upper() + text[1:] if word.isalpha() else text  # names of files and options stay


def main(argv: list[str] | None = None) -> int:
    """The command line; 1 where a test fails, or the page is another."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="run and write nothing, fail where the page is another")
    check = parser.parse_args(argv).check
    shown = Shown()
    options = ["-m", "fault", "-q", "-p", "no:cacheprovider", f"--rootdir={ROOT}", str(ROOT / "tests")]
    code = pytest.main([*options, "--collect-only", "-qq"] if check else options, plugins=[shown])
    text = page(shown.collected - shown.failed)
    if check:
        same = PAGE.is_file() and PAGE.read_text() == text
        print(
            "" if same else "docs/reliability.md is not what the tests say: run scripts/reliability.py", file=sys.stderr
        )
        return 0 if same else 1
    PAGE.write_text(text)
    print(
        f"{PAGE.name}: {len(shown.collected - shown.failed)} faults; {len(shown.failed)} did not end as their tests say"
    )
    return int(code != pytest.ExitCode.OK)


if __name__ == "__main__":
    sys.exit(main())
