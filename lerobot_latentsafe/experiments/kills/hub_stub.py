"""A Hugging Face Hub for models on loopback: as much as pushing and pulling a folder asks for."""

import base64
import hashlib
import json
import re
import threading
import time
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlparse

NO_COMMIT = "0" * 40
PIECE = 2**18
"""Bytes of an upload that are taken at once."""


class Hub:
    """Serves on 127.0.0.1 between `with`.

    Args:
        pause_s: seconds that each answer and each piece of an upload takes, as over a line.

    Attributes:
        repos: id -> file name -> content.
        commits: id -> hashes.
        fault: what becomes of weights that are uploaded: "500", "cut", or None.
    """

    def __init__(self, pause_s: float = 0.0):
        self.pause_s = pause_s
        self.repos: dict[str, dict[str, bytes]] = {}
        self.commits: dict[str, list[str]] = {}
        self.uploads: dict[str, bytes] = {}
        self.fault: str | None = None
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"hub": self}))
        self.url = f"http://127.0.0.1:{self.server.server_port}"

    def __enter__(self) -> "Hub":
        threading.Thread(target=self.server.serve_forever, args=(0.01,), daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self.server.shutdown()
        self.server.server_close()

    def settings(self, cache: Path) -> dict[str, object]:
        """What HF_ENDPOINT and its fellows set in `huggingface_hub.constants`, for this Hub."""
        return {
            "ENDPOINT": self.url,
            "HUGGINGFACE_CO_URL_TEMPLATE": self.url + "/{repo_id}/resolve/{revision}/{filename}",
            "HF_HUB_OFFLINE": False,
            "HF_HUB_DISABLE_XET": True,
            "HF_HUB_DISABLE_TELEMETRY": True,
            "HF_HUB_CACHE": str(cache),
        }

    def head(self, repo: str) -> str:
        """The last commit."""
        return ([NO_COMMIT] + self.commits[repo])[-1]


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    hub: Hub

    def log_message(self, *_):
        pass

    def handle(self):
        with suppress(ConnectionError):  # who asked may be killed
            super().handle()

    def do_any(self):
        path, body = unquote(urlparse(self.path).path), self._body()
        if body is None:
            self.close_connection = True
            return None
        for pattern, answer in ROUTES:
            if found := re.fullmatch(pattern, path):
                known = found.groupdict()
                if "repo" in known and known["repo"] not in self.hub.repos:
                    return self._send({"error": "no such repository"}, 404, {"X-Error-Code": "RepoNotFound"})
                return answer(self, body, **known)
        return self._send({"error": f"the stub does not know {path}"}, 404)

    do_GET = do_POST = do_PUT = do_HEAD = do_any

    def _body(self):
        """What was sent; None if it broke off."""
        try:
            if self.headers.get("Transfer-Encoding") != "chunked":
                return self._read(int(self.headers.get("Content-Length") or 0))
            parts = []
            while size := int(self.rfile.readline(), 16):
                parts.append(self._read(size))
                self.rfile.readline()
            self.rfile.readline()
            return b"".join(parts)
        except (OSError, EOFError, ValueError):
            return None

    def _read(self, size):
        parts = []
        while size:
            time.sleep(self.hub.pause_s)
            parts.append(self.rfile.read(min(size, PIECE)))
            if not parts[-1]:
                raise EOFError
            size -= len(parts[-1])
        return b"".join(parts)

    def _send(self, content, status=200, headers=None):
        time.sleep(self.hub.pause_s)
        raw = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for name, value in {"Content-Length": len(raw), "Content-Type": "application/json", **(headers or {})}.items():
            self.send_header(name, str(value))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(raw)

    # -- pushing ---

    def validate_card(self, body):
        self._send({"errors": [], "warnings": []})

    def create(self, body):
        wanted = json.loads(body)
        repo = f"{wanted.get('organization') or 'me'}/{wanted['name']}"
        self.hub.repos.setdefault(repo, {})
        self.hub.commits.setdefault(repo, [])
        self._send({"url": f"{self.hub.url}/{repo}"})

    def preupload(self, body, repo):
        mode = {True: "lfs", False: "regular"}
        files = [f["path"] for f in json.loads(body)["files"]]
        answer = [{"path": f, "uploadMode": mode[f.endswith(".safetensors")], "shouldIgnore": False} for f in files]
        self._send({"files": answer})

    def lfs_batch(self, body, repo):
        objects = [
            {**o, "actions": {"upload": {"href": f"{self.hub.url}/upload/{o['oid']}"}}}
            for o in json.loads(body)["objects"]
        ]
        kind = {"Content-Type": "application/vnd.git-lfs+json"}
        self._send({"transfer": "basic", "objects": objects}, headers=kind)

    def lfs_upload(self, body, oid):
        if self.hub.fault == "cut":
            self.close_connection = True
            return self.connection.close()
        if self.hub.fault:
            return self._send({"error": "broken"}, int(self.hub.fault))
        self.hub.uploads[oid] = body
        self._send({})

    def commit(self, body, repo):
        for entry in map(json.loads, body.splitlines()):
            value = entry["value"]
            if entry["key"] == "file":
                self.hub.repos[repo][value["path"]] = base64.b64decode(value["content"])
            elif entry["key"] == "lfsFile":
                self.hub.repos[repo][value["path"]] = self.hub.uploads[value["oid"]]
        self.hub.commits[repo].append(hashlib.sha1(body).hexdigest())
        head = self.hub.head(repo)
        self._send({"commitOid": head, "commitUrl": f"{self.hub.url}/{repo}/commit/{head}", "pullRequestUrl": None})

    # -- pulling ---

    def info(self, body, repo):
        files = [{"rfilename": name} for name in self.hub.repos[repo]]
        self._send({"id": repo, "sha": self.hub.head(repo), "private": False, "tags": [], "siblings": files})

    def tree(self, body, repo):
        files = self.hub.repos[repo].items()
        self._send([{"type": "file", "path": f, "size": len(c), "oid": hashlib.sha1(c).hexdigest()} for f, c in files])

    def resolve(self, body, repo, file):
        commit = {"X-Repo-Commit": self.hub.head(repo)}
        content = self.hub.repos[repo].get(file)
        if content is None:
            return self._send({"error": "no such file"}, 404, {"X-Error-Code": "EntryNotFound", **commit})
        self._send(content, headers={"ETag": f'"{hashlib.sha1(content).hexdigest()}"', **commit})


REPO = r"(?P<repo>[^/]+/[^/]+)"
ROUTES = (
    (r"/api/validate-yaml", _Handler.validate_card),
    (r"/api/repos/create", _Handler.create),
    (rf"/api/models/{REPO}/preupload/[^/]+", _Handler.preupload),
    (rf"/{REPO}\.git/info/lfs/objects/batch", _Handler.lfs_batch),
    (r"/upload/(?P<oid>\w+)", _Handler.lfs_upload),
    (rf"/api/models/{REPO}/commit/[^/]+", _Handler.commit),
    (rf"/api/models/{REPO}(?:/revision/[^/]+)?", _Handler.info),
    (rf"/api/models/{REPO}/tree/[^/]+", _Handler.tree),
    (rf"/{REPO}/resolve/[^/]+/(?P<file>.+)", _Handler.resolve),
)
