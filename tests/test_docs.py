"""README and docs name only what exists: files, verbs, options, make targets, scripts, Python names."""

import ast
import importlib
import importlib.util
import re
import shlex
import tomllib
import typing
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path

import pytest
from draccus import ChoiceType
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_latentsafe.cli import VERBS

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    page
    for pattern in ("*.md", "docs/**/*.md", "datasets_cards/*.md", ".github/**/*.md")
    for page in ROOT.glob(pattern)
    if "_build" not in page.parts
)
LEROBOT = {
    "lerobot-train": "lerobot.configs.train:TrainPipelineConfig",
    "lerobot-eval": "lerobot.configs.eval:EvalPipelineConfig",
    "lerobot-record": "lerobot.scripts.lerobot_record:RecordConfig",
    "lerobot-teleoperate": "lerobot.scripts.lerobot_teleoperate:TeleoperateConfig",
    "lerobot-replay": "lerobot.scripts.lerobot_replay:ReplayConfig",
    "lerobot-rollout": "lerobot.rollout.configs:RolloutConfig",
    "lerobot-edit-dataset": "lerobot.scripts.lerobot_edit_dataset:EditDatasetConfig",
}
"""LeRobot's commands and the option class of each."""
OTHERS = {"cpu", "num_processes", "nproc_per_node", "nnodes", "rdzv_backend", "rdzv_endpoint", "local_addr", "flavor"}
OTHERS |= {"policy_type", "actions_per_chunk"}
"""Options of accelerate, torchrun, hf and LeRobot's robot client that pages name alone."""
PLACES = {path.name for path in ROOT.iterdir() if path.is_dir() and not path.name.startswith(".")} - {"outputs", "data"}
NAMED_FILES = (".py", ".sh", ".md", ".yaml", ".yml", ".toml", ".cff", ".lock", ".svg")
INVENTED = {"my_module.py"}
"""Files that a page asks its reader to write."""
OLD = re.compile(
    r"\b(margin_(hidden|layers|delta|weight|clips)|kept_commands|fallback_(moves|low|high)|reachability\.kept|patience|"
    r"dwell|EndAware|PerceiveStep|picture-features|journal|twins|--(policy\.|robot\.)?(epsilon|guard|release|memory|lookahead|"
    r"samples|retreat|mode|deadline_ms|law)=|policy\.(failure_specification|action_candidates)|"
    r"lerobot_latentsafe[./](baselines|commands|recording|filter|chunks|perceive|ranks|memory)\b)"
)
"""Names before the redesign; only CHANGELOG.md may say them."""


