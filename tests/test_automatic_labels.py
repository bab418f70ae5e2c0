import errno
import json
import shutil
import sys
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from types import SimpleNamespace

import numpy as np
import pytest
import tiny

from lerobot_latentsafe.cli import main
from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.labels import FailureLabels
from lerobot_latentsafe.dubins import car
from lerobot_latentsafe.dubins.labeller import dubins_truth
from lerobot_latentsafe.labeling.automatic import (
    AnswerError,
    ChatEndpoint,
    LabellerError,
    UnsavedAnswersError,
    VisionLanguageLabeller,
    as_vector,
    find_labeller,
    label_automatically,
    parse_answer,
)
from lerobot_latentsafe.labeling.store import LabelStore


@pytest.fixture(scope="module")
def reckless(tmp_path_factory):
    """Episodes that enter the disc, with the recorded position."""
    from lerobot_latentsafe.collection.dubins import collect_dubins

    root = tmp_path_factory.mktemp("reckless") / "car"
    collect_dubins("reckless", tiny.REPO_ID, root, n_episodes=4, seed=0)
    return root


@pytest.fixture
def root(reckless, tmp_path):
    return shutil.copytree(reckless, tmp_path / "car")


@pytest.fixture
def labelled(root):
    store, frames = LabelStore(root, tiny.REPO_ID, ["entered"]), DatasetFrames(tiny.metadata(root))
    yield lambda labeller: label_automatically(store, frames, "entered", labeller, "test"), store
    store.close()


@pytest.fixture
def model():
    """A chat endpoint on this machine: answers with what the test says, keeps what it was asked."""

    class Handler(BaseHTTPRequestHandler):
        asked, answers = [], ['{"fails": true, "first_failing_frame": 3}']

        def do_POST(self):
            self.asked.append(json.loads(self.rfile.read(int(self.headers["content-length"]))))
            answer = self.answers[min(len(self.asked), len(self.answers)) - 1]
            self.send_response(200)
            self.end_headers()
            self.wfile.write(json.dumps({"choices": [{"message": {"content": answer}}]}).encode())

        def log_message(self, *args):
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    Handler.url = f"http://127.0.0.1:{server.server_port}/v1"
    yield Handler
    server.shutdown()


def test_simulation_truth_equals_the_recorded_labels(root, capsys):
    column = FailureLabels.load(root).failure
    main(["auto-label", "--labeller=dubins_truth", f"--dataset.repo_id={tiny.REPO_ID}", f"--dataset.root={root}",
          "--specification=entered"])  # fmt: skip
    assert "labelled   4 episodes" in capsys.readouterr().out
    assert np.array_equal(FailureLabels.load(root, "entered").failure, column) and car.RADIUS == 0.5


def test_labels_of_people_stay(labelled):
    run, store = labelled
    said = store.label("entered", 2, 0, "ann")
    assert run(dubins_truth)["labelled"] == [0, 1, 3]
    assert store.verdict("entered", 2) == said and store.verdict("entered", 1).by == "auto test"


def test_labeller_without_its_column_says_so(dataset_root, tmp_path):
    root = shutil.copytree(dataset_root, tmp_path / "car")
    store, frames = LabelStore(root, tiny.REPO_ID, ["entered"]), DatasetFrames(tiny.metadata(root))
    with pytest.raises(ValueError, match=r"reads the column 'observation.environment_state'.*observation.image"):
        label_automatically(store, frames, "entered", dubins_truth, "test")


@pytest.mark.fault("M34", "auto-label is killed", "Answers so far are saved; it goes on there")
def test_each_answer_is_saved_before_the_next_is_asked_for(labelled, root):
    run, store = labelled
    known = []

    def paid(episode):
        on_disk = FailureLabels.load(root, "entered").failure if known else np.zeros(0)
        known.append(int((on_disk >= 0).sum()))
        if episode.number == 3:
            raise KeyboardInterrupt  # as a kill would
        return 1

    with pytest.raises(KeyboardInterrupt):
        run(paid)
    assert known == [0, *np.cumsum(store.length[:3])]
    assert run(lambda episode: 0)["labelled"] == [3]  # it goes on where it stopped


@pytest.fixture
def disk(labelled, monkeypatch):
    """One that is full while `full` says so of the number of saves that it was asked for."""
    _, store = labelled
    disk, save = SimpleNamespace(full=lambda asked: False, asked=0), store._save

    def may_save(specification):
        disk.asked += 1
        if disk.full(disk.asked):
            raise OSError(errno.ENOSPC, "No space left on device")
        save(specification)

    monkeypatch.setattr(store, "_save", may_save)
    return disk


FULL = {
    "once": lambda asked: asked == 2,
    "for a while": lambda asked: asked in (1, 2),
    "at the last answer": lambda asked: asked == 4,
}


@pytest.mark.parametrize("full", FULL.values(), ids=FULL)
def test_a_disk_that_was_full_for_a_while_loses_no_answer(labelled, disk, root, full, caplog):
    run, store = labelled
    disk.full, asked = full, []
    assert run(lambda episode: asked.append(episode.number) or 1)["labelled"] == asked == [0, 1, 2, 3]
    assert "kept, and tried again with the next answer" in caplog.text and "No space left" in caplog.text
    store.close()
    again = LabelStore(root, tiny.REPO_ID, ["entered"])
    assert [again.verdict("entered", e).first for e in range(4)] == [1] * 4
    again.close()


