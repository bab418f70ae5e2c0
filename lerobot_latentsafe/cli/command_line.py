"""What is typed after a verb: help, options that are known, were renamed or are misspelt, errors in one line."""

import importlib
import inspect
import logging
import sys
import textwrap
import traceback
import typing
from collections.abc import Iterable, Iterator
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import cached_property
from pathlib import Path
from types import NoneType, UnionType
from typing import Any

import draccus
import yaml
from draccus import ChoiceType
from draccus.wrappers.docstring import get_attribute_docstring
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_latentsafe._compat import quiet_decoder
from lerobot_latentsafe.cli import Verb, nearest
from lerobot_latentsafe.migration import MOVED

logger = logging.getLogger(__name__)

LAW = {old: f"law.{new}" for old, (group, new) in MOVED.items() if group == "law"}
ROBOT = {f"robot.{old}": f"robot.{LAW[old]}" for old in ("mode", "epsilon", "release", "guard")}

RENAMED: dict[str, dict[str, str]] = {
    "calibrate": {"max_missed": "alpha"},
    "collect": {"repo_id": "dataset.repo_id", "root": "dataset.root", "n_episodes": "dataset.num_episodes"},
    "record": ROBOT,
    "teleoperate": ROBOT,
    "train-dreamer": {f"model.{old}": f"model.{group}.{new}" for old, (group, new) in MOVED.items()},
    "wrap": LAW,
    "eval-shield": LAW,
    "report": LAW,
}
"""Verb -> old name of an option -> its present name. The old ones are still understood."""

WIDTH = 110
"""Columns of a help text."""


class UsageError(ValueError):
    """Something that was typed is not understood."""


# -- which options there are ---


@dataclass(frozen=True)
class Option:
    """An option of a verb, such as `--policy.path`.

    Attributes:
        name: without dashes.
        kind: its type; of a choice, the class that registers what may be chosen.
        default: MISSING where it must be given.
        owner: the class whose field it is.
    """

    name: str
    kind: Any
    default: Any
    owner: type

    @property
    def choices(self) -> list[str]:
        """What a choice may be; of other options empty."""
        return sorted(self.kind.get_known_choices()) if _is_choice(self.kind) else []

    @cached_property
    def text(self) -> str:
        """What the code says of it: below it, in the text of its class, above it."""
        attribute = self.name.removesuffix(".type").rpartition(".")[2]
        try:
            found = get_attribute_docstring(self.owner, attribute)
        except (AssertionError, IndexError, RuntimeWarning):  # draccus cannot read every source
            return _attribute_text(self.owner, attribute)
        text = found.docstring_below or _attribute_text(self.owner, attribute) or found.comment_above
        return " ".join(text.split())


def options_of(
    options: Any, chosen: dict[str, str] | None = None, prefix: str = "", defaults: Any = MISSING
) -> Iterator[Option]:
    """All options of an options class, those of its groups, too.

    Args:
        options: a dataclass.
        chosen: what was chosen of the choices, `env.type` -> its name; the options of another are left out.
        defaults: an object whose attributes are the defaults.
    """
    hints = typing.get_type_hints(options)
    for field in fields(options):
        if not field.init or field.name.startswith("_"):
            continue
        kind, name = _without_none(hints[field.name]), f"{prefix}{field.name}"
        default = getattr(defaults, field.name, MISSING) if defaults is not MISSING else _default(field)
        if _is_choice(kind):
            yield Option(f"{name}.type", kind, default, options)
            picked = kind.get_known_choices().get((chosen or {}).get(f"{name}.type"))
            if picked is not None:
                yield from options_of(picked, chosen, f"{name}.")
        elif is_dataclass(kind):
            yield from options_of(kind, chosen, f"{name}.", MISSING if default is None else default)
        else:
            yield Option(name, kind, default, options)


def _default(field: Field) -> Any:
    return field.default_factory() if field.default_factory is not MISSING else field.default


def _without_none(kind: Any) -> Any:
    """X of `X | None`."""
    if typing.get_origin(kind) not in (typing.Union, UnionType):
        return kind
    kinds = [k for k in typing.get_args(kind) if k is not NoneType]
    return kinds[0] if len(kinds) == 1 else kind


def _is_choice(kind: Any) -> bool:
    return inspect.isclass(kind) and issubclass(kind, ChoiceType)


