"""Which options each verb has, read from a file: help, completion and misspelt options wait for no import of LeRobot.

`make options` writes the file by `option_classes.py`, and a test compares the two.
"""

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

FILE = Path(__file__).with_name("options.json")
OURS = "lerobot_policy_latentsafe"


class Described(Protocol):
    """What is said of an option, such as `--policy.path`.

    Attributes:
        name: without dashes.
        value: the type of its value, in a word.
        text: what it means.
        shown: its default, where that says something.
        needed: whether it must be given.
        choices: what a choice may be; of other options empty.
    """

    @property
    def name(self) -> str: ...
    @property
    def value(self) -> str: ...
    @property
    def text(self) -> str: ...
    @property
    def shown(self) -> str | None: ...
    @property
    def needed(self) -> bool: ...
    @property
    def choices(self) -> Sequence[str]: ...


@dataclass(frozen=True)
class KnownOption:
    """An option as the file describes it; see `Described`."""

    name: str
    value: str
    text: str = ""
    shown: str | None = None
    needed: bool = False
    choices: Sequence[str] = ()


@dataclass(frozen=True)
class KnownVerb:
    """A verb and its options.

    Attributes:
        text: what it is for, an example, and whatever else there is to say.
        options: those of choices that were made among them.
        renamed: old name of an option -> its present name.
    """

    text: str
    options: Sequence[Described]
    renamed: Mapping[str, str] = field(default_factory=dict)


def known_verb(verb: str, chosen: Mapping[str, str]) -> KnownVerb | None:
    """A verb by the file; None where it does not tell: LeRobot is of another version, or other plugins bring types.

    Args:
        chosen: what was chosen of the choices, `env.type` -> its name.
    """
    told = json.loads(FILE.read_text(encoding="utf-8"))
    if not _is_about(told["lerobot"]):
        return None
    entry = told["verbs"][verb]
    return KnownVerb(entry["text"], list(_options(told, entry["options"], chosen)), entry["renamed"])


def _is_about(version: str) -> bool:
    """Whether LeRobot is of this version here, and no other plugin of it is installed."""
    folders = (Path(folder) for folder in sys.path if folder)
    installed = {
        info.name.partition("-")[0]: info.name for folder in folders for info in folder.glob("lerobot*.dist-info")
    }
    return installed.keys() <= {"lerobot", OURS} and installed.get("lerobot") == f"lerobot-{version}.dist-info"


def _types(told: dict[str, Any], row: dict[str, Any]) -> dict[str, str]:
    """What an option may be -> the class that has its options; of an option that is no choice, nothing."""
    return told["choices"][row["choice"]] if "choice" in row else {}


def _options(
    told: dict[str, Any], rows: list[dict[str, Any]], chosen: Mapping[str, str], prefix: str = ""
) -> Iterator[KnownOption]:
    for row in rows:
        name, types = prefix + row["name"], _types(told, row)
        said = {key: value for key, value in row.items() if key != "choice"}
        yield KnownOption(**{**said, "name": name}, choices=sorted(types))
        if chosen.get(name) in types:  # what is not in there is a mistake, which the caller names
            yield from _options(told, told["types"][types[chosen[name]]], chosen, name.removesuffix("type"))
