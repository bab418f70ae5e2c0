"""Makes the console reference of the option classes: a Sphinx extension, and what tests ask for known options.

A page gets it in the place of the line `<!-- console-reference -->`.
"""

import importlib
import inspect
import re
import typing
from collections.abc import Iterator
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from pathlib import Path
from types import UnionType

from draccus import ChoiceRegistry
from draccus.wrappers.docstring import get_attribute_docstring

PLACE = "<!-- console-reference -->"
GROUPS = {
    "record": "Record",
    "label": "Label",
    "train": "Train",
    "deploy": "Deploy",
    "evaluate": "Evaluate",
}
LEROBOTS = {"RecordConfig": "lerobot-record", "TeleoperateConfig": "lerobot-teleoperate"}
"""Option classes of LeRobot that verbs extend, and the command that has the same options."""


@dataclass(frozen=True)
class Option:
    """An option of a command, such as `--policy.path`."""

    name: str
    kind: str
    default: str
    text: str
    inherited: type | None = None


def options_class(verb: str) -> type:
    """The option class of a verb of `latentsafe`."""
    from lerobot_latentsafe.cli import VERBS

    return getattr(importlib.import_module(VERBS[verb].module), VERBS[verb].name)


def options_of(options: type, prefix: str = "") -> Iterator[Option]:
    """All options of an option class, those of its groups, too; a registry's are left to its own page."""
    hints = typing.get_type_hints(options)
    for field in fields(options):
        if not field.init or field.name.startswith("_"):
            continue
        kind, name = _plain(hints[field.name]), f"{prefix}{field.name}"
        if is_dataclass(kind) and not _is_registry(kind):
            yield from options_of(kind, f"{name}.")
            continue
        shown = f"{name}.type" if _is_registry(kind) else name
        yield Option(shown, _kind(kind), _default(field), _text(options, field), _inherited(options, field))


def _plain(kind: type) -> type:
    """X of `X | None`."""
    if typing.get_origin(kind) in (typing.Union, UnionType):
        kinds = [k for k in typing.get_args(kind) if k is not type(None)]
        return kinds[0] if len(kinds) == 1 else kind
    return kind


def _is_registry(kind: type) -> bool:
    return inspect.isclass(kind) and issubclass(kind, ChoiceRegistry)


def _kind(kind: type) -> str:
    if _is_registry(kind):
        return "a registered type"
    if inspect.isclass(kind) and issubclass(kind, Path):
        return "path"
    name = kind.__name__ if inspect.isclass(kind) and not typing.get_args(kind) else str(kind)
    return re.sub(r"\b(?:typing|pathlib|collections\.abc)\.", "", name)


def _default(field: Field) -> str:
    if field.default is not MISSING:
        return "" if field.default is None else str(field.default)
    if field.default_factory is MISSING:
        return "required"
    if field.default_factory.__module__ == "getpass":
        return "your name on this machine"
    made = field.default_factory()
    return "" if is_dataclass(made) else str(made)


def _inherited(options: type, field: Field) -> type | None:
    """LeRobot's class that brings this option, if one does."""
    for parent in options.__mro__[1:]:
        if is_dataclass(parent) and parent.__name__ in LEROBOTS and field.name in {f.name for f in fields(parent)}:
            return parent
    return None


def _text(options: type, field: Field) -> str:
    """What the code says of an option: below it, above it, or in its class's text."""
    found = get_attribute_docstring(options, field.name)
    text = found.docstring_below or found.comment_above or found.comment_inline
    return " ".join((text or _attribute(options, field.name)).split())


def _attribute(options: type, name: str) -> str:
    """The lines on an attribute under `Attributes:` in a class's text."""
    section = inspect.getdoc(options).partition("Attributes:\n")[2] if options.__doc__ else ""
    for entry in re.split(r"\n(?=    \S)", section.rstrip()):
        names, _, text = entry.strip().partition(": ")
        if name in names.split(", "):
            return text
    return ""


def console_reference() -> str:
    """The whole reference, in MyST."""
    from lerobot_latentsafe.cli import VERBS

    parts = []
    for group, title in GROUPS.items():
        parts.append(f"## {title}\n")
        parts += [_verb(verb, entry.what) for verb, entry in VERBS.items() if entry.group == group]
    return "\n".join(parts)


def _verb(verb: str, what: str) -> str:
    options = options_class(verb)
    inherited = {o.inherited for o in options_of(options)} - {None}
    own = [o for o in options_of(options) if o.inherited is None]
    parts = [f"### latentsafe {verb}\n", f"*{_escaped(what)}*\n", f"{_prose(inspect.getdoc(options) or '')}\n"]
    for parent in inherited:
        command = LEROBOTS[parent.__name__]
        parts.append(f"It has all options of `{command}` (see `{command} --help`), and:\n")
    if own:
        rows = [f"| `--{o.name}` | {_cell(o.kind)} | {_cell(o.default)} | {_escaped(o.text)} |" for o in own]
        parts.append("\n".join(["| Option | Value | Default | |", "|---|---|---|---|", *rows]) + "\n")
    return "\n".join(parts)


def _cell(text: str) -> str:
    return f"`{text}`".replace("|", "\\|") if text and text not in ("required", "a registered type") else text


def _escaped(text: str) -> str:
    """Text as Markdown, outside of its code spans: what would be markup is none; options become code."""
    text = re.sub(r"(?<![`\w])(--[\w.-]+(?:=[^\s,;:()`]+)?)(?![\w`])", r"`\1`", text)
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part.startswith("`") else re.sub(r"([<>*|_])", r"\\\1", part) for part in parts)


def _prose(text: str) -> str:
    """A docstring: paragraphs are text, what is indented or begins with a command is code."""
    paragraphs = []
    for paragraph in text.partition("\nAttributes:")[0].split("\n\n"):
        if paragraph.startswith(("    ", "latentsafe ")):
            paragraphs.append(f"```bash\n{inspect.cleandoc(paragraph)}\n```")
        else:
            paragraphs.append(_escaped(paragraph))
    return "\n\n".join(paragraphs)


def _fill(app, docname: str, source: list[str]) -> None:
    if PLACE in source[0]:
        source[0] = source[0].replace(PLACE, console_reference())


def setup(app) -> dict:
    """Sphinx calls this."""
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    app.connect("source-read", _fill)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
