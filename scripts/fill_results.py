#!/usr/bin/env python3
"""Puts numbers of results/ into README.md and docs/**/*.md, so that no page can show an old one.

    scripts/fill_results.py               rewrite the pages in place
    scripts/fill_results.py --check       write nothing; exit 1 and say what differs (`make test` runs this)
    scripts/fill_results.py --show EXPR   print what one expression gives

In a page, a number stands between two comments. Write them with nothing in between and run the script:

    <!--=results/bag/policies.json weak/reachability/pooled/spilled rate-->3% [1, 8]<!--/-->

The first comment holds FILE PATH [REDUCTION] FORMAT, separated by spaces.

FILE       a .json, .jsonl or .csv file, from the root of the repository
PATH       keys separated by slashes; keys may hold spaces and dots. A slash within a key is %2F: `shuffled %2F true`.
           In a list an index, from the end if negative. In .jsonl the line comes first (`-1/cpu_s`), in .csv the row,
           by its first column, then the column (`tokens_bag/user_s`).
           Several entries: `*` is all keys or items, `{a,b}` is alternatives, in FILE, too. They are shown with commas
           in between, unless a reduction makes one number of them.
REDUCTION  sum, mean, min, max, ratio (the first over the second), difference (the first minus the second)
FORMAT     .N is the number of decimals, 0 if not given:
    text         as it stands                                              bag
    int          rounded, thousands separated                              26,030
    fixed.2      a number                                                  2.26
    percent.1    a share, or a rate {k, n}                                 14.2%
    points.1     the same without the sign                                 14.2
    of           a rate {k, n}                                             4 of 120
    rate         a rate {k, n, low, high}, its interval in percent         3% [1, 8]
    spread.3     {mean or median, low, high}                               0.990 [0.989, 0.990]
    spread_percent.1   the same, of shares                                 99.6% [99.1, 100.0]
    factor.1     how many times as much                                    2.4×
    p            a p value, rounded up to one digit                        3e-7
    minutes.1    of seconds                                                11.4

More examples:

    <!--=results/bag/policies.json {weak,strong}/bare/spilled of-->25 of 40, 2 of 40<!--/-->
    <!--=results/bag/policies.json strong/reachability/outputs%2Fbag%2Ffinal_{0,1,2}/success/k int-->26, 27, 25<!--/-->
    <!--=results/dubins/shield_reckless_{0,1,2}.json shielded/overridden_share mean percent.1-->23.4%<!--/-->
    <!--=results/bag/cost.csv {tokens_bag,world_model_0}/{user_s,system_s} sum minutes-->26<!--/-->

A marker must not begin a line or a list item (Markdown would take the whole line for HTML), and must not stand within
`code` (Markdown would show it). Blocks of code are left alone.

--check also refuses a results/**/*.json that lacks command, commit, seeds or cpu_minutes, or names a commit that is not
in the history of HEAD.
"""

import argparse
import csv
import functools
import itertools
import json
import math
import re
import subprocess
import sys
import urllib.parse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PROVENANCE = ("command", "commit", "seeds", "cpu_minutes")
FENCE = re.compile(r"\s*(?P<fence>`{3,}|~{3,})(?P<info>.*)")
IN_CODE = re.compile(r"<!--\s*=\s*(?P<expression>results/.*?)-->", re.DOTALL)
SPAN = re.compile(r"(?<!`)(?P<ticks>`{1,2})(?!`)(?:(?!\n\s*\n).)+?(?<!`)(?P=ticks)(?!`)", re.DOTALL)
TOKEN = re.compile(r"<!--\s*=(?P<expression>.*?)(?:-->|\Z)|<!--\s*/\s*-->", re.DOTALL)
LINE_START = re.compile(r"\s*(?:[-*+>]\s+|\d+[.)]\s+)*")


class PageError(Exception):
    """What is wrong with an expression or a marker, and the remedy, in one line."""


@dataclass
class Marker:
    """An expression in a page and the place of what is shown for it."""

    expression: str
    line: int
    start: int
    end: int


# Reading results


