"""Verbs that are cut into tasks: what they make equals what one process makes, whatever was killed on the way."""

import json
import os
import pickle
import shutil
import signal
import sys
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
import tiny

from lerobot_latentsafe import LatentSafeDubinsEnv
from lerobot_latentsafe.cli import main
from lerobot_latentsafe.collection import dubins, parts
from lerobot_latentsafe.collection.dubins import collect_dubins
from lerobot_latentsafe.collection.franka import collect_franka
from lerobot_latentsafe.collection.parts import record_in_parts
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.evaluation.rollouts import compare
from lerobot_latentsafe.evaluation.shield_tasks import CutComparison
from lerobot_latentsafe.labeling.automatic import label_automatically
from lerobot_latentsafe.labeling.label_tasks import CutLabelling
from lerobot_latentsafe.labeling.store import LabelStore
from lerobot_latentsafe.modeling_latentsafe import load_filter
from lerobot_latentsafe.runtime import tasks
from lerobot_latentsafe.runtime.files import OtherRunError, claim, replacing
from lerobot_latentsafe.runtime.tasks import Tasks, TasksFailedError, UnseenFolderError

pytest.importorskip("datatrove")


def die_once(mark):
    """Be killed, if the file is there; it is gone then."""
    if mark.exists():
        mark.unlink()
        os.kill(os.getpid(), signal.SIGKILL)


# -- collect ---

N_CAR = 9


def record_car(folder, tasks=None, record=None, n=N_CAR):
    options = {"source": "reckless", "repo_id": "me/car", "seed": 5}
    record = record or partial(dubins._record, "reckless", "me/car", n, 5)
    return record_in_parts("me/car", folder, options, n, record, 2, tasks=tasks)


def content(dataset):
    rows = dataset.hf_dataset.with_format(None)
    columns = {name: rows[name] for name in rows.column_names if name != "observation.image"}
    pictures = [np.asarray(picture).tobytes() for picture in rows["observation.image"]]
    return columns, pictures, dataset.meta.episodes["length"], dataset.meta.stats["action"]["mean"].tolist()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What one process records."""
    return content(record_car(tmp_path_factory.mktemp("whole") / "car"))


def deadly_record(mark, numbers, folder):
    if 4 in numbers:
        die_once(mark)
    yield from dubins._record("reckless", "me/car", N_CAR, 5, numbers, folder)


@pytest.mark.fault("K54", "a worker of collect is killed", "The same command records the parts that are missing")
def test_a_dataset_of_tasks_equals_that_of_one_process(whole, tmp_path):
    mark = tmp_path / "mark"
    mark.touch()
    with pytest.raises(TasksFailedError, match="a worker was killed"):
        record_car(tmp_path / "car", Tasks(4, workers=2), partial(deadly_record, mark))
    assert not mark.exists() and not (tmp_path / "car").exists()
    recorded = []

    def counted(numbers, folder):
        recorded.extend(numbers)
        return dubins._record("reckless", "me/car", N_CAR, 5, numbers, folder)

    kept = [file.name for file in (tmp_path / "car.parts").glob("??????_??????")]
    assert content(record_car(tmp_path / "car", Tasks(3), counted)) == whole
    assert len(recorded) + sum(int(name[7:]) - int(name[:6]) for name in kept) == N_CAR and 4 in recorded
    assert [path.name for path in tmp_path.iterdir()] == ["car"]


@pytest.mark.fault("D09", "the disk is full in one task of collect", "The parts of the others stay; a message names it")
def test_a_full_disk_in_one_task_leaves_the_parts_of_the_others(whole, tmp_path, monkeypatch):
    def full(numbers, folder):
        if 4 in numbers:
            raise OSError(28, "No space left on device")
        return dubins._record("reckless", "me/car", N_CAR, 5, numbers, folder)

    with monkeypatch.context() as patch, pytest.raises(TasksFailedError, match=r"1 of 4 tasks .*disk of .* is full"):
        patch.setattr(parts.shutil, "disk_usage", lambda folder: SimpleNamespace(free=0))
        record_car(tmp_path / "car", Tasks(4), full)
    assert len([*(tmp_path / "car.parts").glob("??????_??????")]) == 4
    assert content(record_car(tmp_path / "car", Tasks(4))) == whole


def test_recordings_that_cannot_be_joined_are_refused(tmp_path):
    recording = parts.Recording("me/car", tmp_path / "car", {}, 4, partial(dubins._record, "reckless", "me/car", 4, 5))
    with pytest.raises(UnseenFolderError, match=r"does not see .*options\.json, which.*same --dataset\.root"):
        recording.work([[range(4)]], 0)
    claim(recording.parts / "options.json", {})
    recording.work([[range(2)], [range(2, 4)]], 1)
    with pytest.raises(UnseenFolderError, match=r"does not see .*car\.parts/000000_000002, which another"):
        recording.finish()
    with pytest.raises(OtherRunError, match="options"):
        record_car(tmp_path / "car", Tasks(2))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--tasks.number=4"], "--tasks.number is 4, and there are 3 episodes; give fewer"),
        (["--tasks.number=2", "--tasks.workers=0"], "--tasks.workers is 0"),
    ],
)
def test_the_command_records_in_tasks_or_says_why_not(tmp_path, capsys, options, said):
    given = ["collect", "--source=random", "--dataset.repo_id=me/car", "--dataset.num_episodes=3"]
    with pytest.raises(SystemExit, match=said):
        main([*given, f"--dataset.root={tmp_path / 'car'}", *options])
    assert not [*tmp_path.iterdir()]
    main([*given, f"--dataset.root={tmp_path / 'car'}", "--tasks.number=2"])
    assert "3 episodes" in capsys.readouterr().out and [path.name for path in tmp_path.iterdir()] == ["car"]


def test_processes_of_collect_and_tasks_are_not_both_asked_for(tmp_path):
    with pytest.raises(
        ValueError, match=r"--workers is 2, and --tasks\.number is given; give --tasks\.workers instead"
    ):
        collect_franka("bag_pulls", "me/bag", tmp_path / "bag", 4, 0, workers=2, tasks=Tasks(2))


# -- auto-label ---


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Episodes that enter the disc, with the recorded position."""
    root = tmp_path_factory.mktemp("reckless") / "car"
    collect_dubins("reckless", tiny.REPO_ID, root, n_episodes=6, seed=0)
    return root


