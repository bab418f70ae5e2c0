"""Completion of what is typed in a shell: verbs, options, and the names that a choice may have.

A shell that has run `complete -o nospace -C "latentsafe completion" latentsafe` (bash, or zsh after `bashcompinit`)
starts `latentsafe completion` at each press of Tab, with the line in COMP_LINE and the cursor's place in COMP_POINT.
"""

import os

from lerobot_latentsafe.cli import RENAMED_VERBS, VERBS
from lerobot_latentsafe.cli.known_options import known_verb

HOW = """Complete verbs and options by the Tab key: put this line into ~/.bashrc, or into ~/.zshrc after
`autoload -U bashcompinit && bashcompinit`:

complete -o nospace -C "latentsafe completion" latentsafe"""


def complete() -> None:
    """Print what may stand at the cursor, one a line; where no shell asks, how to make it ask."""
    line = os.environ.get("COMP_LINE")
    if line is None:
        return print(HOW)
    print("\n".join(candidates(line[: int(os.environ.get("COMP_POINT", len(line)))])))


def candidates(line: str) -> list[str]:
    """What may stand in place of the last word of a line; after `=`, in place of what follows it."""
    done, _, last = line.rpartition(" ")
    words = done.split()[1:]
    if not words:
        return [f"{verb} " for verb in VERBS if verb.startswith(last)]
    verb = RENAMED_VERBS.get(words[0], words[0])
    pairs = [word.removeprefix("--").partition("=")[::2] for word in words[1:]]
    known = known_verb(verb, dict(pairs)) if verb in VERBS else None
    if known is None:
        return []
    name, equals, value = last.removeprefix("--").partition("=")
    if equals:
        return [
            f"{c} " for option in known.options if option.name == name for c in option.choices if c.startswith(value)
        ]
    given = {pair[0] for pair in pairs}
    return [f"--{o.name}=" for o in known.options if o.name not in given and f"--{o.name}".startswith(last)]