def _attribute_text(owner: type, attribute: str) -> str:
    """What stands on an attribute under `Attributes:` in a class's text."""
    for line in _blocks(inspect.getdoc(owner) or ""):
        names, _, text = line.partition(": ")
        if attribute in names.split(", "):
            return text
    return ""


def _blocks(doc: str) -> list[str]:
    """The entries of the section `Attributes:`, each in one line."""
    section = textwrap.dedent(doc.partition("Attributes:\n")[2])
    entries: list[str] = []
    for line in section.splitlines():
        if line.startswith(" ") and entries:
            entries[-1] += f" {line.strip()}"
        else:
            entries.append(line)
    return entries


# -- what was typed ---


def run(verb: str, entry: Verb, argv: list[str], debug: bool = False) -> None:
    """Run a verb with what was typed after it; whatever is wrong ends the process with one line.

    Args:
        debug: print an error's traceback before that line.
    """
    try:
        quiet_decoder()
        register_third_party_plugins()
        options = getattr(importlib.import_module(entry.module), entry.name)
        if {"-h", "--help"} & set(argv):
            return print(help_text(verb, options, argv))
        command = parsed(verb, options, argv)
        logging.getLogger().setLevel(logging.INFO)
        command.run()
    except KeyboardInterrupt:
        sys.exit(f"latentsafe {verb}: interrupted")
    except Exception as e:
        if debug:
            traceback.print_exc()
        sys.exit(f"latentsafe {verb}: {in_one_line(e) if _is_explained(e) else _unexplained(e)}")


def _is_explained(error: Exception) -> bool:
    """Whether an error was raised for people to read: by this package or the system, and in more than a few words."""
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    ours = last is not None and last.tb_frame.f_globals.get("__name__", "").startswith("lerobot_latentsafe")
    system = isinstance(error, OSError | ImportError | draccus.utils.DraccusException)
    meant = system or (ours and isinstance(error, ValueError | RuntimeError | KeyError))
    return meant and len(in_one_line(error).split()) > 3


def _unexplained(error: Exception) -> str:
    return f"{type(error).__name__}: {in_one_line(error) or 'no message'} (--debug shows where)"


def parsed(verb: str, options: type, argv: list[str]) -> Any:
    """The options class filled in.

    Raises:
        UsageError: an option that is not known, has no value or must be given.
        draccus.utils.DraccusException: a value that is not of the option's type.
    """
    given = renamed(verb, options, pairs(argv))
    chosen = {name: value for name, value in given if name.endswith(".type")}
    known = list(options_of(options, chosen))
    by_default = [option.name.removesuffix("type") for option in known if option.choices and option.name not in chosen]
    for name, value in given:
        if not name.startswith(tuple(by_default)):  # draccus knows the options of a choice that was not made
            _require_known(verb, name, value, known)
    if not any(name == "config_path" for name, _ in given):
        _require_given(verb, {name for name, _ in given}, known)
    return draccus.parse(options, args=[f"--{name}={value}" for name, value in given], exit_on_error=False)


def pairs(argv: list[str]) -> list[tuple[str, str]]:
    """Names and values of `--name=value` or `--name value`.

    Raises:
        UsageError: something that is neither, or a value that is not YAML.
    """
    found, rest = [], list(argv)
    while rest:
        name, equals, value = rest.pop(0).partition("=")
        if not name.startswith("--"):
            raise UsageError(f"unexpected {name + equals + value!r}; options are given as --name=value")
        if not equals:
            if not rest or rest[0].startswith("--"):
                raise UsageError(f"{name} has no value; give {name}=...")
            value = rest.pop(0)
        _require_yaml(name, value)
        found.append((name.removeprefix("--"), value))
    return found


def _require_yaml(name: str, value: str) -> None:
    """Refuse what draccus cannot read as a value."""
    try:
        draccus.cfgparsing.parse_string(value)
    except yaml.YAMLError as e:
        raise UsageError(
            f"{name} is {value!r}, which is not YAML; write lists as '[a, b]', others as '{{a: 1}}'"
        ) from e