@pytest.fixture
def root(recorded, tmp_path):
    return shutil.copytree(recorded, tmp_path / "car")


def said_of(episode):
    """By its number: a first failing frame, labels, nothing, or no answer."""
    return [3, np.r_[-1, np.ones(episode.length - 1)], None, -5, 0, 1][episode.number]


def labelling(root, labeller=said_of, model="default"):
    frames, asked = DatasetFrames(tiny.metadata(root)), {"model": model}
    return CutLabelling.of(frames, "entered", "test", partial(itemgetter(0), [labeller]), asked, print)


def labels(root):
    table = pq.read_table(root / "labels" / "entered.parquet")
    return {name: table[name].to_pylist() for name in table.column_names if name != "labelled_at"}


@pytest.fixture(scope="module")
def labelled(recorded, tmp_path_factory):
    """What one process says, and its label file."""
    root = shutil.copytree(recorded, tmp_path_factory.mktemp("labelled") / "car")
    with closing(LabelStore(root, tiny.REPO_ID, ["entered"])) as store:
        result = label_automatically(store, DatasetFrames(tiny.metadata(root)), "entered", said_of, "test")
    return result, labels(root)


@pytest.mark.parametrize("ending", [KeyboardInterrupt, OSError(28, "No space left on device")], ids=["stopped", "full"])
def test_labels_of_tasks_equal_those_of_one_process(root, labelled, monkeypatch, ending):
    asked = []

    def unsteady(episode):
        asked.append(episode.number)
        return said_of(episode)

    def torn(file):
        if file.name == "000003.pickle" and len(asked) < 6:
            raise ending
        return replacing(file)

    monkeypatch.setattr(tasks, "replacing", torn)
    with pytest.raises(TasksFailedError if isinstance(ending, OSError) else ending):
        labelling(root, unsteady).run(Tasks(3))
    assert not (root / "labels" / "entered.parquet").exists()
    before = len(asked)
    monkeypatch.undo()
    assert labelling(root, unsteady).run(Tasks(2)) == labelled[0]
    assert labels(root) == labelled[1] and asked[before:] == [e for e in range(6) if e == 3 or e not in asked[:before]]
    assert not [path for path in root.iterdir() if path.name.startswith("labels.")]


def test_labels_that_people_give_meanwhile_stay(root):
    work = pickle.loads(pickle.dumps(labelling(root)))  # as others get it
    with closing(LabelStore(root, tiny.REPO_ID, ["entered"])) as store:
        said = store.label("entered", 0, 5, "ann")
    assert work.run(Tasks(2))["labelled"] == [1, 4, 5]
    with closing(LabelStore(root, tiny.REPO_ID, ["entered"])) as store:
        assert store.verdict("entered", 0) == said


def test_answers_of_another_labeller_are_not_mixed(root, dataset_root):
    def down(episode):
        raise ConnectionError("refused")

    with pytest.raises(TasksFailedError, match=r"1 of 1 tasks failed.*test failed on 3 episodes in a row"):
        labelling(root, down).run(Tasks(1))
    with pytest.raises(OtherRunError, match=r'other options \(model = "default"\).*remove that folder to begin anew'):
        labelling(root, model="better").run(Tasks(1))
    other = replace(labelling(root), root=dataset_root, cameras=["observation.image"])
    with pytest.raises(OtherRunError, match=r"sees something else than .*\(dataset = "):
        other.work(1, 0)


def test_the_command_labels_in_tasks(root, tmp_path, monkeypatch, capsys):
    """Its labeller lies beside the user."""
    (tmp_path / "in_tasks.py").write_text("def first(episode):\n    return [0, -5][episode.number == 3]\n")
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.chdir(tmp_path)
    given = [
        "auto-label",
        f"--dataset.repo_id={tiny.REPO_ID}",
        f"--dataset.root={root.name}",
        "--specification=entered",
    ]
    with pytest.raises(SystemExit, match="1 episodes got no label; the others are saved"):
        main([*given, "--labeller=in_tasks:first", "--tasks.number=2"])
    assert "labelled   5 episodes" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="is 7, and there are 6 episodes; give fewer"):
        main([*given, "--labeller=in_tasks:first", "--tasks.number=7"])
    main([*given, "--labeller=json:loads", "--tasks.number=1", "--dataset.episodes=[0,1]"])  # all have one
    assert "labelled   0 episodes" in capsys.readouterr().out


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
    for name, more in (("one", []), ("two", ["--tasks.number=2", f"--figure={tmp_path / 'two.png'}"])):
        main(["eval-shield", *given, *more, f"--json={tmp_path / name}"])
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
