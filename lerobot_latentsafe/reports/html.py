"""One self-contained HTML file: pictures, videos and their curves inside, opens from disk, prints."""

import base64
import html
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from lerobot_latentsafe.runtime.files import replacing

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
table { border-collapse: collapse; margin: 1rem 0; } td, th { padding: .3rem .8rem; text-align: left; }
th { border-bottom: 2px solid #222; } td { border-bottom: 1px solid #ddd; font-variant-numeric: tabular-nums; }
img, video { max-width: 100%; } figure { margin: 1.5rem 0; } figcaption { color: #555; font-size: .9rem; }
.note { background: #fff6e5; border-left: 4px solid #f0a030; padding: .6rem 1rem; }
.player video { display: block; width: 100%; max-width: 34rem; margin: 0 auto .5rem; }
.player svg { display: block; width: 100%; cursor: ew-resize; }
svg text { font: 11px system-ui, sans-serif; fill: #555; }
.strip { display: flex; gap: 3px; } .strip figure { margin: 0; flex: 1; text-align: center; }
.strip img { width: 100%; border: 3px solid transparent; image-rendering: pixelated; display: block; }
.strip .flagged img { border-color: #e8842c; } .strip figcaption { font-size: .75rem; }
@media print {
  body { margin: 0; max-width: none; font-size: 11pt; } video, .player video { display: none; }
  img { max-height: 10cm; } .strip img { max-height: none; }
  figure, table, .player, .strip { break-inside: avoid; } h2, h3, p:has(+ .strip) { break-after: avoid; }
}
@media screen { video ~ .strip { display: none; } }
"""

SCRIPT = """
for (const player of document.querySelectorAll(".player")) {
  const video = player.querySelector("video"), cursors = player.querySelectorAll(".cursor");
  const seconds = Number(player.dataset.seconds);
  const follow = () => {
    for (const c of cursors) {
      const x = LEFT + (WIDTH - LEFT) * Math.min(1, video.currentTime / seconds);
      c.setAttribute("x1", x); c.setAttribute("x2", x);
    }
    requestAnimationFrame(follow);
  };
  follow();
  for (const svg of player.querySelectorAll("svg")) svg.onclick = event => {
    const box = svg.getBoundingClientRect(), x = (event.clientX - box.left) / box.width * WIDTH;
    video.currentTime = Math.max(0, (x - LEFT) / (WIDTH - LEFT) * seconds);
  };
}
"""
WIDTH, LEFT, HEIGHT = 720, 70, 120
"""Size of a chart, and of the margin its numbers stand in."""
PRINTED = 4
"""Frames that stand for a video on paper."""
COLOURS = ("#1f6fb4", "#888888", "#2a9d5c", "#b0428f")


def paragraph(text: str, note: bool = False) -> str:
    """Text, in an orange box if it is a note."""
    return f"<p{' class=note' if note else ''}>{html.escape(text)}</p>"


def heading(text: str) -> str:
    """A heading of the second level."""
    return f"<h2>{html.escape(text)}</h2>"


def table(header: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """A table of plain text."""
    cells = lambda row, tag: "".join(f"<{tag}>{html.escape(str(c))}</{tag}>" for c in row)  # noqa: E731
    body = "".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
    return f"<table><tr>{cells(header, 'th')}</tr>{body}</table>"


def picture(path: Path, caption: str) -> str:
    """A PNG, embedded."""
    return _figure(f'<img alt="{html.escape(caption)}" src="data:image/png;base64,{_encoded(path)}">', caption)


def video(path: Path, caption: str) -> str:
    """An mp4, embedded; on paper a few of its frames."""
    source = f"data:video/mp4;base64,{_encoded(path)}"
    return _figure(f'<video controls loop muted autoplay src="{source}"></video>{_frames(path)}', caption)


def chart(
    series: dict[str, np.ndarray], fps: float, shaded: np.ndarray | None = None, level: float | None = None,
    limits: tuple[float, float] | None = None, note: str = "",
) -> str:  # fmt: skip
    """Curves over time as SVG.

    Args:
        series: name -> (T,); gaps where not finite.
        shaded: bool (T,), where the filter acted.
        level: a dashed horizontal line, such as epsilon.
        limits: of the vertical axis; by default what the curves span.
        note: said at the right end of the legend.
    """
    n = max(map(len, series.values()))
    finite = np.concatenate([np.asarray(v, float)[np.isfinite(v)] for v in series.values()])
    low, high = limits or (finite.min() - 0.05, finite.max() + 0.05)
    x = lambda t: LEFT + (WIDTH - LEFT) * t / max(1, n)  # noqa: E731
    y = lambda v: 18 + (HEIGHT - 34) * (high - np.clip(v, low, high)) / (high - low)  # noqa: E731
    parts = []
    for t in np.flatnonzero(shaded) if shaded is not None else ():
        parts.append(
            f'<rect x="{x(t):.1f}" y="18" width="{x(1) - x(0) + 0.4:.1f}" height="{HEIGHT - 34}" fill="#f7d3b2"/>'
        )
    for value in sorted({low, high} | ({0.0} if low < 0 < high else set())):
        parts.append(f'<line x1="{LEFT}" x2="{WIDTH}" y1="{y(value):.1f}" y2="{y(value):.1f}" stroke="#ddd"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{value:.2g}</text>')
    if level is not None:
        dashed = 'stroke="#333" stroke-dasharray="5 4"'
        parts.append(f'<line x1="{LEFT}" x2="{WIDTH}" y1="{y(level):.1f}" y2="{y(level):.1f}" {dashed}/>')
    legend = LEFT
    for colour, (name, values) in zip(COLOURS, series.items()):
        points = [(x(t + 0.5), y(v)) for t, v in enumerate(values) if np.isfinite(v)]
        path = " ".join(f"{px:.1f},{py:.1f}" for px, py in points)
        parts.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.8"/>')
        parts.append(f'<text x="{legend}" y="11" style="fill:{colour};font-weight:600">{html.escape(name)}</text>')
        legend += 7 * len(name) + 18
    parts.append(f'<text x="{WIDTH}" y="11" text-anchor="end">{html.escape(note)}</text>')
    parts.append(f'<text x="{WIDTH}" y="{HEIGHT - 3}" text-anchor="end">{n / fps:.1f} s</text>')
    parts.append(f'<text x="{LEFT}" y="{HEIGHT - 3}">0</text>')
    parts.append(f'<line class="cursor" x1="{LEFT}" x2="{LEFT}" y1="18" y2="{HEIGHT - 16}" stroke="#d22"/>')
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img">{"".join(parts)}</svg>'


def player(path: Path, charts: list[str], seconds: float, caption: str, printed: str = "") -> str:
    """A video with charts under it that share its time: a red line runs along, a click goes there.

    Args:
        seconds: length of the charts' time axis.
        printed: what stands for the video on paper.
    """
    source = f"data:video/mp4;base64,{_encoded(path)}"
    content = f'<video controls loop muted src="{source}"></video>{printed}{"".join(charts)}'
    return f'<div class=player data-seconds="{seconds:.4f}">{_figure(content, caption)}</div>'


def strip(images: list[np.ndarray], captions: list[str], flagged: list[bool] | None = None) -> str:
    """RGB pictures (H, W, 3), uint8, side by side; flagged ones in an orange frame."""
    import cv2

    cells = []
    for i, (image, caption) in enumerate(zip(images, captions)):
        encoded = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()
        source = f"data:image/png;base64,{base64.b64encode(encoded).decode()}"
        mark = " class=flagged" if flagged is not None and flagged[i] else ""
        cells.append(
            f'<figure{mark}><img alt="" src="{source}"><figcaption>{html.escape(caption)}</figcaption></figure>'
        )
    return f"<div class=strip>{''.join(cells)}</div>"


def _frames(path: Path) -> str:
    """A strip of frames from an mp4's beginning to its end."""
    import cv2

    film = cv2.VideoCapture(str(path))
    n, fps = int(film.get(cv2.CAP_PROP_FRAME_COUNT)), film.get(cv2.CAP_PROP_FPS)
    images, captions = [], []
    for index in np.unique(np.linspace(0, n - 1, PRINTED).round().astype(int)):
        film.set(cv2.CAP_PROP_POS_FRAMES, int(index))
        read, image = film.read()
        if read:
            images.append(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
            captions.append(f"{index / fps:.1f} s")
    film.release()
    return strip(images, captions)


def _figure(content: str, caption: str) -> str:
    return f"<figure>{content}<figcaption>{html.escape(caption)}</figcaption></figure>"


def _encoded(path: Path) -> str:
    return base64.b64encode(Path(path).read_bytes()).decode()


def write_report(path: str | Path, title: str, parts: list[str]) -> None:
    """Write the page; one that was there stays until this one is whole."""
    head = f"<!doctype html><html lang=en><meta charset=utf-8><title>{html.escape(title)}</title><style>{STYLE}</style>"
    script = SCRIPT.replace("WIDTH", str(WIDTH)).replace("LEFT", str(LEFT))
    body = f"<h1>{html.escape(title)}</h1>{''.join(parts)}<script>{script}</script>"
    with replacing(path) as partial:
        partial.write_text(f"{head}{body}</html>", encoding="utf-8")
