"""The labelling page's server: a few fixed addresses behind a token, for one person's browser on the same machine.

Nothing a browser sends is ever used as a path: episodes and cameras are numbers that are looked up, specifications are
names that must be known already, and the page's own three files are read before the first request.
"""

import hmac
import json
import re
import secrets
import socket
import struct
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route

from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.labeling.store import ConflictError, LabelStore
from lerobot_latentsafe.labeling.suggestions import Suggester, contradiction

PAGE = Path(__file__).parent / "page"
STATIC = {
    "": ("index.html", "text/html"),
    "page.js": ("page.js", "text/javascript"),
    "page.css": ("page.css", "text/css"),
}
MAX_BODY = 4096
PIECE = 32
"""Frames that the page asks for together."""
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class Guard:
    """Lets through what comes from the page itself: right token, right host, right origin, small body.

    Args:
        hosts: names and addresses by which this server may be called; others are DNS rebinding.
    """

    def __init__(self, app, token: str, hosts: set[str]):
        self.app, self.token, self.hosts = app, token, hosts

    async def __call__(self, scope, receive, send):
        if scope["type"] != "http":
            return await self.app(scope, receive, send) if scope["type"] == "lifespan" else None
        refusal = self._refusal(Request(scope))

        async def send_guarded(message):
            if message["type"] == "http.response.start":
                message["headers"] = [
                    *message["headers"],
                    *((k.lower().encode(), v.encode()) for k, v in HEADERS.items()),
                ]
            await send(message)

        if refusal is not None:
            return await refusal(scope, receive, send_guarded)
        await self.app(scope, receive, send_guarded)

    def _refusal(self, request: Request) -> Response | None:
        host, origin = request.headers.get("host", ""), request.headers.get("origin")
        if _host_name(host) not in self.hosts:
            return PlainTextResponse("wrong host", 403)
        given = request.scope["path"].removeprefix("/").partition("/")[0]  # "*" is a path, too
        if not hmac.compare_digest(given.encode(errors="replace"), self.token.encode()):
            return PlainTextResponse("open the address that latentsafe label printed", 403)
        if origin is not None and origin.partition("://")[2] != host:
            return PlainTextResponse("wrong origin", 403)
        if request.method not in ("GET", "HEAD"):
            if origin is None or request.headers.get("sec-fetch-site", "same-origin") != "same-origin":
                return PlainTextResponse("wrong origin", 403)
            if request.headers.get("content-type") != "application/json":
                return PlainTextResponse("expected application/json", 415)
        return None


HOST = re.compile(r"(?:\[([0-9a-f:.%]+)\]|([0-9a-z.-]+))(?::\d{1,5})?")
"""A host, and perhaps a port, as a browser writes them."""


def _host_name(host: str) -> str:
    found = HOST.fullmatch(host.lower())
    return (found[1] or found[2]) if found else ""


