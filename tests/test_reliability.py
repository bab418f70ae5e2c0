"""docs/reliability.md says what the tests of faults say, and every known fault has a test."""

import importlib.util
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
SPEC = importlib.util.spec_from_file_location("reliability", REPOSITORY / "scripts" / "reliability.py")
reliability = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(reliability)

KNOWN = """
    S04 S05 S11 S12 S14 S15 S18b S18d S18g S18i S19 S20 S21 S28 S29 S38 S39 S40 S42 S49 S50 S52 S54 S55b S57b S57c S58
    S60 S63 S64 S65 S67 S69 S70
    B04 B05 B06 B08 B11 B12 B13 B15 B17 B18 B20 B21
    R02 R05 R06 R07 R10 R11 R13 R14 R15 R16 R25 R28 R29 R30 R31 R33 R34 R35 R37 R40 R43b R44 R45 R46 R47
    F01 F03 F04 F05 F06b F09 F10 F11 F15 F16
    C07 C09 C13 C14 C16 C17 C21 C29 C30 C31 C39 C40 C42 C44 C45 C48 C49 C50
    H02 H04 H15
    L16 L17 M03 M05 M06 M16 M20 M21 M29 M31 M33 M34 M38 M39
    K03 K04 K06 K11 K14 K21 K22 K24 K31 K32 K36 K37 D01 D02 D03 D04 D05 D06 P03
    X04 X05 X06 X07 A04 N04 N05 N07 N08
"""
"""Numbers of faults that once did not end well."""


def rows(text):
    """Lines of the page's tables."""
    return {line for line in text.splitlines() if line.startswith("| ") and "What is injected" not in line}


def test_the_page_says_what_the_tests_say(request):
    collected = {fault for item in request.session.items for fault in reliability.faults_of(item)}
    said, page = rows(reliability.page(collected)), rows(reliability.PAGE.read_text())
    assert said <= page, "run scripts/reliability.py"
    files = {item.path.name for item in request.session.items}
    if files == {file.name for file in (REPOSITORY / "tests").glob("test_*.py")}:  # all tests are here
        assert reliability.page(collected) == reliability.PAGE.read_text(), "run scripts/reliability.py"


def test_every_known_fault_is_on_the_page():
    page = reliability.PAGE.read_text()
    assert [number for number in KNOWN.split() if f"| {number} |" not in page] == []


def test_a_page_has_each_fault_once_in_its_section():
    faults = [("S20", "no state", "refused"), ("S4", "a cap", "it stays"), ("S40", "late", "it stays")]
    text = reliability.page({reliability.Fault(*fault) for fault in faults})
    seen, time = text.index("## What robots show"), text.index("## Time")
    assert seen < text.index("| S4 | A cap | It stays |") < text.index("| S20 |") < time < text.index("| S40 |")
    with pytest.raises(ValueError, match=r"no section of docs/reliability.md takes Z1"):
        reliability.page({reliability.Fault("Z1", "a", "b")})
