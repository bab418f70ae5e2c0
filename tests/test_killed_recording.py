"""A recording that is killed at any point holds whole episodes, goes on, and is then as if it had never been killed."""

import errno
import importlib
import multiprocessing
import os
import re
import signal
import sys
from contextlib import contextmanager

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.video_utils import VideoEncodingManager

from lerobot_latentsafe.cli import main
from lerobot_latentsafe.collection.sent_actions import storing_what_was_sent
from lerobot_latentsafe.collection.whole_episodes import WORK, recover
from lerobot_latentsafe.datasets.decisions import FILE
from lerobot_latentsafe.datasets.layout import check_layout
from lerobot_latentsafe.decision import least_restrictive
from lerobot_latentsafe.runtime.files import FolderInUseError, locked_folder

REPO, NAMES, FRAMES, EPISODES = "me/arm", ["x", "y"], 3, 4
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs fork")


def features(video):
    picture = {"dtype": "video" if video else "image", "shape": (64, 64, 3), "names": ["height", "width", "channels"]}
    vector = {"dtype": "float32", "shape": (2,), "names": NAMES}
    return {"action": vector, "observation.state": vector, "observation.images.top": picture}


def sent(episode, t):
    """What the robot executed, and the decision that led to it: always the same in the same episode and frame."""
    executed = [episode + t / 8, -t / 8]
    judged = least_restrictive(np.zeros((1, 2)), np.ones((1, 2)), np.array([t / 8]), np.ones(1), 0.0)
    return dict(zip(NAMES, executed)), judged


def seen(episode, t, task="push"):
    picture = np.full((64, 64, 3), 20 * episode + 5 * t, np.uint8)
    vector = np.array([episode, t], np.float32)
    return {"observation.images.top": picture, "observation.state": vector, "action": -vector, "task": task}


def record(root, episodes, resume=False, video=False, streaming=False):
    """As LeRobot's recording does, until the dataset holds so many episodes."""
    now = []
    with storing_what_was_sent(root, resume, lambda: sent(*now)) as resume:
        options = {"root": root, "image_writer_threads": 2, "streaming_encoding": streaming}
        if resume:
            dataset = LeRobotDataset.resume(REPO, **options)
        else:
            dataset = LeRobotDataset.create(REPO, 10, features(video), use_videos=video, **options)
        try:
            with VideoEncodingManager(dataset):
                while dataset.num_episodes < episodes:
                    for t in range(FRAMES):
                        now[:] = dataset.num_episodes, t
                        dataset.add_frame(seen(*now, task=f"push {dataset.num_episodes % 2}"))
                    dataset.save_episode()
        finally:
            dataset.finalize()


def holder_of(where):
    """The module or class that has a function, and the function's name."""
    *path, name = where.split(".")
    for n in range(len(path), 0, -1):
        try:
            holder = importlib.import_module(".".join(path[:n]))
        except ModuleNotFoundError:
            continue
        for inner in path[n:]:
            holder = getattr(holder, inner)
        return holder, name


def killed(run, where, nth, word=""):
    """Run something in a process that is killed as it calls a function, with such a word, for the n-th time."""
    holder, name = holder_of(where)
    function, calls = getattr(holder, name), []

    def killing(*args, **options):
        calls.extend([name] * (word in f"{args} {options}"))
        if len(calls) == nth:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*args, **options)

    def child():
        setattr(holder, name, killing)
        run()

    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL, f"{where} was called too rarely"


def frames_of(root):
    """All that the files of a dataset say of its frames, and the decisions on them."""
    files = sorted(root.glob("data/*/*.parquet"))
    rows = [row for file in files for row in pq.read_table(file).to_pylist()]
    return rows, pq.read_table(root / FILE).to_pylist()


def read_by_lerobot(root):
    """The states, and the mean of each picture, of all frames."""
    dataset = LeRobotDataset(REPO, root=root)
    frames = [dataset[i] for i in range(len(dataset))]
    return [(*f["observation.state"].tolist(), f["observation.images.top"].mean().item() * 255) for f in frames]


def expected(episodes):
    return [(e, t, pytest.approx(20 * e + 5 * t, abs=2)) for e in range(episodes) for t in range(FRAMES)]