class LabelServer:
    """The endpoints. `changes` is a log of episodes whose entry changed, which tabs poll."""

    def __init__(self, store: LabelStore, frames: DatasetFrames, user: str, suggester: Suggester | None = None):
        self.store, self.frames, self.user, self.suggester = store, frames, user, suggester
        self.changes: list[tuple[str | None, int]] = []

    def app(self, token: str, hosts: set[str]) -> Guard:
        """The ASGI application."""
        routes = [Route(f"/{name}", self._static(*file)) for name, file in STATIC.items()]
        routes += [
            Route("/api/dataset", self.dataset),
            Route("/api/labels/{specification}", self.labels),
            Route("/api/labels/{specification}", self.label, methods=["POST"]),
            Route("/api/marks/{specification}", self.mark, methods=["POST"]),
            Route("/api/undo/{specification}", self.undo, methods=["POST"]),
            Route("/api/frames/{camera:int}/{episode:int}", self.episode_frames),
            Route("/api/margin/{episode:int}", self.margin),
        ]
        errors = {ConflictError: _refuse(409), OSError: _refuse(507), ValueError: _refuse(400)}
        return Guard(Starlette(routes=[Mount(f"/{token}", routes=routes)], exception_handlers=errors), token, hosts)

    @staticmethod
    def _static(name: str, media_type: str):
        content = (PAGE / name).read_bytes()
        return lambda request: Response(content, media_type=media_type)

    def dataset(self, request: Request) -> Response:
        """What the page needs to know of the dataset."""
        meta = self.frames.meta
        return JSONResponse(
            {
                "repo_id": meta.repo_id,
                "identity": self.store.identity,
                "fps": meta.fps,
                "cameras": self.frames.cameras,
                "piece": PIECE,
                "lengths": self.store.length.tolist(),
                "tasks": [", ".join(tasks) for tasks in meta.episodes["tasks"]],
                "specifications": self.store.specifications,
                "user": self.user,
                "suggestions": self.suggester is not None,
            }
        )

    def labels(self, request: Request) -> Response:
        """Entries of all episodes, or with ?since=n of those changed after the n-th change."""
        specification, now = self._specification(request), len(self.changes)
        since = request.query_params.get("since")
        if since is None:
            episodes = range(len(self.store))
        else:
            new = self.changes[_number(since, "since", now) : now]
            episodes = sorted({episode for name, episode in new if name in (None, specification)})
        return JSONResponse({"changes": now, "entries": [self._entry(specification, e) for e in episodes]})

    async def label(self, request: Request) -> Response:
        """Set a verdict; it is on disk when the answer comes."""
        specification, asked = self._specification(request), await _body(request)
        episode = _number(asked.get("episode"), "episode", len(self.store) - 1)
        first = asked.get("first")
        if first is not None:
            first = _number(first, "first", int(self.store.length[episode]))
        seen, tab = _number(asked.get("seen"), "seen", 2**53), _text(asked.get("tab"))
        await run_in_threadpool(self.store.label, specification, episode, first, self.user, seen, tab)
        return self._changed(specification, episode)

    async def mark(self, request: Request) -> Response:
        """Mark one frame alone as failing, or take that back; it is on disk when the answer comes."""
        specification, asked = self._specification(request), await _body(request)
        episode = _number(asked.get("episode"), "episode", len(self.store) - 1)
        frame = _number(asked.get("frame"), "frame", int(self.store.length[episode]) - 1)
        seen, tab = _number(asked.get("seen"), "seen", 2**53), _text(asked.get("tab"))
        await run_in_threadpool(self.store.mark, specification, episode, frame, self.user, seen, tab)
        return self._changed(specification, episode)

    async def undo(self, request: Request) -> Response:
        """Take back the tab's last change."""
        specification, tab = self._specification(request), _text((await _body(request)).get("tab"))
        undone = await run_in_threadpool(self.store.undo, specification, tab)
        return self._changed(specification, undone[0]) if undone else JSONResponse({"entry": None})

    def episode_frames(self, request: Request) -> Response:
        """Frames of one camera: the count, the size of each, then the pictures (little-endian uint32).

        All of them; or with ?first=n&count=k so many from the n-th on; or with ?spread=k so many, evenly spread.
        """
        camera = _number(request.path_params["camera"], "camera", len(self.frames.cameras) - 1)
        episode = _number(request.path_params["episode"], "episode", len(self.store) - 1)
        length, asked = int(self.store.length[episode]), request.query_params
        if "spread" in asked:
            spread = _number(asked["spread"], "spread", length)
            numbers = [int((i + 0.5) * length / spread) for i in range(spread)]
        else:
            first = _number(asked.get("first", 0), "first", length - 1)
            count = _number(asked.get("count", length), "count", length)
            numbers = [*range(first, min(first + count, length))]
        pictures = self.frames.encoded(self.frames.cameras[camera], episode, numbers)
        sizes = struct.pack(f"<{len(pictures) + 1}I", len(pictures), *map(len, pictures))
        return Response(sizes + b"".join(pictures), media_type="application/octet-stream")

    def margin(self, request: Request) -> Response:
        """The filter's margin along an episode, if it has judged it."""
        episode = _number(request.path_params["episode"], "episode", len(self.store) - 1)
        known = self.suggester.known.get(episode) if self.suggester else None
        return JSONResponse({"margin": None if known is None else [round(float(l), 3) for l in known.margin]})

    def suggestion_arrived(self, episode: int) -> None:
        """Note that an episode has been judged, for tabs to ask."""
        self.changes.append((None, episode))

    def _specification(self, request: Request) -> str:
        name = request.path_params["specification"]
        if name not in self.store.specifications:
            raise HTTPException(404, f"unknown specification; expected one of {', '.join(self.store.specifications)}")
        return name

    def _changed(self, specification: str, episode: int) -> Response:
        self.changes.append((specification, episode))
        return JSONResponse({"entry": self._entry(specification, episode)})

    def _entry(self, specification: str, episode: int) -> dict:
        verdict = self.store.verdict(specification, episode)
        entry = {"episode": episode, "first": verdict.first, "by": verdict.by, "at": verdict.at}
        labels = self.store.labels(specification, episode)
        if verdict.mixed:
            entry["mixed"] = labels.tolist()
        known = self.suggester.known.get(episode) if self.suggester else None
        if known is not None:
            entry |= {"guess": known.guess, "usefulness": round(known.usefulness, 3)}
            entry |= {"contradiction": round(contradiction(known.margin, labels), 3)}
        elif self.suggester and (why := self.suggester.why_silent(episode)):
            entry["silent"] = why
        return entry


async def _body(request: Request) -> dict:
    content = b""
    async for chunk in request.stream():
        content += chunk
        if len(content) > MAX_BODY:
            raise HTTPException(413, f"expected at most {MAX_BODY} bytes")
    try:
        asked = json.loads(content)
    except (ValueError, RecursionError) as e:
        raise HTTPException(400, "expected JSON") from e
    if not isinstance(asked, dict):
        raise HTTPException(400, "expected a JSON object")
    return asked


def _number(value: object, name: str, largest: int) -> int:
    """An integer in 0..largest from a path, a query or JSON."""
    if isinstance(value, str) and value.isascii() and value.isdigit() and len(value) < 20:
        value = int(value)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= largest:
        raise HTTPException(400, f"{name}: expected a whole number from 0 to {largest}")
    return value


def _text(value: object) -> str:
    if not isinstance(value, str) or len(value) > 64:
        raise HTTPException(400, "tab: expected a short text")
    return value


def _refuse(status: int):
    return lambda request, error: JSONResponse({"error": str(error)}, status)


def serve(server: LabelServer, listener: socket.socket) -> None:
    """Serve until interrupted; prints the address to open."""
    host, port = listener.getsockname()[:2]
    token, shown = secrets.token_urlsafe(16), f"[{host}]" if ":" in host else host
    print(f"Label at http://{shown}:{port}/{token}/ (every key is saved; Ctrl-C stops)", flush=True)
    loopback = {"127.0.0.1", "localhost", "::1"}
    hosts = loopback if host in loopback else {host}
    app = server.app(token, hosts)
    config = uvicorn.Config(app, log_level="warning", access_log=False, server_header=False, ws="none")
    uvicorn.Server(config).run(sockets=[listener])
