"""What a person waits for first: help, misspelt options and completion load neither torch nor LeRobot."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_latentsafe.cli import VERBS
from lerobot_latentsafe.cli import known_options as known
from lerobot_latentsafe.cli.command_line import described
from lerobot_latentsafe.cli.completion import HOW, candidates, complete
from lerobot_latentsafe.cli.option_classes import described as described_by_classes

HEAVY = ("torch", "lerobot.utils", "diffusers", "gymnasium", "matplotlib", "scipy", "mujoco")
RUN = """
import sys
from lerobot_latentsafe.cli import main
try:
    main(sys.argv[1:])
except SystemExit as stopped:
    print(stopped)
print(sorted(set({heavy}) & set(sys.modules)))
"""
SAID = ("name", "value", "text", "shown", "needed")
ON_THE_CAR = ("eval-shield", "--env.type=latentsafe_dubins")


def lines_of(*argv):
    """What a fresh process prints, and then which heavy modules it has loaded."""
    code = RUN.format(heavy=HEAVY)
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, argv)], capture_output=True, text=True, check=True
    ).stdout.splitlines()


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--help"], "Latent safety filters for LeRobot."),
        (["eval-sheild"], "did you mean eval-shield?"),
        (["record", "--help"], "Record any robot behind a filter"),
        ([*ON_THE_CAR, "--help"], "Run a policy bare and shielded"),
        ([*ON_THE_CAR, "--law.epsilom=0.1"], "did you mean --law.epsilon?"),
        (["eval-shield", "--env.type=latentsafe_dubin"], "did you mean latentsafe_dubins?"),
        (["wrap", "--law.epsilon=0.1"], "give --policy.path, --output_dir"),
        (["path", "--name=bag"], "pretrained/bag"),
        (["path", "--name=bags"], "no checkpoint at bags"),
        (["label", "--dataset.episodes=[1]"], "the page shows all episodes"),
        (["label", "--dataset.root=nowhere"], "there is no folder nowhere"),
        (["label", "--host=0.0.0.0"], "would take calls under any name"),
        (["completion"], "by the Tab key"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_needs_no_model_loads_none(argv, words):
    if argv[0] == "label":
        pytest.importorskip("starlette", reason="needs the label extra")
    first, *_, loaded = lines_of(*argv)
    assert words in first and loaded == "[]"


def test_the_page_refuses_a_port_that_is_taken_at_once():
    pytest.importorskip("starlette", reason="needs the label extra")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        first, *_, loaded = lines_of("label", f"--port={port}")
    assert f"cannot listen on 127.0.0.1 port {port}" in first and loaded == "[]"


def test_importing_the_package_loads_nothing():
    code = f"import sys, lerobot_latentsafe; print(sorted(set({HEAVY}) & set(sys.modules)), *dir(lerobot_latentsafe))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded, _, names = done.stdout.partition("]")
    assert loaded == "[" and {"load_filter", "LatentSafeConfig", "LawOptions", "__version__"} <= set(names.split())


# -- the file of options ---


def test_the_file_holds_what_the_classes_say():
    """In a process of its own: what other tests import brings more robots than the command knows."""
    script = Path(__file__).parents[1] / "scripts" / "write_options.py"
    done = subprocess.run([sys.executable, script, "--check"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("verb", "chosen"),
    [
        ("wrap", {}),
        ("eval-shield", {"env.type": "latentsafe_bag"}),
        ("record", {"robot.type": "latentsafe_shielded", "robot.inner.type": "so101_follower"}),
        ("record", {"robot.type": "unheard_of"}),
    ],
)
def test_file_and_classes_describe_a_verb_alike(verb, chosen):
    by_file, by_class = known.known_verb(verb, chosen), described_by_classes(verb, chosen)
    assert (by_file.text, by_file.renamed) == (by_class.text, by_class.renamed)
    for told, true in zip(by_file.options, by_class.options, strict=True):
        assert [getattr(told, name) for name in SAID] == [getattr(true, name) for name in SAID]
        assert set(told.choices) <= set(true.choices) and bool(told.choices) == bool(true.choices)


@pytest.mark.parametrize("name", ["lerobot_robot_theirs-1.0.dist-info", "lerobot_env_theirs-0.1.dist-info"])
def test_with_another_plugin_the_classes_are_asked(tmp_path, monkeypatch, name):
    (tmp_path / name).mkdir()
    monkeypatch.syspath_prepend(str(tmp_path))
    assert known.known_verb("record", {}) is None
    assert "robot.type" in [option.name for option in described("record", {}).options]


def test_with_another_lerobot_the_classes_are_asked(tmp_path, monkeypatch):
    file = tmp_path / "options.json"
    file.write_text(json.dumps({**json.loads(known.FILE.read_text(encoding="utf-8")), "lerobot": "0.6.99"}))
    monkeypatch.setattr(known, "FILE", file)
    assert known.known_verb("wrap", {}) is None
    assert "law.epsilon" in [option.name for option in described("wrap", {}).options]


# -- completion ---


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("latentsafe eval-s", ["eval-shield "]),
        ("latentsafe ", [f"{verb} " for verb in VERBS]),
        ("latentsafe wrap --pol", ["--policy.path="]),
        ("latentsafe wrap --policy.path=x --pol", []),
        ("latentsafe eval-shield --env.type=latentsafe_d", ["latentsafe_dubins "]),
        ("latentsafe eval-shield --env.type=latentsafe_dubins --env.episode", ["--env.episode_length="]),
        ("latentsafe picture-features --st", ["--step="]),
        ("latentsafe wrap --output_dir=", []),
        ("latentsafe fly --h", []),
    ],
)
def test_the_tab_key_completes(line, expected):
    assert candidates(line) == expected


def test_a_shell_asks_for_what_is_before_the_cursor(capsys, monkeypatch):
    complete()
    assert capsys.readouterr().out == f"{HOW}\n"
    monkeypatch.setitem(os.environ, "COMP_LINE", "latentsafe che --dataset")
    monkeypatch.setitem(os.environ, "COMP_POINT", str(len("latentsafe che")))
    complete()
    assert capsys.readouterr().out.splitlines() == ["check-dataset ", "check-labels "]