@functools.cache
def read(file: Path) -> Any:
    """What a results file holds: of .jsonl a list, of .csv a dictionary of rows by their first column."""
    try:
        text = file.read_text()
        if file.suffix == ".json":
            return json.loads(text)
        if file.suffix == ".jsonl":
            return [json.loads(line) for line in text.splitlines() if line]
    except ValueError as error:
        raise PageError(f"{file.name} cannot be read ({error}); make it again") from None
    if file.suffix == ".csv":
        return {next(iter(row.values())): row for row in csv.DictReader(text.splitlines())}
    raise PageError(f"{file.name} is no .json, .jsonl or .csv; name one of these")


def alternatives(text: str) -> list[str]:
    """`a{b,c}d` -> [`abd`, `acd`]; several braces give all combinations, the last one fastest."""
    parts = re.split(r"\{([^{}]*)\}", text)
    choices = (part.split(",") if i % 2 else [part] for i, part in enumerate(parts))
    return ["".join(choice) for choice in itertools.product(*choices)]


def entries(value: Any, keys: list[str], seen: str) -> list[Any]:
    """All entries below a value that a path of keys reaches; `seen` is where the value stands."""
    if not keys:
        return [value]
    key, rest = urllib.parse.unquote(keys[0]), keys[1:]
    if isinstance(value, list):
        inside = {str(i): item for i, item in enumerate(value)}
        key = str(len(value) + int(key)) if re.fullmatch(r"-\d+", key) else key
    elif isinstance(value, dict):
        inside = value
    else:
        raise PageError(f"{seen} is {value!r} and holds no {key!r}; end the path there")
    if key == "*":
        return [found for name, item in inside.items() for found in entries(item, rest, f"{seen}/{name}")]
    if key not in inside:
        known = ", ".join(map(urllib.parse.quote_plus, list(inside)[:12])).replace("+", " ")
        raise PageError(f"{seen} holds no {key!r}; it holds {known}{', ...' if len(inside) > 12 else ''}")
    return entries(inside[key], rest, f"{seen}/{key}")


# Formats


def number(value: Any) -> float:
    """A number, also one that a CSV holds as text."""
    try:
        return float(value)
    except (TypeError, ValueError):
        shown = "an object" if isinstance(value, dict) else "a list" if isinstance(value, list) else repr(value)
        raise PageError(f"the entry is {shown}, no number; lengthen the path or take another format") from None


def field(value: Any, *names: str) -> float:
    """The number that an entry holds under the first of some names that it has."""
    for name in names:
        if isinstance(value, dict) and name in value:
            return number(value[name])
    raise PageError(f"the entry holds no {' or '.join(names)}; take another path or another format")


def share(value: Any) -> float:
    """A share, or k / n of a rate."""
    return field(value, "k") / field(value, "n") if isinstance(value, dict) else number(value)


def spread(value: Any, n: int, scale: float = 1, sign: str = "") -> str:
    """Middle [low, high]."""
    middle, low, high = (scale * field(value, *names) for names in (("mean", "median"), ("low",), ("high",)))
    return f"{middle:.{n}f}{sign} [{low:.{n}f}, {high:.{n}f}]"


def p_value(value: Any, n: int) -> str:
    """One digit, rounded up, so that `p <=` holds."""
    p = number(value)
    if p <= 0:
        return "0"
    exponent = math.floor(math.log10(p))
    digit = math.ceil(p / 10.0**exponent - 1e-9)
    digit, exponent = (1, exponent + 1) if digit == 10 else (digit, exponent)
    return f"{digit}e{exponent}" if exponent < -3 else f"{digit * 10.0**exponent:.{max(0, -exponent)}f}"


def rate(value: Any, n: int) -> str:
    """Percent of a rate with its interval."""
    return f"{100 * share(value):.{n}f}% [{100 * field(value, 'low'):.{n}f}, {100 * field(value, 'high'):.{n}f}]"


FORMATS: dict[str, Callable[[Any, int], str]] = {
    "text": lambda value, n: str(value),
    "int": lambda value, n: f"{round(number(value)):,}",
    "fixed": lambda value, n: f"{number(value):.{n}f}",
    "percent": lambda value, n: f"{100 * share(value):.{n}f}%",
    "points": lambda value, n: f"{100 * share(value):.{n}f}",
    "of": lambda value, n: f"{field(value, 'k'):,.0f} of {field(value, 'n'):,.0f}",
    "rate": rate,
    "spread": spread,
    "spread_percent": lambda value, n: spread(value, n, 100, "%"),
    "factor": lambda value, n: f"{number(value):.{n}f}×",
    "p": p_value,
    "minutes": lambda value, n: f"{number(value) / 60:.{n}f}",
}
REDUCTIONS: dict[str, Callable[[list[float]], float]] = {
    "sum": sum,
    "mean": lambda values: sum(values) / len(values),
    "min": min,
    "max": max,
    "ratio": lambda values: divided(*two(values)),
    "difference": lambda values: two(values)[0] - two(values)[1],
}


