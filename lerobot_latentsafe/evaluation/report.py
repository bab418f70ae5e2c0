"""One self-contained HTML file: pictures and videos inside, opens from disk."""

import base64
import html
from pathlib import Path

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; margin: 1rem 0; } td, th { padding: .3rem .8rem; text-align: left; }
th { border-bottom: 2px solid #222; } td { border-bottom: 1px solid #ddd; font-variant-numeric: tabular-nums; }
img, video { max-width: 100%; } figure { margin: 1.5rem 0; } figcaption { color: #555; font-size: .9rem; }
.note { background: #fff6e5; border-left: 4px solid #f0a030; padding: .6rem 1rem; }
"""


def paragraph(text: str, note: bool = False) -> str:
    return f"<p{' class=note' if note else ''}>{html.escape(text)}</p>"


def heading(text: str) -> str:
    return f"<h2>{html.escape(text)}</h2>"


def table(header: list[str], rows: list[list[str]]) -> str:
    """A table of plain strings."""
    cells = lambda row, tag: "".join(f"<{tag}>{html.escape(str(c))}</{tag}>" for c in row)  # noqa: E731
    body = "".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
    return f"<table><tr>{cells(header, 'th')}</tr>{body}</table>"


def picture(path: Path, caption: str) -> str:
    """A PNG, embedded."""
    return _figure(f'<img alt="{html.escape(caption)}" src="data:image/png;base64,{_encoded(path)}">', caption)


def video(path: Path, caption: str) -> str:
    """An mp4, embedded."""
    source = f"data:video/mp4;base64,{_encoded(path)}"
    return _figure(f'<video controls loop muted autoplay src="{source}"></video>', caption)


def _figure(content: str, caption: str) -> str:
    return f"<figure>{content}<figcaption>{html.escape(caption)}</figcaption></figure>"


def _encoded(path: Path) -> str:
    return base64.b64encode(Path(path).read_bytes()).decode()


def share(rate: dict[str, float]) -> str:
    """`12/200 = 6.0% [3.5, 10.2]` from a Wilson record."""
    k, n = rate["k"], rate["n"]
    return f"{k}/{n} = {k / n:.1%} [{100 * rate['low']:.1f}, {100 * rate['high']:.1f}]"


def write_report(path: str | Path, title: str, parts: list[str]) -> None:
    """Write the page."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    head = f"<!doctype html><html lang=en><meta charset=utf-8><title>{html.escape(title)}</title><style>{STYLE}</style>"
    Path(path).write_text(f"{head}<h1>{html.escape(title)}</h1>{''.join(parts)}</html>", encoding="utf-8")