def load(path: Path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


reference = load(ROOT / "docs" / "console_reference.py")


# -- what a page says ---


def blocks(text: str, language: str) -> Iterator[str]:
    """Code blocks of a language."""
    for fence in re.finditer(r"^( *)(```+)(\w*)[^\n]*\n(.*?)^\1\2 *$", text, re.M | re.S):
        if fence[3] == language:
            yield fence[4]


def spans(text: str) -> list[str]:
    """Code within prose, on one line each."""
    prose = re.sub(r"^( *)(```+).*?^\1\2 *$", "", text, flags=re.M | re.S)
    return [" ".join(code.split()) for code in re.findall(r"(?<!`)`([^`]+)`(?!`)", prose)]


def commands(text: str) -> Iterator[list[str]]:
    """Every command of the blocks of bash, and those that a code span holds, as words."""
    lines = [line for block in blocks(text, "bash") for line in block.replace("\\\n", " ").splitlines()]
    named = [s for s in spans(text) if re.match(r"(\w+=\S+ )*(latentsafe|make|lerobot-\w+|torchrun|scripts/\S+) ?", s)]
    for line in [*lines, *named]:
        line = re.sub(r"\$\(which (\S+)\)", r"\1", line)
        lexer = shlex.shlex(line, posix=True, punctuation_chars=";&|")
        lexer.whitespace_split = True
        command: list[str] = []
        for word in lexer:
            if set(word) <= set(";&|"):
                yield command
                command = []
            else:
                command.append(word)
        yield command


# -- what exists ---


@cache
def options_class(command: str) -> type:
    """Of a command of LeRobot's, or of `latentsafe <verb>`."""
    register_third_party_plugins()
    if command in LEROBOT:
        module, name = LEROBOT[command].split(":")
        return getattr(importlib.import_module(module), name)
    return reference.options_class(command)


def has_option(options: type, path: list[str], given: dict[str, str], prefix: str = "") -> bool:
    """Whether an option class has an option, such as [policy, law, epsilon].

    Args:
        given: all options of the command: those that end in `type` say which class is meant; else any will do.
    """
    head, *rest = path
    if head not in {field.name for field in fields(options)}:
        return False
    kind, name = plain(typing.get_type_hints(options)[head]), f"{prefix}{head}"
    if not rest:
        return True
    if not (isinstance(kind, type) and issubclass(kind, ChoiceType)):
        return is_dataclass(kind) and has_option(kind, rest, given, f"{name}.")
    choices = kind.get_known_choices()
    if rest == ["type"]:
        return given.get(f"{name}.type", "...") in {*choices, "...", ""}
    if rest == ["path"]:
        return head == "policy"
    chosen = [given[f"{name}.type"]] if f"{name}.type" in given else list(choices)
    return any(has_option(kind.get_choice_class(c), rest, given, f"{name}.") for c in chosen if c in choices)


def plain(kind: type) -> type:
    """X of `X | None`."""
    return next((k for k in typing.get_args(kind) if is_dataclass(k)), kind)


def is_known(option: str) -> bool:
    """Whether any command, script or other program has an option of this name."""
    return (
        option in {*OTHERS, "help", "debug", "config_path"}
        or any(has_option(options_class(command), option.split("."), {}) for command in [*LEROBOT, *VERBS])
        or any(f'"--{option}"' in script.read_text() for script in (ROOT / "scripts").iterdir() if script.is_file())
    )


def wrong_command(words: list[str]) -> Iterator[str]:
    """What is wrong with a command, in words."""
    while words and (re.match(r"\w+=", words[0]) or words[0] == "\\"):
        words = words[1:]
    if not words:
        return
    program, *rest = words
    program = program.removeprefix(".venv/bin/")
    if program == "torchrun":
        inner = next((i for i, word in enumerate(rest) if word in ("latentsafe", *LEROBOT)), None)
        yield from wrong_command(rest[inner:]) if inner is not None else ()
    elif program == "python":
        yield from wrong_command(rest)
    elif program == "make":
        targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M)
        yield from (f"make has no target {word}" for word in rest if "=" not in word and word not in targets)
    elif program.startswith("scripts/"):
        script = ROOT / program
        if not script.exists():
            yield f"{program} does not exist"
        else:
            source = script.read_text()
            named = (word.partition("=")[0] for word in rest if word.startswith("--"))
            yield from (f"{program} has no option {o}" for o in named if o not in source and o != "--help")
    elif program == "latentsafe":
        verb = rest[0] if rest else "--help"
        if verb in VERBS:
            yield from wrong_options(f"latentsafe {verb}", options_class(verb), rest[1:])
        elif verb not in ("--help", "completion", "<verb>", "..."):
            yield f"latentsafe has no verb {verb}"
    elif program in LEROBOT:
        yield from wrong_options(program, options_class(program), rest)


def wrong_options(command: str, options: type, words: list[str]) -> Iterator[str]:
    given = dict(word[2:].partition("=")[::2] for word in words if word.startswith("--"))
    for option in given:
        ours = option in ("help", "debug", "config_path")
        if not ours and not has_option(options, option.split("."), given):
            yield f"{command} has no option --{option}"


def wrong_span(span: str) -> Iterator[str]:
    """What is wrong with an option, a file or a module that is named within prose."""
    if span.startswith("--"):
        named = re.findall(r"(?:^| )--([\w.]*\w)(?![\w.]*\.(?:<|$))", span)
        yield from (f"nothing has an option --{option}" for option in named if not is_known(option))
    elif re.fullmatch(r"lerobot_latentsafe(\.\w+)+", span):
        yield from () if python_name(span) else (f"there is no {span}",)
    elif re.fullmatch(r"[\w.{},/-]+", span):
        for path in expanded(span):
            file = path.endswith(NAMED_FILES) and path not in INVENTED
            place = "/" in path and path.split("/")[0] in PLACES
            if (file or place) and not exists(path):
                yield f"{path} does not exist"


def expanded(path: str) -> list[str]:
    """a{b,c} -> ab, ac."""
    found = re.search(r"\{([^{}]*)\}", path)
    if not found:
        return [path]
    return [p for one in found[1].split(",") for p in expanded(path[: found.start()] + one + path[found.end() :])]


def exists(path: str) -> bool:
    """A file of the repository, named from its root or from the package; what commands make is not looked for."""
    if path.startswith(("docs/_build", "outputs/", "data/")):
        return True
    names = (ROOT / path, ROOT / "lerobot_latentsafe" / path)
    anywhere = () if "/" in path else ROOT.glob(f"lerobot_latentsafe/*/{path}")
    return any(p.exists() for p in (*names, *anywhere))


def python_name(dotted: str) -> bool:
    """Whether a dotted name is a module, or what a module holds."""
    try:
        importlib.import_module(dotted)
    except ModuleNotFoundError:
        module, _, name = dotted.rpartition(".")
        try:
            return hasattr(importlib.import_module(module), name)
        except ModuleNotFoundError:
            return False
    return True


