"""Makes the references of options from the option classes: a Sphinx extension.

In a page the line `<!-- console-reference -->` becomes the reference of all verbs, and
`<!-- options: lerobot_latentsafe.decision.LawConfig -->` a table of the fields of a class.
"""

import importlib
import inspect
import re
import typing
from collections.abc import Iterator
from dataclasses import MISSING

from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_latentsafe.cli import GROUPS, VERBS
from lerobot_latentsafe.cli.option_classes import Option, options_class, options_of

VERBS_HERE, OPTIONS_HERE = "<!-- console-reference -->", re.compile(r"<!-- options: ([\w.]+)\.(\w+) -->")
LEROBOTS = {"RecordConfig": "lerobot-record", "TeleoperateConfig": "lerobot-teleoperate"}
"""Option classes of LeRobot that verbs extend, and the command that has the same options."""


def own_options(options: type) -> list[Option]:
    """The options of a class and its groups that LeRobot does not bring."""
    return [option for option in options_of(options) if not _origin(options, option).startswith("lerobot.")]


def _origin(options: type, option: Option) -> str:
    """The module of the class that brings an option, or its group."""
    first = option.name.partition(".")[0]
    return next(kind.__module__ for kind in options.__mro__ if first in inspect.get_annotations(kind))


def console_reference() -> str:
    """The reference of all verbs, in MyST."""
    parts = []
    for group, title in GROUPS.items():
        parts.append(f"## {group.capitalize()}: {title}\n")
        parts += [_verb(verb) for verb, entry in VERBS.items() if entry.group == group]
    return "\n".join(parts)


def _verb(verb: str) -> str:
    options = options_class(verb)
    parts = [f"### latentsafe {verb}\n", f"{_prose(inspect.getdoc(options))}\n"]
    for command in (LEROBOTS[kind.__name__] for kind in options.__mro__ if kind.__name__ in LEROBOTS):
        parts.append(f"All options of `{command}` (see `{command} --help`), and:\n")
    return "\n".join([*parts, _table(own_options(options), "--")])


def class_reference(options: type) -> str:
    """What a class of options says of itself, and a table of its fields without those of its groups, in MyST."""
    own = [option for option in own_options(options) if "." not in option.name.removesuffix(".type")]
    return f"{_prose(inspect.getdoc(options))}\n\n{_table(own, '')}"


def _table(options: list[Option], dashes: str) -> str:
    rows = [
        f"| `{dashes}{option.name}` | {_kind(option)} | {_default(option)} | {_escaped(option.text)} |"
        for option in options
    ]
    return "\n".join(["| Option | Value | Default | Meaning |", "|---|---|---|---|", *rows]) + "\n" if rows else ""


def _kind(option: Option) -> str:
    """A type in few words."""
    if option.choices:
        return "a name" if len(option.choices) > 12 else ", ".join(f"`{choice}`" for choice in option.choices)
    kind = option.kind
    name = kind.__name__ if inspect.isclass(kind) and not typing.get_args(kind) else str(kind)
    return "`{}`".format(re.sub(r"\b(?:\w+\.)+(?=\w)", "", name).replace("|", "\\|"))


def _default(option: Option) -> str:
    if option.default is MISSING:
        return "must be given"
    plain = isinstance(option.default, str | int | float | list | dict | tuple) or hasattr(option.default, "parts")
    shown = str(option.default).lower() if isinstance(option.default, bool) else str(option.default)
    return f"`{shown}`" if plain and shown not in ("", "[]", "{}") and "<" not in shown else ""


def _escaped(text: str) -> str:
    """Text as Markdown: outside of its code spans options become code, and what would be markup is none."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part.startswith("`") else _plain_text(part) for part in parts)


def _plain_text(text: str) -> str:
    option = r"(?<![\w-])(--\w+(?:[\w.-]*\w)?(?:=[^\s,;:()]*[^\s,;:().])?)"
    parts = re.split(option, text)
    return "".join(f"`{part}`" if i % 2 else re.sub(r"([<>*|_])", r"\\\1", part) for i, part in enumerate(parts))


def _prose(text: str) -> str:
    """A docstring: paragraphs and lists are text, a paragraph that begins with a command is code."""
    return "\n\n".join(_paragraphs(text.partition("\nAttributes:")[0].rstrip()))


def _paragraphs(text: str) -> Iterator[str]:
    for paragraph in text.split("\n\n"):
        code = paragraph.startswith("latentsafe ")
        yield f"```bash\n{paragraph}\n```" if code else _escaped(paragraph)


def _fill(app, docname: str, source: list[str]) -> None:
    if VERBS_HERE in source[0]:
        source[0] = source[0].replace(VERBS_HERE, console_reference())
    source[0] = OPTIONS_HERE.sub(
        lambda found: class_reference(getattr(importlib.import_module(found[1]), found[2])), source[0]
    )


def setup(app) -> dict:
    """Sphinx calls this."""
    register_third_party_plugins()
    app.connect("source-read", _fill)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
