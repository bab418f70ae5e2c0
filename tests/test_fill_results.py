"""Numbers of results/ in README.md and docs/: what the script puts there, and what it refuses."""

import importlib.util
import json
import subprocess
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
SPEC = importlib.util.spec_from_file_location("fill_results", REPOSITORY / "scripts" / "fill_results.py")
fill_results = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(fill_results)

CONTENT = {
    "rate": {"k": 4, "n": 120, "low": 0.013, "high": 0.0826},
    "weak": {"k": 25, "n": 40},
    "spread": {"median": 0.98964, "low": 0.98914, "high": 0.99033},
    "shuffled / true": 2.258,
    "0.04 m/s": {"share, of 24": 0.1417},
    "frames": 26030,
    "seconds": 684.892,
    "p": 2.38e-7,
    "lost": [0, 3, 4],
    "name": "bag",
    "nothing": None,
    "command": "make.py",
    "seeds": [0],
    "cpu_minutes": 0.1,
}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A repository with one results file of each kind, one commit, and a page without numbers."""
    (tmp_path / "docs").mkdir()
    (tmp_path / "results").mkdir()
    (tmp_path / "README.md").write_text("# Nothing\n")
    (tmp_path / "results" / "a.csv").write_text("step,user_s,system_s\nmargin,18.2,1.6\ntokens,845.6,13.4\n")
    (tmp_path / "results" / "a.jsonl").write_text('{"cpu_s": 60}\n{"cpu_s": 4276}\n')
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c"]
    for command in (["init", "-q"], ["add", "README.md"], ["commit", "-q", "-m", "a"]):
        subprocess.run([*git, *command], cwd=tmp_path, check=True)
    done = subprocess.run(
        [*git, "rev-parse", "--short", "HEAD"], cwd=tmp_path, check=True, capture_output=True, text=True
    )
    write(tmp_path, commit=done.stdout.strip())
    return tmp_path


def write(root: Path, name: str = "a.json", **changes) -> None:
    """A results file, with provenance unless a change takes it away by None."""
    kept = {key: value for key, value in {**CONTENT, **changes}.items() if key not in changes or value is not None}
    (root / "results" / name).write_text(json.dumps(kept))


def run(root: Path, *options: str) -> int:
    return fill_results.main([f"--root={root}", *options])


def page(root: Path, text: str) -> Path:
    (root / "docs" / "page.md").write_text(text)
    return root / "docs" / "page.md"


def refusal(root: Path, capsys) -> str:
    """What --check says; it must fail, write nothing and say it without a traceback."""
    before = {file: file.read_text() for file in root.rglob("*.md")}
    assert run(root, "--check") == 1
    assert before == {file: file.read_text() for file in root.rglob("*.md")}
    said = capsys.readouterr().err
    assert "Traceback" not in said
    return said


@pytest.mark.parametrize(
    ("expression", "shown"),
    [
        ("results/a.json name text", "bag"),
        ("results/a.json frames int", "26,030"),
        ("results/a.json shuffled %2F true fixed.2", "2.26"),
        ("results/a.json 0.04 m%2Fs/share, of 24 percent.1", "14.2%"),
        ("results/a.json weak percent", "62%"),
        ("results/a.json 0.04 m%2Fs/* points.1", "14.2"),
        ("results/a.json rate of", "4 of 120"),
        ("results/a.json rate rate", "3% [1, 8]"),
        ("results/a.json rate rate.1", "3.3% [1.3, 8.3]"),
        ("results/a.json spread spread.3", "0.990 [0.989, 0.990]"),
        ("results/a.json spread spread_percent.1", "99.0% [98.9, 99.0]"),
        ("results/a.json shuffled %2F true factor.1", "2.3×"),
        ("results/a.json p p", "3e-7"),
        ("results/a.json rate/low p", "0.02"),
        ("results/a.json seconds minutes.1", "11.4"),
        ("results/a.json lost/* int", "0, 3, 4"),
        ("results/a.json lost/-1 int", "4"),
        ("results/a.json lost/* sum int", "7"),
        ("results/a.json lost/* mean fixed.2", "2.33"),
        ("results/a.json lost/* min int", "0"),
        ("results/a.json lost/* max int", "4"),
        ("results/a.json {rate,weak} ratio percent.1", "5.3%"),
        ("results/a.json {weak,rate} difference points", "59"),
        ("results/a.{json,json} weak/k int", "25, 25"),
        ("results/a.csv tokens/user_s int", "846"),
        ("results/a.csv {tokens,margin}/{user_s,system_s} sum minutes.1", "14.6"),
        ("results/a.jsonl -1/cpu_s minutes", "71"),
    ],
)
def test_formats(root, expression, shown, capsys):
    file = page(root, f"There are <!--={expression}--><!--/--> of them.\n")
    assert run(root) == 0
    assert file.read_text() == f"There are <!--={expression}-->{shown}<!--/--> of them.\n"
    assert run(root, "--check") == 0
    assert run(root, "--show", expression) == 0
    assert capsys.readouterr().out.splitlines()[-1] == shown


def test_every_format_and_reduction_is_tested():
    tested = next(m for m in test_formats.pytestmark if m.name == "parametrize").args[1]
    words = {word for expression, _ in tested for word in expression.replace(".", " ").split()}
    assert words >= {*fill_results.FORMATS, *fill_results.REDUCTIONS}


def test_a_changed_result_that_nobody_carried_over(root, capsys):
    file = page(root, "Spilled:\n\n| weak |\n|---|\n| <!--=results/a.json rate of-->4 of 120<!--/--> |\n")
    assert run(root, "--check") == 0
    write(root, rate={"k": 5, "n": 120}, commit=fill_results.history(root)[0])
    said = refusal(root, capsys)
    assert "docs/page.md:5: results/a.json rate of: '4 of 120' stands there, the results say '5 of 120'" in said
    assert "run scripts/fill_results.py" in said
    assert run(root) == 0 and "5 of 120" in file.read_text()
    assert run(root, "--check") == 0


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("results/b.json rate rate", "results/b.json is missing; make it"),
        ("results/a.json rat rate", "results/a.json holds no 'rat'; it holds rate, weak, spread, shuffled %2F true"),
        ("results/a.json rate/k/x int", "results/a.json/rate/k is 4 and holds no 'x'; end the path there"),
        ("results/a.json lost/7 int", "results/a.json/lost holds no '7'; it holds 0, 1, 2"),
        ("results/a.json rate rat", "'rat' is no format; take one of text, int"),
        ("results/a.json rate fixed.x", "'fixed.x' is no format"),
        ("results/a.json rate", "an expression is FILE PATH [REDUCTION] FORMAT"),
        ("results/a.json name fixed", "the entry is 'bag', no number; lengthen the path"),
        ("results/a.json rate fixed", "the entry is an object, no number; lengthen the path"),
        ("results/a.json nothing fixed", "the entry is None, no number"),
        ("results/a.json weak rate", "the entry holds no low; take another path or another format"),
        ("results/a.json lost/* ratio int", "ratio and difference take two entries, not 3"),
        ("results/a.json lost/{1,0} ratio int", "the second entry is 0; nothing can be divided by it"),
        ("results/c.json rate rate", "c.json cannot be read"),
        ("README.md rate rate", "README.md is no .json, .jsonl or .csv"),
    ],
)
def test_expressions_that_cannot_be_filled(root, expression, message, capsys):
    (root / "results" / "c.json").write_text("{")
    text = f"Two.\n\nThere are <!--={expression}-->old<!--/--> of them.\n"
    file = page(root, text)
    assert f"docs/page.md:3: {expression}: {message}" in refusal(root, capsys)
    assert run(root) == 1
    assert file.read_text() == text
    assert run(root, "--show", expression) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("One\ntwo <!--=results/a.json rate of-->4 of 120.\n", 2, "the marker is not closed"),
        ("A <!--=results/a.json rate of-->4 <!--=results/a.json rate of-->4 of 120<!--/-->", 1, "not closed"),
        ("A <!--=results/a.json rate of-->4 of 120\n\nnext <!--/-->.\n", 1, "the marker is not closed"),
        ("A <!--=results/a.json rate of 4 of 120<!--/-->.\n", 1, "results/a.json rate of 4 of 120: the marker is not"),
        ("A <!--=results/a.json rate of 4 of 120.\n", 1, "the marker is not closed"),
        ("A 4 of 120<!--/-->.\n", 1, "it closes no marker; remove it"),
        ("A\n<!--=results/a.json rate of-->4 of 120<!--/-->.\n", 2, "the marker begins its line"),
        ("A\n`law.epsilon=<!--=results/a.json rate of-->4<!--/-->`.\n", 2, "the marker stands within `code`"),
        ("* <!--=results/a.json rate of-->4 of 120<!--/-->.\n", 1, "the marker begins its line"),
    ],
)
def test_markers_that_are_not_well_formed(root, text, line, message, capsys):
    page(root, text)
    said = refusal(root, capsys)
    assert f"docs/page.md:{line}: " in said
    assert message in said


def test_blocks_of_code_are_left_alone_but_directives_are_not(root):
    marker = "<!--=results/a.json rate of-->old<!--/-->"
    code = f"```text\n{marker}\n```\n", f"```{{code-cell}}\n{marker}\n```\n", "Write `<!--=EXPR-->` or ``<!--/-->``.\n"
    note = f"````{{note}}\nIt is {marker}.\n```bash\n{marker}\n```\n````\nIt is {marker}.\n"
    file = page(root, "\n".join([code[0], note, *code]))
    assert run(root) == 0
    assert file.read_text().count("It is <!--=results/a.json rate of-->4 of 120<!--/-->.") == 2
    assert file.read_text().count(">old<") == 4


def test_all_pages_but_what_sphinx_built(root):
    marker = "A <!--=results/a.json rate of--><!--/-->\n"
    files = [root / name for name in ("README.md", "docs/page.md", "docs/results/car.md", "docs/_build/page.md")]
    for file in files:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(marker)
    assert run(root) == 0
    assert ["4 of 120" in file.read_text() for file in files] == [True, True, True, False]


@pytest.mark.parametrize("key", fill_results.PROVENANCE)
def test_results_without_provenance(root, key, capsys):
    write(root, "b.json", **{"commit": fill_results.history(root)[0], key: None})
    assert f"results/b.json: lacks {key}; make it again" in refusal(root, capsys)


@pytest.mark.parametrize("where", [{"commit": "0123abc"}, {"counted": {"commit": "0123abc"}}])
def test_results_of_a_commit_that_is_not_there(root, where, capsys):
    write(root, "b.json", **{"commit": fill_results.history(root)[0], **where})
    assert "results/b.json: commit 0123abc is not in the history of HEAD; make it again" in refusal(root, capsys)


def test_a_commit_that_only_this_checkout_has(root, capsys):
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c"]
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "lost"], cwd=root, check=True)
    lost = fill_results.history(root)[0]
    subprocess.run([*git, "reset", "-q", "--hard", "HEAD~"], cwd=root, check=True)
    write(root, "b.json", commit=lost[:7])
    assert f"commit {lost[:7]} is not in the history of HEAD" in refusal(root, capsys)


def test_results_that_are_no_json(root, capsys):
    (root / "results" / "b.json").write_text("[1")
    assert "results/b.json: b.json cannot be read" in refusal(root, capsys)
    (root / "results" / "b.json").write_text("[1]")
    assert "results/b.json: lacks command, commit, seeds, cpu_minutes" in refusal(root, capsys)


def test_commits_are_not_looked_up_where_history_is_not_there(root, tmp_path_factory, capsys):
    clone = tmp_path_factory.mktemp("clone") / "clone"
    subprocess.run(["git", "clone", "-q", "--depth=1", f"file://{root}", clone], check=True)
    (root / ".git").rename(root / "no_git")
    for place, why in ((clone, "this is a shallow clone"), (root, "there is no git repository here")):
        write(place.joinpath("results").mkdir(exist_ok=True) or place, commit="0123abc")
        assert run(place, "--check") == 0
        assert f"Commits of results were not looked up: {why}." in capsys.readouterr().err


def test_the_repository_itself():
    assert fill_results.check(REPOSITORY) == []