def wrong_python(code: str) -> Iterator[str]:
    """What a block of Python imports from this package and does not find."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lerobot_latentsafe"):
            module = importlib.import_module(node.module)
            yield from (f"{node.module} has no {a.name}" for a in node.names if not hasattr(module, a.name))


def wrong_links(page: Path, text: str) -> Iterator[str]:
    """Links to files that are not there."""
    for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"```.*?```", "", text, flags=re.S)):
        if not re.match(r"\w+:|#", target) and not (page.parent / target.partition("#")[0]).exists():
            yield f"the link {target} leads nowhere"


def problems(page: Path, text: str) -> list[str]:
    """Everything in a page that names what does not exist."""
    found = [what for command in commands(text) for what in wrong_command(command)]
    found += [what for span in spans(text) for what in wrong_span(span)]
    found += [what for code in blocks(text, "python") for what in wrong_python(code)]
    return sorted({*found, *wrong_links(page, text)})


# -- tests ---


@pytest.mark.parametrize("page", [str(page.relative_to(ROOT)) for page in PAGES if page.name != "CHANGELOG.md"])
def test_a_page_names_only_what_exists(page):
    assert problems(ROOT / page, (ROOT / page).read_text()) == []


@pytest.mark.parametrize("page", [str(page.relative_to(ROOT)) for page in PAGES if page.name != "CHANGELOG.md"])
def test_a_page_says_no_old_name(page):
    text = (ROOT / page).read_text()
    code = [*spans(text), *blocks(text, "bash"), *blocks(text, "python"), *blocks(text, "yaml")]
    assert [found[0] for part in code for found in OLD.finditer(part)] == []


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("`latentsafe lable`", "latentsafe has no verb lable"),
        ("```bash\nlatentsafe wrap --policy.pth=x\n```", "latentsafe wrap has no option --policy.pth"),
        ("```bash\nlerobot-train --policy.type=latentsafe \\\n  --policy.laws.epsilon=1\n```", "--policy.laws.epsilon"),
        ("```bash\nlatentsafe report --env.type=latentsafe_dubins --env.scene=bag\n```", "no option --env.scene"),
        ("```bash\nlatentsafe report --env.type=latentsafe_boat\n```", "no option --env.type"),
        ("```bash\ncd x && torchrun --nnodes=2 $(which latentsafe) cash\n```", "latentsafe has no verb cash"),
        ("`make tset`", "make has no target tset"),
        ("```bash\nmake setup && scripts/nothing.py\n```", "scripts/nothing.py does not exist"),
        ("```bash\nscripts/fill_results.py --chek\n```", "scripts/fill_results.py has no option --chek"),
        ("`--policy.law.epsilom=1`", "nothing has an option --policy.law.epsilom"),
        ("`lerobot_latentsafe/shields.py`", "lerobot_latentsafe/shields.py does not exist"),
        ("`configs/{bag_gru,bag_lstm}.yaml`", "configs/bag_lstm.yaml does not exist"),
        ("`lerobot_latentsafe.shield.Shild`", "there is no lerobot_latentsafe.shield.Shild"),
        ("```python\nfrom lerobot_latentsafe import load_filtre\n```", "lerobot_latentsafe has no load_filtre"),
        ("[a page](docs/nowhere.md)", "the link docs/nowhere.md leads nowhere"),
    ],
)
def test_what_does_not_exist_is_found(text, problem):
    found = problems(ROOT / "README.md", text)
    assert len(found) == 1 and problem in found[0]


def test_what_exists_is_found():
    text = """`latentsafe label`, `--law.epsilon=0.3`, `scripts/setup.sh`, `lerobot_latentsafe.shield.Shield`
```bash
MUJOCO_GL=egl latentsafe report --policy.path=bag --env.type=latentsafe_bag --env.episode_length=150   # a comment
lerobot-rollout --policy.path=x --policy.law.mode=monitor --robot.type=latentsafe_franka_mujoco --robot.scene=bag
```
"""
    assert problems(ROOT / "README.md", text) == []


@pytest.mark.parametrize("script", sorted(path.name for path in (ROOT / "scripts").glob("*.py")))
def test_a_script_reads_its_command_line(script):
    """Of one that does not, --help does the work."""
    assert ".parse_args(" in (ROOT / "scripts" / script).read_text()


def test_readme_is_short():
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 200 and len(text.split()) <= 1300


def test_readme_has_six_lines_of_python():
    (code,) = blocks((ROOT / "README.md").read_text(), "python")
    assert len([line for line in code.splitlines() if line]) == 6


def test_the_architecture_page_knows_every_layer():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    modules = {name for layer in contracts[0]["layers"] for name in layer.replace("|", " ").split()}
    named = spans((ROOT / "docs" / "architecture.md").read_text())
    assert [name for name in sorted(modules) if not {f"{name}/", f"{name}.py"} & set(named)] == []


@pytest.mark.parametrize("verb", VERBS)
def test_every_option_is_explained(verb):
    own = reference.own_options(options_class(verb))
    assert [option.name for option in own if not option.text] == []
