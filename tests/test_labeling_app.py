"""The page's server: what it answers, what it refuses, and that nothing sent to it goes anywhere."""

import asyncio
import itertools
import random
import shutil
import socket
import string
import struct
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import tiny

pytest.importorskip("starlette", reason="needs the label extra")
from starlette.testclient import TestClient

from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.labeling import app as app_module
from lerobot_latentsafe.labeling.app import LabelServer
from lerobot_latentsafe.labeling.listening import address_of, listen
from lerobot_latentsafe.labeling.store import LabelStore

TOKEN, HOST = "right-token", "http://127.0.0.1:8765"
POST = {"origin": HOST, "content-type": "application/json"}


@pytest.fixture
def root(dataset_root, tmp_path):
    return shutil.copytree(dataset_root, tmp_path / "car")


@pytest.fixture
def server(root):
    store = LabelStore(root, tiny.REPO_ID, ["spilled", "failure"])
    yield LabelServer(store, DatasetFrames(tiny.metadata(root)), "ann")
    store.close()


@pytest.fixture
def client(server):
    app = server.app(TOKEN, {"127.0.0.1", "localhost"})
    return TestClient(app, base_url=HOST, raise_server_exceptions=False)


def ask(client, path, **options):
    return client.get(f"/{TOKEN}/{path}", **options)


def say(client, path="api/labels/spilled", headers=POST, **body):
    return client.post(f"/{TOKEN}/{path}", headers=headers, json=body)


def label(client, episode, first, seen=0, tab="t"):
    return say(client, episode=episode, first=first, seen=seen, tab=tab)


@pytest.mark.parametrize("name", ["", "page.js", "page.css"])
def test_page_is_served_with_a_strict_policy(client, name):
    answer = ask(client, name)
    assert answer.status_code == 200 and "default-src 'none'" in answer.headers["content-security-policy"]
    assert answer.headers["referrer-policy"] == "no-referrer" and answer.headers["cache-control"] == "no-store"


def test_page_needs_nothing_from_the_network():
    for file in app_module.PAGE.iterdir():
        assert "http://" not in file.read_text() and "https://" not in file.read_text()


def test_dataset_names_what_the_page_shows(client, server):
    told = ask(client, "api/dataset").json()
    assert told["specifications"] == ["spilled", "failure"] and told["cameras"] == ["observation.image"]
    assert told["lengths"] == server.store.length.tolist() and told["user"] == "ann"


def test_label_undo_and_changes(client, server):
    since = ask(client, "api/labels/spilled").json()["changes"]
    entry = label(client, 3, 2).json()["entry"]
    assert (entry["episode"], entry["first"], entry["by"]) == (3, 2, "ann")
    news = ask(client, f"api/labels/spilled?since={since}").json()
    assert news["entries"] == [entry] and news["changes"] == since + 1
    assert say(client, "api/undo/spilled", tab="t").json()["entry"]["first"] is None
    assert say(client, "api/undo/spilled", tab="t").json()["entry"] is None


def test_a_frame_is_marked_alone(client, server):
    entry = say(client, "api/marks/spilled", episode=1, frame=0, seen=0, tab="t").json()["entry"]
    assert entry["mixed"] == [1] + [-1] * (int(server.store.length[1]) - 1) and entry["first"] is None
    assert say(client, "api/marks/spilled", episode=1, frame=10**6, seen=entry["at"], tab="t").status_code == 400


def test_two_tabs_cannot_overwrite_each_other_unseen(client):
    assert label(client, 3, 2).status_code == 200
    answer = label(client, 3, 4)
    assert answer.status_code == 409 and "changed by ann" in answer.json()["error"]


