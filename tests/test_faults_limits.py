"""What no filter can know or prevent is documented where a user looks."""

from pathlib import Path

import faulty
import pytest
from faulty import row

from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.runtime.locations import CheckpointError

DOCS = Path(__file__).parents[1] / "docs"
SEAL, ARM, LIMITS = ("deploying.md", "Deploying"), ("franka.md", "The real Franka"), ("limits.md", "Known limits")
LIMITED = [
    ("C29", "somebody replaces the weights and computes the seal anew", SEAL, "It is no signature."),
    ("F16", "the process is killed while the arm moves", ARM, "The robot's own communication check stops the arm"),
    (
        "B21",
        "its actions are in another order, which nobody knows",
        LIMITS,
        "Names of a base policy's numbers are known",
    ),
    ("B13", "a GPU hangs, on which the filter runs", LIMITS, "A GPU that hangs holds the robot's loop up."),
]


@pytest.mark.parametrize(
    ("page", "words"),
    [row(number, what, page[0], words, outcome=f"See [{page[1]}]({page[0]})") for number, what, page, words in LIMITED],
)
def test_a_limit_is_documented(page, words):
    assert words in (DOCS / page).read_text()


@faulty.fault(
    "C50", "the present folder holds something else named like a committed filter", "Refused (`CheckpointError`)"
)
def test_a_folder_that_shadows_a_committed_filter_is_refused(tmp_path, monkeypatch):
    (tmp_path / "dubins").mkdir()
    (tmp_path / "dubins" / "notes.txt").write_text("of a dinner")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CheckpointError, match="dubins"):
        load_filter("dubins")
