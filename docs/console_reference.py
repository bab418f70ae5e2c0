"""Makes the references of options from the option classes: a Sphinx extension, and what tests ask for known options.

In a page the line `<!-- console-reference -->` becomes the reference of all verbs, and
`<!-- options: lerobot_latentsafe.decision.LawConfig -->` a table of the fields of a class.
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

VERBS_HERE, OPTIONS_HERE = "<!-- console-reference -->", re.compile(r"<!-- options: ([\w.]+)\.(\w+) -->")
GROUPS = {
    "record": "Record",
    "label": "Label",
    "train": "Train",
    "deploy": "Deploy",
    "evaluate": "Evaluate",
}
LEROBOTS = {"RecordConfig": "lerobot-record", "TeleoperateConfig": "lerobot-teleoperate"}
"""Option classes of LeRobot that verbs extend, and the command that has the same options."""


IN_WORDS = ("required", "a registered type", "a group", "your name on this machine")
"""What stands in a table for a value that is not written as it is."""


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


def options_of(options: type, prefix: str = "", inherited: type | None = None, groups: bool = True) -> Iterator[Option]:
    """All options of an option class, those of its groups, too, if wanted; a registry's are left to its own page."""
    hints = typing.get_type_hints(options)
    for field in fields(options):
        if not field.init or field.name.startswith("_"):
            continue
        kind, name = plain(hints[field.name]), f"{prefix}{field.name}"
        brought = inherited or _inherited(options, field)
        if groups and is_dataclass(kind) and not is_registry(kind):
            yield from options_of(kind, f"{name}.", brought)
        else:
            shown = f"{name}.type" if is_registry(kind) else name
            yield Option(shown, _kind(kind), _default(field), _text(options, field), brought)


def plain(kind: type) -> type:
    """X of `X | None`."""
    if typing.get_origin(kind) in (typing.Union, UnionType):
        return typing.Union[tuple(k for k in typing.get_args(kind) if k is not type(None))]  # noqa: UP007
    return kind


def is_registry(kind: type) -> bool:
    """Whether options choose among registered classes, as `--env.type=...` does."""
    return inspect.isclass(kind) and issubclass(kind, ChoiceRegistry)


def _kind(kind: type) -> str:
    if is_registry(kind):
        return "a registered type"
    if inspect.isclass(kind) and issubclass(kind, Path):
        return "path"
    if is_dataclass(kind):
        return "a group"
    name = kind.__name__ if inspect.isclass(kind) and not typing.get_args(kind) else str(kind)
    return re.sub(r"\b(?:\w+\.)+(?=\w)", "", name)


def _default(field: Field) -> str:
    if field.default is not MISSING:
        return "" if field.default is None else str(field.default)
    if field.default_factory is MISSING:
        return "required"
    if field.default_factory.__module__ == "getpass":
        return "your name on this machine"
    made = field.default_factory()
    return "" if is_dataclass(made) or made in ([], {}) or "<" in str(made) else str(made)


def _inherited(options: type, field: Field) -> type | None:
    """LeRobot's class that brings this option, if one does."""
    origin = next(kind for kind in options.__mro__ if field.name in inspect.get_annotations(kind))
    return origin if origin.__module__.startswith("lerobot.") else None


def _text(options: type, field: Field) -> str:
    """What the code says of an option: below it, above it, or in its class's text."""
    found = get_attribute_docstring(options, field.name)
    beside = (found.docstring_below, found.comment_above, found.comment_inline)
    described = (_attribute(kind, field.name) for kind in options.__mro__ if kind.__doc__)
    return next((" ".join(text.split()) for text in (*beside, *described) if text.strip()), "")


def _attribute(options: type, name: str) -> str:
    """The lines on an attribute under `Attributes:` in a class's text."""
    section = inspect.cleandoc(options.__doc__).partition("Attributes:\n")[2]
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
    parts = [f"### latentsafe {verb}\n", f"{_prose((options.__doc__ and inspect.getdoc(options)) or what)}\n"]
    for command in (LEROBOTS[parent.__name__] for parent in inherited if parent.__name__ in LEROBOTS):
        parts.append(f"It has all options of `{command}` (see `{command} --help`), and:\n")
    return "\n".join([*parts, _table(own, "--")])


def class_reference(options: type) -> str:
    """What a class of options says of itself, and a table of its fields, in MyST."""
    own = [o for o in options_of(options, groups=False) if o.inherited is None]
    return f"{_prose(inspect.getdoc(options) or '').rstrip()}\n\n{_table(own, '')}"


def _table(options: list[Option], dashes: str) -> str:
    rows = [f"| `{dashes}{o.name}` | {_cell(o.kind)} | {_cell(o.default)} | {_escaped(o.text)} |" for o in options]
    return "\n".join(["| Option | Value | Default | Meaning |", "|---|---|---|---|", *rows]) + "\n" if rows else ""


def _cell(text: str) -> str:
    return text if text in IN_WORDS or not text else f"`{text}`".replace("|", "\\|")


def _escaped(text: str) -> str:
    """Text as Markdown: outside of its code spans options become code, and what would be markup is none."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part.startswith("`") else _plain_text(part) for part in parts)


def _plain_text(text: str) -> str:
    option = r"(?<![\w-])(--\w+(?:[\w.-]*\w)?(?:=[^\s,;:()]*[^\s,;:().])?)"
    parts = re.split(option, text)
    return "".join(f"`{part}`" if i % 2 else re.sub(r"([<>*|_])", r"\\\1", part) for i, part in enumerate(parts))


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
    if VERBS_HERE in source[0]:
        source[0] = source[0].replace(VERBS_HERE, console_reference())
    source[0] = OPTIONS_HERE.sub(
        lambda found: class_reference(getattr(importlib.import_module(found[1]), found[2])), source[0]
    )


def setup(app) -> dict:
    """Sphinx calls this."""
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    app.connect("source-read", _fill)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