def two(values: list[float]) -> list[float]:
    """Exactly two numbers."""
    if len(values) != 2:
        raise PageError(f"ratio and difference take two entries, not {len(values)}; write {{first,second}} in the path")
    return values


def divided(a: float, b: float) -> float:
    """Their ratio."""
    if not b:
        raise PageError("the second entry is 0; nothing can be divided by it")
    return a / b


def evaluate(expression: str, root: Path) -> str:
    """What an expression gives.

    Raises:
        PageError: an unknown file, key, reduction or format.
    """
    words = expression.split()
    if len(words) < 3:
        raise PageError("an expression is FILE PATH [REDUCTION] FORMAT; scripts/fill_results.py --help has examples")
    name, _, decimals = words[-1].partition(".")
    if name not in FORMATS or not re.fullmatch(r"\d?", decimals):
        raise PageError(f"{words[-1]!r} is no format; take one of {', '.join(FORMATS)}, with .N for decimals")
    reduction = REDUCTIONS.get(words[-2]) if len(words) > 3 else None
    path = " ".join(words[1 : -2 if reduction else -1])
    found = []
    for file, keys in itertools.product(alternatives(words[0]), alternatives(path)):
        if not (root / file).is_file():
            raise PageError(f"{file} is missing; make it (docs/results names the commands) or correct the path")
        found += entries(read(root / file), keys.split("/"), file)
    if reduction and found:
        found = [reduction([share(value) for value in found])]
    return ", ".join(FORMATS[name](value, int(decimals or 0)) for value in found)


# Pages


def pages(root: Path) -> list[Path]:
    """README.md and docs/**/*.md, not what Sphinx built."""
    docs = sorted(p for p in (root / "docs").rglob("*.md") if "_build" not in p.relative_to(root).parts)
    return [p for p in (root / "README.md", *docs) if p.is_file()]


def without_blocks(text: str) -> str:
    """A page with spaces in its blocks of code. MyST directives (```{note}) hold no code, code cells do."""
    lines: list[str] = []
    fences: list[tuple[str, bool]] = []  # the open ones, and whether they hold code
    for line in text.splitlines(keepends=True):
        fence, inside = FENCE.match(line), bool(fences) and fences[-1][1]
        if fence and fences and fence["fence"].startswith(fences[-1][0]) and not fence["info"].strip():
            fences.pop()
        elif fence and not inside:
            info = fence["info"].strip()
            fences.append((fence["fence"], not info.startswith("{") or info.startswith("{code")))
        lines.append(blank(line) if fence or inside else line)
    return "".join(lines)


def blank(text: str) -> str:
    """As many spaces, on as many lines."""
    return re.sub(r"[^\n]", " ", text)


def markers(text: str) -> Iterator[Marker | tuple[int, str, str]]:
    """Each marker of a page; of one that is not well-formed its line, its expression and what is wrong with it."""
    text = without_blocks(text)
    for span in SPAN.finditer(text):
        for token in IN_CODE.finditer(span[0]):
            line = text.count("\n", 0, span.start() + token.start()) + 1
            yield line, token["expression"], "the marker stands within `code`, which would show it; put it outside"
    text = SPAN.sub(lambda span: blank(span[0]), text)
    tokens = [*TOKEN.finditer(text)]
    for token, following in zip(tokens, [*tokens[1:], None]):
        line, expression = text.count("\n", 0, token.start()) + 1, token["expression"]
        closed = following is not None and following["expression"] is None
        if expression is None:
            continue
        shown = " ".join(expression.split("<!--")[0].split())
        if "<!--" in expression or not closed or "\n\n" in text[token.end() : following.start()]:
            yield line, shown, "the marker is not closed; write <!--/--> after the number"
        elif LINE_START.fullmatch(text[text.rfind("\n", 0, token.start()) + 1 : token.start()]):
            yield line, shown, "the marker begins its line, which Markdown takes for HTML; put a word before it"
        else:
            yield Marker(shown, line, token.end(), following.start())
    for before, token in zip([None, *tokens], tokens):
        if token["expression"] is None and (before is None or before["expression"] is None):
            yield text.count("\n", 0, token.start()) + 1, "<!--/-->", "it closes no marker; remove it"


