"""Verbs that are cut into tasks: what they make equals what one process makes, whatever was killed on the way."""

import json
import os
import signal
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from lerobot_latentsafe import LatentSafeDubinsEnv
from lerobot_latentsafe.cli import main
from lerobot_latentsafe.evaluation.rollouts import compare
from lerobot_latentsafe.evaluation.shield_tasks import CutComparison
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.runtime.files import OtherRunError
from lerobot_latentsafe.runtime.tasks import Tasks, TasksFailedError

pytest.importorskip("datatrove")


def die_once(mark):
    """Be killed, if the file is there; it is gone then."""
    if mark.exists():
        mark.unlink()
        os.kill(os.getpid(), signal.SIGKILL)


# -- eval-shield ---

N, AT_ONCE = 10, 3


@dataclass(frozen=True)
class Deadly(CutComparison):
    """The worker of the third batch is killed, once."""

    def do(self, policy, numbers):
        for number in numbers:
            if number == 2 * AT_ONCE:
                die_once(self.output.with_name("mark"))
            yield from super().do(policy, [number])


def keep(output, result, law, made):
    output.write_text(json.dumps({name: result[name] for name in ("bare", "shielded", "reasons")}))


def comparison(tiny_filter, tiny_diffusion, folder, **changes):
    given = {
        "output": folder / "row.json", "load": partial(load_filter, tiny_filter, base_policy=tiny_diffusion),
        "env": LatentSafeDubinsEnv(variant="discrete", episode_length=6), "n_episodes": N, "seed": 4,
        "batch_size": AT_ONCE, "n_videos": 2, "tell": partial(keep, folder / "row.json"), "made": {},
    }  # fmt: skip
    return Deadly(**{**given, **changes})


@pytest.fixture
def comparing(tiny_filter, tiny_diffusion, tmp_path):
    return partial(comparison, tiny_filter, tiny_diffusion, tmp_path)


@pytest.fixture(scope="module")
def alone(tiny_filter, tiny_diffusion):
    """What one process finds."""
    work = comparison(tiny_filter, tiny_diffusion, Path())
    return compare(work.load(), work.env, N, work.seed, work.n_videos, batch_size=AT_ONCE)


def require_equal(result, alone):
    assert all(result[name] == alone[name] for name in ("bare", "shielded", "reasons", "violation_p_value"))
    for name, runs in alone["episodes"].items():
        found = result["episodes"][name]
        assert found.traces == runs.traces and len(found.frames) == 2
        assert all(map(np.array_equal, found.frames, runs.frames))


@pytest.mark.fault("K53", "a worker of eval-shield is killed", "The same command runs the episodes that are missing")
def test_four_tasks_of_two_workers_one_killed_equal_one_process(comparing, alone, tmp_path):
    (tmp_path / "mark").touch()
    with pytest.raises(TasksFailedError, match="a worker was killed"):
        comparing().run(Tasks(4, workers=2))
    kept = {file: file.stat().st_mtime_ns for file in tmp_path.glob("row.json.parts/*.pickle")}
    assert len(kept) < 4 and not (tmp_path / "row.json").exists()
    require_equal(comparing().run(Tasks(4)), alone)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["row.json"]


def test_a_node_with_another_filter_says_so(comparing, tiny_continuous_filter, tiny_diffusion, monkeypatch):
    work = comparing(n_episodes=2)
    monkeypatch.setattr(Deadly, "end", lambda self: True)
    work.run(Tasks(1))
    (work.folder / "000000.pickle").unlink()
    other = partial(load_filter, tiny_continuous_filter, base_policy=tiny_diffusion)
    with pytest.raises(OtherRunError, match=r"sees something else than the process that began .*\(filter\)"):
        comparing(n_episodes=2, load=other).work(1, 0)


def test_the_command_shields_in_tasks(tiny_filter, tiny_diffusion, tmp_path, capsys):
    given = [
        f"--policy.path={tiny_filter}", f"--base_policy_path={tiny_diffusion}", "--env.type=latentsafe_dubins",
        "--env.variant=discrete", "--env.episode_length=4", "--n_episodes=3", "--batch_size=2",
    ]  # fmt: skip
    rows = []
    for name, tasks in (("one", []), ("two", ["--tasks.number=2", f"--figure={tmp_path / 'two.png'}"])):
        main(["eval-shield", *given, *tasks, f"--json={tmp_path / name}"])
        rows.append(json.loads((tmp_path / name).read_text()))
    assert all(rows[0][name] == rows[1][name] for name in rows[0] if name not in ("cpu_minutes", "command"))
    assert "difference in violations" in capsys.readouterr().out and (tmp_path / "two.png").exists()
    for options, said in (
        (["--tasks.number=2"], "--tasks.number needs --json"),
        (["--tasks.number=3", f"--json={tmp_path / 'x'}"], "is 3, and there are 2 times --batch_size=2 episodes"),
        (["--batch_size=0"], "--batch_size is 0"),
    ):
        with pytest.raises(SystemExit, match=said):
            main(["eval-shield", *given, *options])