def test_frames_of_an_episode_are_its_pictures(client, server):
    content = ask(client, "api/frames/0/2").content
    (n,) = struct.unpack_from("<I", content)
    sizes = struct.unpack_from(f"<{n}I", content, 4)
    assert n == server.store.length[2] and len(content) == 4 * (n + 1) + sum(sizes)
    last = cv2.imdecode(np.frombuffer(content[-sizes[-1] :], np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(last[..., ::-1], server.frames.images("observation.image", 2)[-1])


def pictures_of(content):
    (n,) = struct.unpack_from("<I", content)
    sizes = struct.unpack_from(f"<{n}I", content, 4)
    ends = np.cumsum([4 * (n + 1), *sizes])
    return [content[a:b] for a, b in itertools.pairwise(ends)]


def test_pieces_of_an_episode_are_parts_of_the_whole(client, server):
    whole, n = pictures_of(ask(client, "api/frames/0/2").content), int(server.store.length[2])
    asked = {"first=0&count=3": range(3), "first=2": range(2, n), f"first={n - 1}&count=3": [n - 1], "count=0": [],
             "spread=2": [int(0.5 * n / 2), int(1.5 * n / 2)], f"spread={n}": range(n)}  # fmt: skip
    for query, numbers in asked.items():
        assert pictures_of(ask(client, f"api/frames/0/2?{query}").content) == [whole[t] for t in numbers], query


@pytest.mark.parametrize("query", ["first=-1", "first=99999", "count=99999", "spread=99999", "first=x", "spread=1e9"])
def test_frames_that_are_not_there_are_refused(client, query):
    assert ask(client, f"api/frames/0/2?{query}").status_code == 400


def test_disk_that_is_full_is_told(client, server, monkeypatch):
    def full(*args):
        raise OSError("No space left on device")

    monkeypatch.setattr(server.store, "_save", full)
    answer = label(client, 3, 2)
    assert answer.status_code == 507 and "No space left" in answer.json()["error"]


def test_an_episode_without_a_suggestion_says_why(client, server):
    server.suggester = SimpleNamespace(known={}, why_silent={3: "joint_2 is nan in frame 7"}.get)
    entries = ask(client, "api/labels/spilled").json()["entries"]
    assert entries[3]["silent"] == "joint_2 is nan in frame 7" and "silent" not in entries[2]
    assert ask(client, "api/margin/3").json() == {"margin": None}
    assert label(client, 3, 2).status_code == 200  # a person labels it


@pytest.mark.parametrize("token", ["", "wrong", "right-toke", "right-token2", "%2e%2e", "right%2Dtoken/../wrong"])
def test_wrong_token_is_refused(client, token):
    assert client.get(f"/{token}/api/dataset").status_code in (403, 404)
    assert client.post(f"/{token}/api/undo/spilled", headers=POST, json={"tab": "t"}).status_code in (403, 404)


@pytest.mark.parametrize(
    "host",
    ["evil.example", "127.0.0.1.evil.example", "", "[::1", "169.254.0.1:8765", "127.0.0.1:x", "127.0.0.1:8765/x",
     "a@127.0.0.1", "127.0.0.1#", "[127.0.0.1]x", "::1", "]", "127.0.0.1 evil", "127.0.0.1:123456"],
)  # fmt: skip
def test_other_names_of_this_machine_are_refused(client, host):
    """A name that resolves to 127.0.0.1 must not give a foreign page access (DNS rebinding)."""
    assert ask(client, "api/dataset", headers={"host": host}).status_code in (400, 403)


@pytest.mark.parametrize(
    "origin", ["https://evil.example", "null", "http://127.0.0.1:9999", "http://127.0.0.1:8765.evil"]
)
def test_other_origins_are_refused(client, server, origin):
    assert say(client, headers=POST | {"origin": origin}, episode=3, first=2, seen=0, tab="t").status_code == 403
    assert ask(client, "api/dataset", headers={"origin": origin}).status_code == 403
    assert server.store.verdict("spilled", 3).first is None


def test_writing_needs_an_origin_and_json(client):
    body = dict(episode=3, first=2, seen=0, tab="t")
    assert say(client, headers={"content-type": "application/json"}, **body).status_code == 403
    assert say(client, headers=POST | {"sec-fetch-site": "cross-site"}, **body).status_code == 403
    assert say(client, headers=POST | {"content-type": "text/plain"}, **body).status_code == 415


@pytest.mark.parametrize(
    "body",
    [{}, {"episode": -1}, {"episode": 10**9}, {"episode": 3.0}, {"episode": True, "first": 0},
     {"episode": 3, "first": "x"}, {"episode": 3, "first": 10**30}, {"episode": 3, "first": [1]},
     {"episode": 3, "first": 1, "seen": -1}, {"episode": 3, "first": 1, "seen": 0, "tab": "x" * 99},
     {"episode": "../../etc/passwd", "first": 1, "seen": 0, "tab": "t"}],
    ids=str,
)  # fmt: skip
def test_bad_bodies_are_refused(client, server, body):
    body = {"episode": 3, "first": 1, "seen": 0, "tab": "t"} | body if body else body
    assert say(client, **body).status_code == 400
    assert server.store.verdict("spilled", 3).first is None


def test_large_bodies_are_cut_off(client):
    assert say(client, episode=3, first=1, seen=0, tab="x" * 10_000).status_code == 413


PIECES = ["..", "%2e%2e", "%2f", "%5c", "/", "//", "\\", "etc/passwd", "api", "labels", "frames", "margin", "undo",
          "dataset", "spilled", "failure", "spilled.parquet", "labels/spilled.parquet", "meta/info.json", "page.js",
          "0", "1", "-1", "99999999999999999999", "1e3", "0x1", "%00", "\u0661", "?since=-1", "?since=x", "#", ";", "~",
          "C:", "file:", "%c0%ae", TOKEN]  # fmt: skip


@pytest.mark.parametrize("seed", range(4))
def test_fuzzed_addresses_and_bodies_touch_no_file(client, server, root, seed, monkeypatch):
    """Whatever is sent: no server error, no file outside of the dataset opened, nothing but labels written."""
    opened, rng = [], random.Random(seed)
    monkeypatch.setattr("builtins.open", lambda file, *a, **k: opened.append(file))
    monkeypatch.setattr("pathlib.Path.open", lambda self, *a, **k: opened.append(self))
    monkeypatch.setattr("pathlib.Path.read_bytes", lambda self: opened.append(self))
    monkeypatch.setattr(server.store, "_save", lambda name: None)
    before = sorted(str(p) for p in root.rglob("*"))
    for _ in range(250):
        pieces = [rng.choice(PIECES) for _ in range(rng.randrange(1, 6))]
        if rng.random() < 0.3:
            pieces.append("".join(rng.choices(string.printable.strip().replace("#", ""), k=12)))
        path = rng.choice(["", "api/", "api/labels/", "api/frames/0/", "api/undo/"]) + rng.choice(["/", ""]).join(
            pieces
        )
        body = rng.choice(
            [rng.randbytes(rng.randrange(200)), b"[" * 3000, b'{"episode": 1e999, "tab": "t"}', b'"\\ud800"', b"{}",
             b'{"episode": 3, "first": NaN, "seen": 0, "tab": "t"}', b'{"tab": "../../x"}']
        )  # fmt: skip
        try:
            answers = [client.get(f"/{TOKEN}/{path}"), client.post(f"/{TOKEN}/{path}", headers=POST, content=body)]
        except (ValueError, UnicodeError):
            continue  # the client itself cannot send this
        except Exception as e:
            assert type(e).__module__.startswith("httpx"), e
            continue
        assert all(answer.status_code < 500 for answer in answers), (path, body, [a.text for a in answers])
    assert not opened and sorted(str(p) for p in root.rglob("*")) == before


@pytest.mark.fault("L16", "--port is in use", "A message")
def test_port_in_use_is_a_message():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(OSError, match=r"cannot listen on 127.0.0.1 port .*choose another --port"):
            listen("127.0.0.1", taken.getsockname()[1])


@pytest.mark.parametrize(
    "host",
    ["0.0.0.0", "::", "", "0", "0x0", "00", "0.0", "000.0.0.0", "0x0.0.0.0", "::0", "0:0:0:0:0:0:0:0",
     "::ffff:0.0.0.0", "::ffff:0:0", "224.0.0.1"],
)  # fmt: skip
@pytest.mark.fault("L16", "--host is an odd spelling of every interface", "Refused, with the remedy")
def test_every_interface_at_once_is_refused(host):
    with pytest.raises(ValueError, match="SSH tunnel"):
        listen(host, 0)


LOOPBACK = ["127.0.0.1", "127.1", "0x7f.1", "2130706433", "::ffff:127.0.0.1", "::ffff:7f00:1"]


@pytest.mark.parametrize("host", LOOPBACK)
def test_loopback_is_loopback_however_it_is_spelled(host):
    with listen(host, 0) as listener:
        assert listener.getsockname()[0] == "127.0.0.1"


def test_an_address_beyond_loopback_is_spelled_out(monkeypatch):
    def resolved(host, *_, **__):
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("192.0.2.7", 0))]

    monkeypatch.setattr(socket, "getaddrinfo", resolved)
    for host in ("somewhere.example", "0xc0.0.2.7", "192.0.519"):
        with pytest.raises(ValueError, match=r"stands for 192\.0\.2\.7, which others can reach.*--host=192\.0\.2\.7"):
            listen(host, 0)
    assert str(address_of("192.0.2.7")) == "192.0.2.7"


