"""What is typed after a verb: help, options that are known, were renamed or are misspelt, errors in one line."""

import difflib
import importlib
import logging
import sys
import textwrap
import traceback
from collections.abc import Iterable, Sequence
from typing import Any

import draccus
import yaml

from lerobot_latentsafe.cli import RENAMED_VERBS, VERBS
from lerobot_latentsafe.cli.known_options import Described, KnownVerb, known_verb

logger = logging.getLogger(__name__)

WIDTH = 110
"""Columns of a help text."""


class UsageError(ValueError):
    """Something that was typed is not understood."""


# -- what was typed ---


def run(verb: str, argv: list[str], debug: bool = False) -> None:
    """Run a verb with what was typed after it; whatever is wrong ends the process with one line.

    Args:
        debug: print an error's traceback before that line.
    """
    logging.basicConfig(format="%(levelname)s %(message)s")
    verb = present_verb(verb)
    try:
        if {"-h", "--help"} & set(argv):
            return print(help_text(verb, argv))
        command = parsed(verb, argv)
        logging.getLogger().setLevel(logging.INFO)
        command.run()
    except KeyboardInterrupt:
        sys.exit(f"latentsafe {verb}: interrupted")
    except Exception as e:
        if debug:
            traceback.print_exc()
        sys.exit(f"latentsafe {verb}: {in_one_line(e) if _is_explained(e) else _unexplained(e)}")


def present_verb(verb: str) -> str:
    """A verb that exists; a warning tells that it was renamed, and an unknown one ends the process."""
    if verb in RENAMED_VERBS:
        logger.warning("latentsafe %s is now latentsafe %s", verb, RENAMED_VERBS[verb])
        verb = RENAMED_VERBS[verb]
    if verb not in VERBS:
        meant = nearest(verb, VERBS)
        hint = f"did you mean {meant}? latentsafe --help lists all" if meant else f"expected one of {', '.join(VERBS)}"
        sys.exit(f"latentsafe: unknown verb {verb!r}; {hint}")
    return verb


def nearest(name: str, known: Iterable[str]) -> str | None:
    """What was probably meant, if anything known resembles it."""
    return next(iter(difflib.get_close_matches(name, list(known), n=1)), None)


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


def parsed(verb: str, argv: list[str]) -> Any:
    """A verb's options class filled in.

    Raises:
        UsageError: an option that is not known, has no value or must be given.
        draccus.utils.DraccusException: a value that is not of the option's type.
    """
    given = pairs(argv)
    chosen = {name: value for name, value in given if name.endswith(".type")}
    known = described(verb, chosen)
    given = renamed(known, given)
    by_default = [o.name.removesuffix("type") for o in known.options if o.choices and o.name not in chosen]
    for name, value in given:
        if not name.startswith(tuple(by_default)):  # draccus knows the options of a choice that was not made
            _require_known(verb, name, value, known)
    if not any(name == "config_path" for name, _ in given):
        _require_given(verb, {name for name, _ in given}, known.options)
    if not VERBS[verb].light:
        with_lerobot()
    options = getattr(importlib.import_module(VERBS[verb].module), VERBS[verb].name)
    return draccus.parse(options, args=[f"--{name}={value}" for name, value in given], exit_on_error=False)


def described(verb: str, chosen: dict[str, str]) -> KnownVerb:
    """A verb and its options: at once by the file, or else by the classes, for which LeRobot is loaded."""
    known = known_verb(verb, chosen)
    if known is None:
        with_lerobot()
        known = importlib.import_module("lerobot_latentsafe.cli.option_classes").described(verb, chosen)
    return known


def with_lerobot() -> None:
    """Load LeRobot with its plugins, which takes seconds."""
    importlib.import_module("lerobot_latentsafe._compat").quiet_decoder()
    importlib.import_module("lerobot_latentsafe.runtime.plugins").register_plugins()


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


def renamed(known: KnownVerb, given: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """The same with present names; a warning tells them."""
    names = [option.name for option in known.options]
    present = []
    for name, value in given:
        if name in known.renamed and not _is_known(name, value, names):
            logger.warning("--%s is now --%s", name, known.renamed[name])
            name = known.renamed[name]
        present.append((name, value))
    return present


def _is_known(name: str, value: str, known: Iterable[str]) -> bool:
    """Whether draccus knows an option: `law.epsilon`, or the whole group `law` as a dictionary or from a file."""
    whole = value.startswith(("{", "include ")) and any(option.startswith(f"{name}.") for option in known)
    return name == "config_path" or name in known or whole


def _require_known(verb: str, name: str, value: str, known: KnownVerb) -> None:
    by_name = {option.name: option for option in known.options}
    if name in by_name:
        return _require_choice(by_name[name], value)
    if _is_known(name, value, by_name):
        return
    old, last = known.renamed, {option.rpartition(".")[2]: option for option in reversed(by_name)}
    grouped = next((option for option in by_name if option.startswith(f"{name}.")), None)
    meant = grouped or nearest(name, [*by_name, *old, *last])
    meant = meant if meant in by_name else old.get(meant, last.get(meant))
    hint = f"did you mean --{meant}? " if meant else ""
    raise UsageError(f"unknown option --{name}; {hint}latentsafe {verb} --help lists all")


def _require_choice(option: Described, value: str) -> None:
    if option.choices and value not in option.choices:
        meant = nearest(value, option.choices)
        hint = f"did you mean {meant}?" if meant else f"expected one of {', '.join(option.choices)}"
        raise UsageError(f"--{option.name} is {value!r}; {hint}")


def _require_given(verb: str, given: set[str], known: Sequence[Described]) -> None:
    """Refuse to start without what has no default; a group that is given as a whole is draccus's to judge."""
    missing = [
        f"--{option.name}"
        for option in known
        if option.needed and option.name not in given and not any(option.name.startswith(f"{name}.") for name in given)
    ]
    if missing:
        raise UsageError(f"give {', '.join(missing)}; latentsafe {verb} --help shows an example")


# -- what is printed ---


def help_text(verb: str, argv: list[str]) -> str:
    """What a verb is for, an example, and all options; those of a choice if it is made in `argv`."""
    chosen = dict(pair for token in argv if (pair := token.removeprefix("--").partition("=")[::2])[0].endswith(".type"))
    known = described(verb, chosen)
    purpose, example, *rest = known.text.split("\n\n")
    text = [purpose, textwrap.indent(textwrap.dedent(example), "    "), *rest, "options:"]
    lines = ["\n\n".join(text)]
    for option in known.options:
        lines.append(f"  --{option.name}=<{option.value}>")
        lines += textwrap.wrap(_explained(option), WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return "\n".join(lines)


def _explained(option: Described) -> str:
    text = option.text
    if option.choices:
        text = f"{text} One of {', '.join(option.choices)}; with it, --help shows its options.".strip()
    after = "(must be given)" if option.needed else f"(default: {option.shown})" if option.shown else ""
    return f"{text} {after}".strip()


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
