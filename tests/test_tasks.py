"""Work that is cut into tasks: what is done stays, and what fails says why, whoever runs it."""

import os
import subprocess
import sys
import time

import psutil
import pytest
from light_jobs import Files, Squares

from lerobot_latentsafe.runtime import tasks
from lerobot_latentsafe.runtime.files import OtherRunError
from lerobot_latentsafe.runtime.tasks import Tasks, TasksFailedError, UnseenFolderError, share

datatrove = pytest.importorskip("datatrove")
ALL = "0.txt 1.txt 2.txt 3.txt"


@pytest.fixture
def files(tmp_path):
    return Files(tmp_path)


@pytest.mark.parametrize("workers", [1, 2])
def test_every_task_is_done_once_and_then_the_last_one(files, workers):
    assert Tasks(4, workers).run(files.job())
    assert (files.folder / "all").read_text() == ALL
    assert {file.read_text() for file in files.folder.glob("*.txt")} == {"once"}
    assert not files.job().logs.exists()


@pytest.mark.fault("D07", "the disk is full in one task of several", "The others are done and stay; a message names it")
def test_a_task_that_fails_leaves_the_others(files):
    (files.folder / "1.full").touch()
    with pytest.raises(
        TasksFailedError, match=r"1 of 4 tasks failed.*task 1: \[Errno 28\] No space left.*same command"
    ):
        Tasks(4).run(files.job())
    assert not (files.folder / "all").exists() and sorted(p.name for p in files.folder.glob("*.txt")) == [
        "0.txt", "2.txt", "3.txt",
    ]  # fmt: skip
    (files.folder / "1.full").unlink()
    assert Tasks(4).run(files.job()) and (files.folder / "all").read_text() == ALL
    assert (files.folder / "0.txt").read_text() == "once"


@pytest.mark.fault(
    "K51", "a worker is killed in its task", "A message; what was done stays, and the same command goes on"
)
def test_a_killed_worker_is_an_error_and_not_waited_for(files):
    (files.folder / "3.killed").touch()
    with pytest.raises(TasksFailedError, match="a worker was killed"):
        Tasks(4, workers=2).run(files.job())
    (files.folder / "3.killed").unlink()
    assert Tasks(4, workers=2).run(files.job()) and (files.folder / "all").read_text() == ALL


def test_workers_end_with_the_process_that_started_them(files):
    """However it ends: SIGKILL tells nobody."""
    for task in range(2):
        (files.folder / f"{task}.long").touch()
    code = (
        "from light_jobs import Files; from pathlib import Path; from lerobot_latentsafe.runtime.tasks import Tasks\n"
    )
    code += f"if __name__ == '__main__': Tasks(2, 2).run(Files(Path({str(files.folder)!r})).job())"
    script = files.folder / "run.py"
    script.write_text(code)
    started = subprocess.Popen([sys.executable, script], env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)})
    logs = files.job().logs / "logs"
    _until(lambda: len([*logs.glob("*.log")]) == 2)
    workers = psutil.Process(started.pid).children(recursive=True)
    started.kill()
    started.wait()
    _until(lambda: not any(worker.is_running() and worker.status() != "zombie" for worker in workers))


def test_a_result_that_was_removed_is_made_again(files):
    (files.folder / "3.full").touch()
    with pytest.raises(TasksFailedError):
        Tasks(4).run(files.job())
    (files.folder / "0.txt").unlink()  # datatrove has noted that it was done
    (files.folder / "3.full").unlink()
    assert Tasks(4).run(files.job()) and (files.folder / "all").read_text() == ALL


# -- pieces ---


@pytest.fixture
def squares(tmp_path):
    return Squares(tmp_path / "squares", 7)


def left(squares):
    return sorted(path.name for path in squares.output.parent.iterdir() if path.suffix != ".txt")


@pytest.mark.parametrize(("n", "number"), [(7, 3), (2, 4), (0, 1), (5, 5)])
def test_all_is_shared_and_neighbours_are_in_one_task(n, number):
    parts = share(range(n), number)
    assert [i for part in parts for i in part] == list(range(n))
    assert len(parts) == number and max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("how", ["full", "killed"])
@pytest.mark.parametrize("number", [4, 3], ids=["same number", "another number"])
def test_pieces_are_done_once_whatever_failed_on_the_way(squares, how, number):
    """Four tasks, two at once, one of which fails at its second piece; then the same again, or another number."""
    mark = squares.output.with_name(f"4.{how}")
    mark.touch()
    with pytest.raises(TasksFailedError, match="same command does what is missing"):
        squares.run(Tasks(4, workers=2))
    assert not squares.output.exists() and (squares.folder / "000002.pickle").exists()
    kept = {file.name: file.stat().st_mtime_ns for file in squares.folder.glob("*.pickle")}
    mark.unlink()
    assert squares.run(Tasks(number)) == [0, 4, 16, 36, 64, 100, 144]
    texts = {file.stem: file.read_text() for file in squares.output.parent.glob("*.txt")}
    assert len(texts) == 7 and all(texts[str(int(name[:6]))] == "once" for name in kept)
    assert left(squares) == ["squares"]


def test_pieces_of_something_else_are_refused_and_stay(squares):
    (squares.output.parent / "6.full").touch()
    with pytest.raises(TasksFailedError):
        squares.run(Tasks(4))
    n = len([*squares.folder.iterdir()])
    with pytest.raises(OtherRunError, match=r'other options \(of = "squares"\).*or remove that folder to begin anew'):
        Squares(squares.output, 7, "cubes").run(Tasks(4))
    with pytest.raises(OtherRunError, match=r'sees something else than the process that began .*\(of = "squares"\)'):
        Squares(squares.output, 7, "cubes").work(4, 2)
    assert len([*squares.folder.iterdir()]) == n


