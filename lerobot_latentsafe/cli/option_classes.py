"""Which options a verb has, as its class says, with the types that LeRobot's plugins bring.

That takes LeRobot, and with it seconds; `known_options.py` keeps what is found here for help and misspelt options.
"""

import importlib
import inspect
import textwrap
import typing
from collections.abc import Iterator
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from types import NoneType, UnionType
from typing import Any

from draccus import ChoiceType
from draccus.wrappers.docstring import get_attribute_docstring

from lerobot_latentsafe.cli import VERBS
from lerobot_latentsafe.cli.known_options import KnownVerb
from lerobot_latentsafe.migration import MOVED

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


def options_class(verb: str) -> type:
    """The class of a verb's options, which has a method `run`."""
    return getattr(importlib.import_module(VERBS[verb].module), VERBS[verb].name)


def described(verb: str, chosen: dict[str, str]) -> KnownVerb:
    """A verb as its class says; see `known_options.known_verb`."""
    options = options_class(verb)
    return KnownVerb(inspect.getdoc(options), list(options_of(options, chosen)), RENAMED.get(verb, {}))


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
    def value(self) -> str:
        """Its type in a word."""
        if self.choices:
            return "name"
        kind = self.kind if typing.get_args(self.kind) else getattr(self.kind, "__name__", self.kind)
        return str(kind).replace("typing.", "").replace("pathlib.", "")

    @property
    def needed(self) -> bool:
        """Whether it must be given."""
        return self.default is MISSING

    @property
    def shown(self) -> str | None:
        """Its default as it is typed, where that says something."""
        plain = isinstance(self.default, str | int | float | list | dict | Path) and len(str(self.default)) < 60
        text = str(self.default).lower() if isinstance(self.default, bool) else str(self.default)
        return text if plain and text not in ("", "[]", "{}") else None

    @property
    def choices(self) -> list[str]:
        """What a choice may be; of other options empty."""
        return sorted(self.kind.get_known_choices()) if _is_choice(self.kind) else []

    @cached_property
    def text(self) -> str:
        """What the code says of it, in its class or in one that this extends."""
        attribute = self.name.removesuffix(".type").rpartition(".")[2]
        classes = (kind for kind in self.owner.__mro__ if is_dataclass(kind))
        return next(filter(None, (_said_of(attribute, kind) for kind in classes)), "")


def _said_of(attribute: str, owner: type) -> str:
    """What stands on an attribute below it, in the text of its class, or above it."""
    try:
        found = get_attribute_docstring(owner, attribute)
    except (AssertionError, IndexError, RuntimeWarning):  # draccus cannot read every source
        return _attribute_text(owner, attribute)
    text = found.docstring_below or _attribute_text(owner, attribute) or found.comment_above
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


# -- what the file holds ---


def told() -> dict[str, Any]:
    """All verbs, choices and the options of what may be chosen, as `known_options.FILE` holds them."""
    options = {verb: list(options_of(options_class(verb))) for verb in VERBS}
    choices: dict[str, dict[str, str]] = {}
    types: dict[str, list[Option]] = {}
    for those in options.values():
        _collect(those, choices, types)
    verbs = {
        verb: {
            "text": inspect.getdoc(options_class(verb)),
            "renamed": RENAMED.get(verb, {}),
            "options": [_row(option) for option in those],
        }
        for verb, those in options.items()
    }
    as_rows = {name: [_row(option) for option in those] for name, those in sorted(types.items())}
    return {"lerobot": version("lerobot"), "verbs": verbs, "choices": dict(sorted(choices.items())), "types": as_rows}


def _collect(options: list[Option], choices: dict[str, dict[str, str]], types: dict[str, list[Option]]) -> None:
    """Add what these options may be, and the options that come with it."""
    for option in options:
        if option.choices and _full_name(option.kind) not in choices:
            known = option.kind.get_known_choices()
            choices[_full_name(option.kind)] = {name: _full_name(known[name]) for name in option.choices}
            for kind in known.values():
                types[_full_name(kind)] = list(options_of(kind))
                _collect(types[_full_name(kind)], choices, types)


def _row(option: Option) -> dict[str, Any]:
    choice = {"choice": _full_name(option.kind)} if option.choices else {}
    said = {"text": option.text, "shown": option.shown, "needed": option.needed}
    return {"name": option.name, "value": option.value, **{k: v for k, v in said.items() if v}, **choice}


def _full_name(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"