def renamed(verb: str, options: type, given: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """The same with present names; a warning tells them."""
    table = RENAMED.get(verb, {})
    chosen = {name: value for name, value in given if name.endswith(".type")}
    known = [option.name for option in options_of(options, chosen)]
    present = []
    for name, value in given:
        if name in table and not _is_known(name, value, known):
            logger.warning("--%s is now --%s", name, table[name])
            name = table[name]
        present.append((name, value))
    return present


def _is_known(name: str, value: str, known: Iterable[str]) -> bool:
    """Whether draccus knows an option: `law.epsilon`, or the whole group `law` as a dictionary or from a file."""
    whole = value.startswith(("{", "include ")) and any(option.startswith(f"{name}.") for option in known)
    return name == "config_path" or name in known or whole


def _require_known(verb: str, name: str, value: str, known: list[Option]) -> None:
    by_name = {option.name: option for option in known}
    if name in by_name:
        return _require_choice(by_name[name], value)
    if _is_known(name, value, by_name):
        return
    old, last = RENAMED.get(verb, {}), {option.rpartition(".")[2]: option for option in reversed(by_name)}
    grouped = next((option for option in by_name if option.startswith(f"{name}.")), None)
    meant = grouped or nearest(name, [*by_name, *old, *last])
    meant = meant if meant in by_name else old.get(meant, last.get(meant))
    hint = f"did you mean --{meant}? " if meant else ""
    raise UsageError(f"unknown option --{name}; {hint}latentsafe {verb} --help lists all")


def _require_choice(option: Option, value: str) -> None:
    if option.choices and value not in option.choices:
        meant = nearest(value, option.choices)
        hint = f"did you mean {meant}?" if meant else f"expected one of {', '.join(option.choices)}"
        raise UsageError(f"--{option.name} is {value!r}; {hint}")


def _require_given(verb: str, given: set[str], known: list[Option]) -> None:
    """Refuse to start without what has no default; a group that is given as a whole is draccus's to judge."""
    missing = [
        f"--{option.name}"
        for option in known
        if option.default is MISSING
        and option.name not in given
        and not any(option.name.startswith(f"{name}.") for name in given)
    ]
    if missing:
        raise UsageError(f"give {', '.join(missing)}; latentsafe {verb} --help shows an example")


# -- what is printed ---


def help_text(verb: str, options: type, argv: list[str]) -> str:
    """What a verb is for, an example, and all options; those of a choice if it is made in `argv`."""
    chosen = dict(pair for token in argv if (pair := token.removeprefix("--").partition("=")[::2])[0].endswith(".type"))
    purpose, example, *rest = inspect.getdoc(options).split("\n\n")
    text = [purpose, textwrap.indent(textwrap.dedent(example), "    "), *rest, "options:"]
    lines = ["\n\n".join(text)]
    for option in options_of(options, chosen):
        lines.append(f"  --{option.name}={_kind(option)}")
        lines += textwrap.wrap(_explained(option), WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return "\n".join(lines)


def _kind(option: Option) -> str:
    if option.choices:
        return "<name>"
    kind = option.kind if typing.get_args(option.kind) else getattr(option.kind, "__name__", option.kind)
    return f"<{str(kind).replace('typing.', '').replace('pathlib.', '')}>"


def _explained(option: Option) -> str:
    text, default = option.text, option.default
    if option.choices:
        text = f"{text} One of {', '.join(option.choices)}; with it, --help shows its options.".strip()
    if default is MISSING:
        return f"{text} (must be given)".strip()
    shown = default if isinstance(default, str | int | float | list | dict | Path) and len(str(default)) < 60 else None
    shown = str(shown).lower() if isinstance(shown, bool) else shown  # as it is typed
    return text if shown in (None, "", [], {}) else f"{text} (default: {shown})".strip()


def in_one_line(error: Exception) -> str:
    """An error's message without line breaks; of draccus's wrappers around another error, that of the other."""
    path: tuple[str, ...] = ()
    while isinstance(error, draccus.utils.DraccusException):
        path = path or tuple(getattr(error, "key_path", ()))
        if error.__cause__ is None or _says_enough(error):
            break
        error = error.__cause__
    message = error.args[0] if isinstance(error, KeyError) else getattr(error, "message", None) or str(error)
    return f"{'--' + '.'.join(path) + ': ' if path else ''}{' '.join(str(message).split())}"


def _says_enough(error: Exception) -> bool:
    """Whether draccus says what is wrong, and not only that something is."""
    wrappers = ("Could not decode the value into any", "Failed when parsing", "Couldn't instantiate class")
    return not getattr(error, "message", str(error)).startswith(wrappers)