def test_a_node_that_sees_another_folder_says_so(squares, tmp_path):
    with pytest.raises(UnseenFolderError, match=r"does not see .*options\.json.*on storage that they share"):
        Squares(tmp_path / "local_disk" / "squares", 7).work(4, 1)
    with pytest.raises(UnseenFolderError, match=r"does not see .*000000\.pickle"):
        squares.end()


def test_a_torn_piece_is_named(squares):
    (squares.output.parent / "12.full").touch()
    with pytest.raises(TasksFailedError):
        squares.run(Tasks(2))
    (squares.output.parent / "12.full").unlink()
    piece = squares.folder / "000002.pickle"
    piece.write_bytes(piece.read_bytes()[:-2])
    with pytest.raises(ValueError, match=r"000002\.pickle is torn .*; remove it: the same command makes it anew"):
        squares.run(Tasks(2))
    piece.unlink()
    assert len(squares.run(Tasks(2))) == 7


# -- on a cluster ---

FAKES = {
    "sbatch": """
while [ $# -gt 1 ]; do shift; done
n=$(sed -n 's/^#SBATCH --array=0-\\([0-9]*\\).*/\\1/p' "$1")
for i in $(seq 0 "${n:-0}"); do SLURM_ARRAY_TASK_ID=$i SLURM_NODELIST=here bash "$1" >>"$FAKE_LOG" 2>&1; done
cat "$1" >>"$FAKE_LOG"
echo "Submitted batch job 7"
""",
    "srun": 'while [ "$1" != launch_pickled_pipeline ]; do shift; done; shift\n'
    f'{sys.executable} -c "from datatrove.tools.launch_pickled_pipeline import main; main()" "$@"',
    "scontrol": "echo here",
    "merge_stats": "true",
}
"""What a cluster's login node has, for a cluster of this one machine, on which nothing waits."""


@pytest.fixture
def slurm(tmp_path_factory, monkeypatch):
    """A Slurm whose jobs are over when they are submitted; what it heard."""
    folder = tmp_path_factory.mktemp("slurm")
    for name, text in FAKES.items():
        (folder / name).write_text(f"#!/bin/bash\n{text}\n")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    monkeypatch.setenv("FAKE_LOG", str(folder / "heard"))
    return folder / "heard"


def test_slurm_gets_the_same_pipeline_and_a_last_task(files, slurm):
    options = {"partition": "cpu", "time": "0:10:00", "cpus_per_task": 4, "venv_path": "/dev/null"}
    assert not Tasks(2, 1, "slurm", options).run(files.job())  # submitted
    heard = slurm.read_text()
    assert (files.folder / "all").read_text() == "0.txt 1.txt", heard
    assert "--partition=cpu" in heard and "--array=0-1%1" in heard and "--cpus-per-task=4" in heard


def test_slurm_gets_pieces_and_a_last_task(squares, slurm):
    options = {"partition": "cpu", "time": "0:10:00", "venv_path": "/dev/null"}
    assert squares.run(Tasks(2, 1, "slurm", options)) is None  # submitted
    assert squares.output.read_text() == "[0, 4, 16, 36, 64, 100, 144]", slurm.read_text()
    assert not squares.folder.exists()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (dict(number=0), r"--tasks\.number is 0; expected at least 1"),
        (dict(number=2, workers=0), r"--tasks\.workers is 0"),
        (dict(number=2, executor="pbs"), r"'pbs'; expected local, slurm, ray"),
        (dict(workers=2), r"--tasks\.number is not given"),
        (dict(number=2, options={"time": 1}), "take none, leave it out"),
    ],
)
def test_options_that_mean_nothing_are_refused(given, said):
    with pytest.raises(ValueError, match=said):
        Tasks(**given)


@pytest.mark.parametrize(
    ("executor", "options", "said"),
    [
        (
            "slurm",
            {"time": "1:00:00", "partition": "cpu", "queue": "x"},
            r"has queue; those of slurm are time, partition",
        ),
        ("slurm", {"time": "1:00:00"}, r"lacks partition, which slurm needs"),
    ],
)
def test_options_that_an_executor_does_not_have_are_refused(slurm, executor, options, said):
    with pytest.raises(ValueError, match=said):
        Tasks(2, 1, executor, options).require_executor()


@pytest.mark.parametrize(
    ("executor", "missing", "said"),
    [
        ("local", "datatrove", r"needs datatrove, which is not installed: pip install .*\[cluster\]"),
        ("ray", "ray", "needs ray, which is not installed: pip install ray"),
        ("slurm", "sbatch", r"needs sbatch, which is not on this machine's path"),
    ],
)
def test_an_executor_that_is_not_installed_is_refused_before_any_work(executor, missing, said, monkeypatch):
    monkeypatch.setattr(tasks, "find_spec", lambda name: None if name == missing else object())
    monkeypatch.setattr(tasks.shutil, "which", lambda name: None if name == missing else name)
    with pytest.raises((ImportError, OSError), match=said):
        Tasks(2, 1, executor, {} if executor == "local" else {"time": "1", "partition": "x"}).require_executor()


def _until(true, patience_s=300):
    given_up = time.monotonic() + patience_s
    while not true():
        assert time.monotonic() < given_up
        time.sleep(0.05)