def fill(text: str, root: Path) -> tuple[str, list[tuple[int, str]], list[tuple[int, str]]]:
    """A page with its numbers put in, what differed, and what is wrong with it, each with its line."""
    parts, position, changed, wrong = [], 0, [], []
    for marker in markers(text):
        if not isinstance(marker, Marker):
            wrong.append((marker[0], f"{marker[1]}: {marker[2]}"))
            continue
        try:
            new = evaluate(marker.expression, root)
        except PageError as error:
            wrong.append((marker.line, f"{marker.expression}: {error}"))
            continue
        old = text[marker.start : marker.end]
        if new != old:
            changed.append((marker.line, f"{marker.expression}: {old!r} stands there, the results say {new!r}"))
        parts += [text[position : marker.start], new]
        position = marker.end
    return "".join([*parts, text[position:]]), changed, wrong


# Where results come from


def history(root: Path) -> list[str] | str:
    """All commits up to HEAD, or why they are not known."""
    if not (root / ".git").exists():
        return "there is no git repository here"
    try:
        git = functools.partial(subprocess.run, cwd=root, capture_output=True, text=True, check=True)
        if git(["git", "rev-parse", "--is-shallow-repository"]).stdout.strip() == "true":
            return "this is a shallow clone"
        return git(["git", "rev-list", "HEAD"]).stdout.split()
    except (OSError, subprocess.CalledProcessError) as error:
        return f"git does not answer ({error})"


def commits_of(value: Any) -> Iterator[str]:
    """Every `commit` in a results file, at any depth."""
    if isinstance(value, dict):
        yield from (str(value["commit"]),) if "commit" in value else ()
        for item in value.values():
            yield from commits_of(item)


def unfounded(root: Path) -> list[str]:
    """What is wrong with where results/**/*.json come from, a line each."""
    known, wrong = history(root), []
    if isinstance(known, str):
        print(f"Commits of results were not looked up: {known}.", file=sys.stderr)
    for file in sorted((root / "results").rglob("*.json")):
        name = file.relative_to(root)
        try:
            content = read(file)
        except PageError as error:
            wrong.append(f"{name}: {error}")
            continue
        missing = [key for key in PROVENANCE if not isinstance(content, dict) or key not in content]
        if missing:
            wrong.append(f"{name}: lacks {', '.join(missing)}; make it again with the script that writes them")
        lost = [
            c for c in commits_of(content) if not isinstance(known, str) and not any(k.startswith(c) for k in known)
        ]
        wrong += [f"{name}: commit {c} is not in the history of HEAD; make it again from one that is" for c in lost]
    return wrong


def check(root: Path) -> list[str]:
    """Everything that is wrong with the pages and results of a repository, a line each."""
    lines = []
    for page in pages(root):
        _, changed, wrong = fill(page.read_text(), root)
        lines += [f"{page.relative_to(root)}:{line}: {what}" for line, what in sorted(wrong + changed)]
        if changed:
            lines.append(f"{page.relative_to(root)}: run scripts/fill_results.py and read what it changed")
    return lines + unfounded(root)


def rewrite(root: Path) -> list[str]:
    """Put the numbers into all pages; what could not be filled, a line each."""
    lines = []
    for page in pages(root):
        text = page.read_text()
        new, changed, wrong = fill(text, root)
        if new != text:
            page.write_text(new)
            print(f"{page.relative_to(root)}: {len(changed)} numbers changed")
        lines += [f"{page.relative_to(root)}:{line}: {what}" for line, what in wrong]
    return lines


def main(argv: list[str] | None = None) -> int:
    """The command line; 1 where something is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing, fail where a page or a result is wrong")
    parser.add_argument("--show", metavar="EXPR", help="print what an expression gives")
    parser.add_argument("--root", type=Path, default=Path(__file__).parents[1], help="of the repository")
    args = parser.parse_args(argv)
    read.cache_clear()
    try:
        lines = [] if args.show else check(args.root) if args.check else rewrite(args.root)
        if args.show:
            print(evaluate(args.show, args.root))
    except PageError as error:
        lines = [f"{args.show}: {error}"]
    print("\n".join(lines), file=sys.stderr, end="\n" if lines else "")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