@pytest.mark.parametrize("host", ["not.a.host.invalid", "a" * 300, "a\0b", "*", "127.0.0.1:80"])
def test_a_host_that_is_none_is_a_message(host, monkeypatch):
    with pytest.raises(OSError, match="cannot listen on"):
        listen(host, 0)


@pytest.mark.parametrize("port", [-1, 70000, 2**40])
@pytest.mark.fault("L16", "--port is 70000", "A message")
def test_a_port_that_is_none_is_a_message(port):
    with pytest.raises(OSError, match="choose another --port"):
        listen("127.0.0.1", port)


@pytest.mark.parametrize("path", ["*", "", "/", "//", "http://evil.example/", "evil.example:443"])
@pytest.mark.parametrize("headers", [[], [(b"host", b"127.0.0.1")], [(b"host", b"\xff[")], [(b"origin", b"http://[")]])
@pytest.mark.parametrize("method", ["OPTIONS", "GET", "CONNECT"])
def test_odd_requests_are_refused_without_a_trace(server, method, path, headers):
    """Such as `OPTIONS *`, which no test client can send."""
    scope = {
        "type": "http", "method": method, "path": path, "raw_path": path.encode(), "headers": headers,
        "query_string": b"", "scheme": "http", "server": ("127.0.0.1", 8765), "root_path": "", "http_version": "1.1",
    }  # fmt: skip
    sent = []

    async def send(message):
        sent.append(message)

    asyncio.run(server.app(TOKEN, {"127.0.0.1"})(scope, None, send))
    assert sent[0]["status"] == 403


def test_dataset_without_cameras_is_a_message(cache_meta):
    with pytest.raises(ValueError, match=r"no video and no images.*cache"):
        DatasetFrames(cache_meta)


def test_missing_file_of_an_episode_is_a_message(root):
    meta = tiny.metadata(root)
    next((root / "data").glob("*/*.parquet")).unlink()
    with pytest.raises(FileNotFoundError, match=r"file-000.parquet is missing, which holds episode 0"):
        DatasetFrames(meta)
