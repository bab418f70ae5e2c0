#!/usr/bin/env python
"""Writes the options of all verbs to lerobot_latentsafe/cli/options.json, by which help comes at once."""

import argparse
import json
from typing import Any

from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_latentsafe.cli.known_options import FILE
from lerobot_latentsafe.cli.option_classes import told


def as_json(value: Any, depth: int = 0) -> str:
    """JSON with an option a line, so that changes can be read."""
    if not isinstance(value, dict | list) or not value or "name" in value:
        return json.dumps(value, ensure_ascii=False)
    line = "\n" + " " * (depth + 1)
    if isinstance(value, list):
        return f"[{line}{f',{line}'.join(as_json(entry, depth + 1) for entry in value)}]"
    entries = (f"{json.dumps(key)}: {as_json(entry, depth + 1)}" for key, entry in value.items())
    return f"{{{line}{f',{line}'.join(entries)}}}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--check", action="store_true", help="write nothing, and fail if the file is not as it should be"
    )
    check = parser.parse_args().check
    register_third_party_plugins()
    text = as_json(told()) + "\n"
    if not check:
        FILE.write_text(text, encoding="utf-8")
    elif FILE.read_text(encoding="utf-8") != text:
        raise SystemExit(f"{FILE.name} is not what the option classes say: run make options, and commit it")


if __name__ == "__main__":
    main()