@pytest.mark.fault("D06", "the disk is full while labels are saved", "Each answer that was not saved is named")
def test_a_disk_that_stays_full_names_each_answer_and_asks_for_no_more(labelled, disk):
    run, store = labelled
    disk.full, asked, said = lambda n: n > 1, [], [2, 1, int(store.length[2]), np.r_[-1, np.ones(store.length[3] - 1)]]
    with pytest.raises(
        UnsavedAnswersError, match=r"No space left.*episode 1: fails from frame 1; episode 2: never"
    ) as e:
        run(lambda episode: asked.append(episode.number) or said[episode.number])
    assert list(e.value.answers) == [1, 2, 3] and "episode 3: [-1, 1" in str(e.value) and "same command" in str(e.value)
    disk.full = lambda n: False  # room was made
    assert run(lambda episode: 1)["labelled"] == [1, 2, 3]
    assert store.verdict("entered", 0).first == 2


@pytest.mark.parametrize("ending", [KeyboardInterrupt, SystemExit, MemoryError])
def test_what_is_unsaved_is_saved_when_the_command_is_stopped(labelled, disk, ending):
    run, store = labelled
    disk.full = lambda asked: asked == 1

    def stopped(episode):
        if episode.number > 0:
            raise ending
        return 1

    with pytest.raises(LabellerError if ending is MemoryError else ending):
        run(stopped)
    assert store.verdict("entered", 0).first == 1


@pytest.mark.fault("M31", "the labeller fails on one episode", "The others are labelled; that one is named")
def test_an_episode_that_fails_does_not_stop_the_others(labelled):
    run, _ = labelled

    def unsteady(episode):
        if episode.number == 1:
            raise ConnectionError("timed out")
        return 0

    result = run(unsteady)
    assert result["labelled"] == [0, 2, 3] and result["failed"] == [(1, "ConnectionError: timed out")]


@pytest.mark.fault("M33", "the connection to a labelling model is cut", "Answers so far are saved; it goes on there")
def test_a_labeller_that_always_fails_is_not_asked_for_ever(labelled):
    run, store = labelled
    store.label("entered", 0, 0, "ann")
    asked = []

    def down(episode):
        asked.append(episode.number)
        raise ConnectionError("refused")

    with pytest.raises(LabellerError, match=r"failed on 3 episodes in a row.*refused.*The 0 labels.*goes on there"):
        run(down)
    assert asked == [1, 2, 3]


def test_what_got_no_label_is_told_by_the_exit_code(root, monkeypatch, capsys):
    monkeypatch.setattr(
        "lerobot_latentsafe.labeling.automatic.find_labeller", lambda name: lambda e: [0, -5][e.number % 2]
    )
    with pytest.raises(SystemExit, match="2 episodes got no label; the others are saved"):
        main(["auto-label", "--labeller=any", f"--dataset.repo_id={tiny.REPO_ID}", f"--dataset.root={root}",
              "--specification=entered"])  # fmt: skip
    assert "episode 1: expected a frame from 0 to" in capsys.readouterr().out


def test_a_model_sees_pictures_and_task(labelled, model):
    run, store = labelled
    model.answers = [
        '{"fails": true, "first_failing_frame": 3}',
        '{"fails": false, "first_failing_frame": null}',
        '{"fails": null, "first_failing_frame": null}',
        "The car fails at frame 3.",
    ]
    result = run(VisionLanguageLabeller(ChatEndpoint(model.url, "stand-in"), "the car enters the red disc", n_frames=5))
    assert [result[key] for key in ("labelled", "undecided")] == [[0, 1], [2]] and result["refused"][0][0] == 3
    assert [store.verdict("entered", e).first for e in range(4)] == [3, store.length[1], None, None]
    text, *pictures = model.asked[0]["messages"][0]["content"]
    assert "the car enters the red disc" in text["text"] and "drive" in text["text"] and len(pictures) == 5
    assert f"{store.length[0] - 1}\n" in text["text"]


@pytest.mark.parametrize(
    "answer",
    ["", "3", "null", "[]", '{"fails": true}', '{"fails": true, "first_failing_frame": null}',
     '{"fails": true, "first_failing_frame": 10}', '{"fails": true, "first_failing_frame": -1}',
     '{"fails": true, "first_failing_frame": 2.0}', '{"fails": true, "first_failing_frame": true}',
     '{"fails": 1, "first_failing_frame": 3}', '{"fails": false, "first_failing_frame": 3}',
     '{"fails": "no", "first_failing_frame": null}', '{"fails": 0, "first_failing_frame": null}',
     '{"fails": false, "first_failing_frame": null, "why": "x"}', '```json\n{"fails": false}\n```',
     '{"fails": false, "first_failing_frame": null} I think', "[" * 100_000],
)  # fmt: skip
def test_what_is_not_exactly_an_answer_is_no_label(answer):
    with pytest.raises(AnswerError):
        parse_answer(answer, 10)


def test_model_that_is_not_there_is_a_message():
    with pytest.raises(ConnectionError, match=r"127.0.0.1:9/v1 did not answer"):
        ChatEndpoint("http://127.0.0.1:9/v1", "x")("prompt", [])


@pytest.mark.parametrize("said", [-1, 11, 2.5, True, "3", [0, 1], [2] * 10], ids=str)
def test_what_a_function_returns_is_checked(said):
    with pytest.raises(AnswerError):
        as_vector(said, 10)


@pytest.mark.parametrize("name", ["no_such", "no.module:f", "json:no_such", ":"])
def test_unknown_labeller_is_a_message(name):
    with pytest.raises(ValueError, match="expected dubins_truth, vision_language, or module:function"):
        find_labeller(name)


def test_your_own_function_is_found():
    assert find_labeller("json:loads") is json.loads


def test_a_labeller_beside_the_user_is_found(tmp_path, monkeypatch):
    (tmp_path / "labels_of_mine.py").write_text("def first(episode):\n    return 0\n")
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.chdir(tmp_path)
    assert find_labeller("labels_of_mine:first")(None) == 0
