"""What other machines than this one ask for: a lock that they can install."""

import re
from pathlib import Path

LOCK = Path(__file__).parents[1] / "requirements.lock"


def test_the_lock_holds_names_versions_and_markers_and_says_what_is_for_linux_alone():
    lines = LOCK.read_text().splitlines()
    assert [line for line in lines if not re.fullmatch(r"[a-z0-9-]+==[\w.]+( ; sys_platform [!=]= '\w+')?", line)] == []
    only_linux = [line for line in lines if re.match("nvidia-|cuda-|triton", line)]
    assert only_linux and all(line.endswith(" ; sys_platform == 'linux'") for line in only_linux)