def numbers(path):
    """All numbers of a JSON file."""
    return [float(number) for number in re.findall(r"[-\d.e]*\d", path.read_text())]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A recording that was never killed."""
    root = tmp_path_factory.mktemp("whole") / "data"
    record(root, EPISODES)
    return root


WRITER = "lerobot.datasets.dataset_writer.DatasetWriter"
META = "lerobot.datasets.dataset_metadata"
OURS = "lerobot_latentsafe.collection.whole_episodes"
SENT = "lerobot_latentsafe.collection.sent_actions.SentActions"
POINTS = [
    (f"{WRITER}.add_frame", 2 * FRAMES + 1, "", 2),
    (f"{WRITER}.add_frame", 2 * FRAMES + 3, "", 2),
    (f"{META}.write_tasks", 2, "", 1),
    (f"{WRITER}._save_episode_data", 3, "", 2),
    (f"{META}.LeRobotDatasetMetadata.save_episode", 3, "", 2),
    (f"{META}.write_info", 4, "", 2),
    (f"{META}.write_stats", 3, "", 2),
    (f"{OURS}.close_files", 3, "", 2),
    (f"{SENT}.write_beside", 3, "", 2),
    ("os.replace", 3, "complete.", 2),  # .complete.<process>.partial
    *(("os.replace", 3, f"{WORK}/complete/{part}", 3) for part in ("data", "meta/episodes", "meta/stats", "shield")),
    ("os.replace", 3, f"{WORK}/complete/meta/info", 3),
    (f"{WRITER}.finalize", 1, "", EPISODES),
]
"""Where it is killed, at which call with which word, and how many episodes were saved by then."""


@pytest.mark.parametrize(("where", "nth", "word", "saved"), POINTS)
@pytest.mark.fault(
    "K31", "record is killed in the third episode", "LeRobot reads the saved episodes; --resume=true goes on"
)
def test_a_killed_recording_holds_what_was_saved_and_goes_on(tmp_path, whole, where, nth, word, saved):
    root = tmp_path / "data"
    killed(lambda: record(root, EPISODES), where, nth, word)
    readable = read_by_lerobot(root)
    assert readable == expected(len(readable) // FRAMES) and len(readable) // FRAMES in (saved, saved - (saved == 3))
    recover(root)
    assert check_layout(root)["total_episodes"] == saved
    record(root, EPISODES, resume=True)
    assert frames_of(root) == frames_of(whole)
    assert (root / "meta/info.json").read_text() == (whole / "meta/info.json").read_text()
    assert numbers(root / "meta/stats.json") == pytest.approx(numbers(whole / "meta/stats.json"), abs=1e-6)
    assert not (root / WORK).exists() and not (root / "images").exists()


@pytest.mark.parametrize("how", [{"video": True}, {"video": True, "streaming": True}])
@pytest.mark.parametrize(
    ("where", "nth"),
    [(f"{WRITER}.add_frame", FRAMES + 2), (f"{WRITER}._save_episode_video", 2), (f"{OURS}.complete", 2)],
)
@pytest.mark.fault("K37", "record --resume=true is killed", "Finished episodes stay readable; it goes on")
def test_finished_episodes_outlive_a_kill_of_the_recording_that_goes_on(tmp_path, how, where, nth):
    root = tmp_path / "data"
    record(root, 1, **how)
    before = frames_of(root)
    killed(lambda: record(root, EPISODES, resume=True, **how), where, nth)
    assert read_by_lerobot(root) == expected(2)
    record(root, EPISODES, resume=True, **how)
    assert read_by_lerobot(root) == expected(EPISODES)
    assert [part[:FRAMES] for part in frames_of(root)] == [*before]


def delete(path):
    path.unlink()


def tear(path):
    path.write_bytes(path.read_bytes()[:-9])


def empty(path):
    path.write_bytes(b"")


def of_another_file(path):
    pq.write_table(pa.table({"x": [1]}), path)


def change(**changed):
    def alter(path):
        rows = pq.read_table(path).to_pylist()
        pq.write_table(pa.Table.from_pylist([{**row, **changed} for row in rows]), path)

    return alter


def cut(path):
    pq.write_table(pq.read_table(path).slice(0, FRAMES), path)


def cut_inside_an_episode(path):
    pq.write_table(pq.read_table(path).slice(0, 2 * FRAMES - 1), path)


BROKEN = {
    "deleted": (delete, "does not exist.*put it back"),
    "torn": (tear, "not a readable file of decisions.*put a copy"),
    "empty": (empty, "not a readable file of decisions"),
    "another file": (of_another_file, "holds no decisions: it lacks episode_index, executed, frame_index"),
    "of another recording": (change(executed=[9.0, 9.0]), r"\[9.0, 9.0\] was executed in episode 0, frame 0.*another"),
    "without the last episode": (cut, r"no decisions of episodes 1: .*--dataset.episodes=\[0\]"),
    "without the last frame": (cut_inside_an_episode, "None was executed in episode 1, frame 2"),
}


@pytest.mark.parametrize("fault", BROKEN)
@pytest.mark.fault(
    "K36", "the journal of decisions is deleted, torn or another's", "Refused with the remedy; nothing is changed"
)
def test_a_recording_does_not_go_on_without_its_decisions(tmp_path, fault):
    root, (break_it, words) = tmp_path / "data", BROKEN[fault]
    record(root, 2)
    break_it(root / FILE)
    before = {file: file.read_bytes() for file in root.rglob("*") if file.is_file()}
    with pytest.raises(ValueError, match=f"cannot go on: .*{words}.*Or record into another.*Nothing was changed"):
        record(root, EPISODES, resume=True)
    assert {file: file.read_bytes() for file in root.rglob("*") if file.is_file()} == before


@contextmanager
def another_process_has(root):
    fork = multiprocessing.get_context("fork")
    ours, theirs = fork.Pipe()

    def keep():
        with locked_folder(root):
            theirs.send("locked")
            theirs.recv()

    process = fork.Process(target=keep)
    process.start()
    ours.recv()
    try:
        yield
    finally:
        ours.send("end")
        process.join()


def test_what_cannot_go_on_is_refused(tmp_path):
    root = tmp_path / "data"
    with pytest.raises(ValueError, match="to go on with; leave --resume out"):
        record(root, 1, resume=True)
    assert not root.exists()
    record(root, 1)
    with pytest.raises(FileExistsError, match="--resume=true goes on"):
        record(root, 2)
    with another_process_has(root), pytest.raises(FolderInUseError, match=r"process \d+ is writing"):
        record(root, 2, resume=True)
    assert read_by_lerobot(root) == expected(1)


@pytest.mark.parametrize(
    ("where", "nth"),
    [(f"{META}.write_info", 1), ("json.dump", 1), (f"{OURS}.write_into", 1), (f"{WRITER}.add_frame", 2)],
)
def test_a_recording_that_was_killed_before_its_first_episode_goes_on(tmp_path, where, nth):
    root = tmp_path / "data"
    killed(lambda: record(root, 1), where, nth)
    record(root, 1, resume=True)
    assert read_by_lerobot(root) == expected(1)


def test_what_is_no_recording_is_not_cleared_away(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="no recording in"):
        record(tmp_path, 1, resume=True)
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("where", [f"{META}.write_stats", f"{SENT}.write_beside", f"{OURS}.complete"])
def test_a_full_disk_costs_no_saved_episode(tmp_path, whole, monkeypatch, where):
    root, (holder, name), calls = tmp_path / "data", holder_of(where), []
    function = getattr(holder, name)

    def full(*args):
        calls.append(name)
        if len(calls) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        return function(*args)

    with monkeypatch.context() as m:
        m.setattr(holder, name, full)
        with pytest.raises(OSError, match="No space left"):
            record(root, EPISODES)
    assert read_by_lerobot(root) == expected(2 if name == "complete" else 1)
    record(root, EPISODES, resume=True)
    assert frames_of(root) == frames_of(whole)


def merge(root, output, *options):
    given = [f"--dataset.repo_id={REPO}", f"--dataset.root={root}", "--new_repo_id=me/merged", f"--output_dir={output}"]
    main(["merge-decisions", *given, *options])


@pytest.mark.fault("K32", "decisions of the last episode are missing", "The others are merged, that one is named")
def test_decisions_are_merged_with_the_episodes_that_have_them(tmp_path):
    root, output = tmp_path / "data", tmp_path / "merged"
    record(root, 2)
    decisions = (root / FILE).read_bytes()
    record(root, 3, resume=True)
    (root / FILE).write_bytes(decisions)
    with pytest.raises(SystemExit, match=r"no decisions of episodes 2: .*--dataset.episodes=\[0, 1\]"):
        merge(root, output)
    assert not output.exists()
    merge(root, output, "--dataset.episodes=[1]")
    merged = LeRobotDataset("me/merged", root=output)
    assert np.array(merged.hf_dataset["action"]).tolist() == [[*sent(1, t)[0].values()] for t in range(FRAMES)]
    assert np.array(merged.hf_dataset["shield.value"]).tolist() == [t / 8 for t in range(FRAMES)]


@pytest.mark.parametrize("where", ["lerobot_latentsafe.datasets.columns.modify_features", "os.replace"])
def test_a_merge_that_is_killed_leaves_nothing_that_looks_whole(tmp_path, where):
    root, output = tmp_path / "data", tmp_path / "merged"
    record(root, 1)
    killed(lambda: merge(root, output), where, 1)
    assert not output.exists()
    merge(root, output)
    assert len(LeRobotDataset("me/merged", root=output)) == FRAMES
