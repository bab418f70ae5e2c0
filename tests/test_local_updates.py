"""The study of local updates refuses what is no demonstration before any work."""

import runpy
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "local_updates.py"


@pytest.mark.parametrize(
    ("holds", "lacks"),
    [
        ([], "metrics.json, states.npy, random_cache, margin"),
        (["metrics.json", "states.npy", "margin"], "random_cache"),
    ],
)
def test_a_folder_that_is_no_demonstration_is_refused(holds, lacks, tmp_path, monkeypatch, capsys):
    for name in holds:
        (tmp_path / name).touch()
    monkeypatch.setattr(sys, "argv", [SCRIPT.name, "--demos", str(tmp_path)])
    with pytest.raises(SystemExit):
        runpy.run_path(str(SCRIPT), run_name="__main__")
    assert f"{tmp_path}, which lacks {lacks}; expected folders of scripts/demo.py" in capsys.readouterr().err
