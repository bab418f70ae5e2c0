"""What labelling costs, on a filmed dataset as large as the paper's: 1,300 episodes of two cameras at 15 Hz."""

import contextlib
import http.client
import io
import json
import multiprocessing
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_latentsafe.datasets.episodes import DatasetFrames
from lerobot_latentsafe.datasets.labels import FailureLabels
from lerobot_latentsafe.evaluation.statistics import provenance, write_json
from lerobot_latentsafe.labeling.app import LabelServer, serve
from lerobot_latentsafe.labeling.listening import listen
from lerobot_latentsafe.labeling.store import LabelStore

if TYPE_CHECKING:
    from playwright.sync_api import Page

FPS = 15
CAMERAS = ("observation.images.front", "observation.images.wrist")
LATENCY = """() => {
  window.times = {key: [], picture: []};
  addEventListener('keydown', () => {
    const pressed = performance.now(), view = document.getElementById('view');
    requestAnimationFrame(() => setTimeout(() => times.key.push(performance.now() - pressed)));
    new MutationObserver((_, watch) => { watch.disconnect(); times.picture.push(performance.now() - pressed); })
      .observe(view, {attributes: true, attributeFilter: ['data-shown']});
  }, true);
}"""
"""Time from a key to the next painted state of the page, and to the next picture of all cameras."""

# Operator times of the keystroke-level model (Card, Moran and Newell): a skilled typist, a pointing move, a decision.
KEY_S, POINT_S, DECIDE_S = 0.20, 1.10, 1.35


# -- a dataset whose failures are known ---


def film(
    root: Path,
    n_episodes: int,
    size: int = 256,
    repo_id: str = "bench/cup",
    seed: int = 0,
    cameras: Sequence[str] = CAMERAS,
) -> list[int]:
    """Record a cup that is pushed along a table and, in two of three episodes, over its edge.

    Returns:
        The first failing frame of each episode; its length where the cup stays.
    """
    names = {"observation.state": ["gripper.pos"], "action": ["gripper.pos", "lift.vel"]}
    features = {key: {"dtype": "float32", "shape": (len(n),), "names": n} for key, n in names.items()}
    shape = {"dtype": "video", "shape": (size, size, 3), "names": ["height", "width", "channels"]}
    dataset = LeRobotDataset.create(
        repo_id, FPS, {**features, **dict.fromkeys(cameras, shape)}, root=root, robot_type="bench",
        streaming_encoding=True, metadata_buffer_size=100, video_files_size_in_mb=5,
        rgb_encoder=RGBEncoderConfig(vcodec="h264", preset="ultrafast"),
    )  # fmt: skip
    rng, first = np.random.default_rng(seed), []
    for _ in range(n_episodes):
        length = int(rng.integers(45, 76))
        push = np.cumsum(rng.uniform(0.5, 1.5, length)) / length * rng.uniform(0.5, 1.0) + 0.1
        fallen = push > 0.75
        first.append(int(fallen.argmax()) if fallen.any() else length)
        for t in range(length):
            images = {camera: draw(push[t], t - first[-1], size, camera == CAMERAS[1]) for camera in cameras}
            state, action = np.array([push[t]], np.float32), np.array([push[min(t + 1, length - 1)], 0], np.float32)
            dataset.add_frame({**images, "observation.state": state, "action": action, "task": "push the cup"})
        dataset.save_episode()
    dataset.finalize()
    return first


def draw(push: float, fallen: int, size: int, above: bool) -> np.ndarray:
    """One view of table, gripper and cup; `fallen` counts the frames since the cup went over the edge."""
    image = np.full((256, 256, 3), (214, 208, 200), np.uint8)
    x, over = int(30 + 190 * push), fallen >= 0
    if above:
        cv2.rectangle(image, (0, 60), (190, 196), (150, 112, 80), -1)
        cv2.circle(image, (x + 8, 128), max(9, 22 - fallen) if over else 22, (40, 90, 180), -1)
        cv2.rectangle(image, (x - 46, 108), (x - 14, 148), (60, 60, 66), -1)
    else:
        drop = min(int(1.5 * fallen**2), 60) if over else 0
        cv2.rectangle(image, (0, 170), (190, 188), (150, 112, 80), -1)
        cup = cv2.boxPoints(((x + 8, 140 + drop), (36, 56), min(90, 18 * (fallen + 1)) if over else 0))
        cv2.fillPoly(image, [cup.astype(np.int32)], (40, 90, 180))
        cv2.rectangle(image, (x - 44, 104), (x - 12, 124), (60, 60, 66), -1)
    return cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)


# -- the server and the page ---


@contextmanager
def labelling(root: Path, *options: str) -> Iterator[tuple[subprocess.Popen, str]]:
    """A running `latentsafe label`: (process, address)."""
    command = [str(Path(sys.executable).parent / "latentsafe"), "label", "--dataset.repo_id=bench/cup"]
    process = subprocess.Popen(
        [*command, f"--dataset.root={root}", "--port=0", "--user=bench", *options],
        stdout=subprocess.PIPE, text=True, env={**os.environ, "HF_HUB_OFFLINE": "1"},
    )  # fmt: skip
    try:
        address = None
        while address is None:
            line = process.stdout.readline()
            if not line:
                raise SystemExit("latentsafe label stopped before it listened")
            address = re.search(r"http://\S+/", line)
        yield process, address.group()
    finally:
        process.kill()
        process.wait()


@contextmanager
def page_at(address: str) -> Iterator["Page"]:
    """The page in a browser; needs playwright from the dev extra."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1366, "height": 768})
        page.goto(address)
        page.wait_for_selector("#view[data-ready]")
        yield page
        browser.close()


def wait_for_picture(page: "Page") -> None:
    """Until the page shows a frame of its episode."""
    page.wait_for_function(
        "() => document.getElementById('view').dataset.shown?.startsWith(view.dataset.episode + ':')"
    )


def read_verdicts(root: Path, specification: str = "failure") -> dict[int, int | None]:
    """First failing frames in the label file, read as training reads it."""
    store = LabelStore(root, "bench/cup", [specification])
    found = {episode: store.verdict(specification, episode).first for episode in range(len(store))}
    store.close()
    return found


# -- what is measured ---


def latency(root: Path, n_episodes: int = 70) -> dict:
    """A practised hand's keys: a few steps through the frames, a look, a verdict, now and then undo; milliseconds."""
    rng = random.Random(0)
    with labelling(root) as (_, address), page_at(address) as page:
        wait_for_picture(page)
        page.evaluate(LATENCY)
        for _ in range(n_episodes):
            keys = rng.choices(["ArrowRight", "ArrowLeft", "Shift+ArrowRight"], [6, 1, 2], k=rng.randrange(4, 12))
            for key in (*keys, rng.choices(["f", "s", "z", "n"], [6, 3, 1, 1])[0]):
                page.wait_for_timeout(1000 * (DECIDE_S if key in "fszn" else KEY_S))
                page.keyboard.press(key)
        page.wait_for_timeout(1000)
        times = page.evaluate("times")
    summary = {}
    for name, values in times.items():
        summary[name] = {f"p{q}_ms": round(float(np.percentile(values, q)), 1) for q in (50, 95, 99)}
        summary[name] |= {"max_ms": round(max(values), 1), "n": len(values)}
    return summary


def hand(root: Path, n_episodes: int = 30, policy: str | None = None) -> dict:
    """A practised hand: looks, clicks into the film strip near the failure, corrects by arrows, marks.

    Where a click lands is drawn from a normal distribution of half a thumbnail; every look costs a decision. With a
    filter, the page is at its guess already: a right one is accepted, a near one corrected.
    """
    truth, rng, rows = truth_of(root), random.Random(1), []
    options = [f"--policy.path={policy}", "--specifications=[entered]"] if policy else []
    with labelling(root, *options) as (_, address), page_at(address) as page:
        lengths = page.evaluate("async () => (await (await fetch('api/dataset')).json()).lengths")
        if policy:
            page.wait_for_function(
                "() => !document.querySelectorAll('#episodes small').values().some(s => s.innerText === '–')"
            )
        page.wait_for_timeout(1000)
        for _ in range(n_episodes):
            started = time.time()
            wait_for_picture(page)
            episode, shown = (int(v) for v in page.get_attribute("#view", "data-shown").split(":"))
            keys = label_one(page, shown, truth[episode], lengths[episode], rng)
            rows.append((keys, time.time() - started, episode))
        page.wait_for_function("() => document.getElementById('saved').textContent.startsWith('saved')")
    found = read_verdicts(root, "entered" if policy else "failure")
    return {
        "filter": policy,
        "keys_per_episode": round(float(np.mean([k for k, _, _ in rows])), 2),
        "seconds_per_episode": round(float(np.mean([s for _, s, _ in rows])), 2),
        "episodes": len(rows),
        "labels_equal_to_the_truth": sum(found[episode] == truth[episode] for _, _, episode in rows),
        "model": {"key_s": KEY_S, "point_s": POINT_S, "decide_s": DECIDE_S},
    }


def label_one(page: "Page", shown: int, first: int, length: int, rng: random.Random) -> int:
    """Label the episode that the page is at. Returns the keys and clicks that it took.

    Args:
        shown: frame that the page is at.
        first: the first failing frame; `length` where none fails.
    """
    keys, fails, guessed = 0, first < length, page.is_visible("#accept")
    page.wait_for_timeout(1000 * DECIDE_S)
    key = "f" if fails else "s"
    if guessed and right_guess(page.inner_text("#accept"), first, length):
        key = "Enter"
    elif fails and not (guessed and abs(shown - first) <= 5):
        box = page.locator("#film").bounding_box()
        shown = int(min(max(first + rng.gauss(0, length / 32), 0), length - 1))
        page.wait_for_timeout(1000 * POINT_S)
        x = box["x"] + (shown + 0.5) / length * box["width"]
        page.mouse.click(x, box["y"] + box["height"] / 2)
        keys += 1
        page.wait_for_timeout(1000 * DECIDE_S)
    for _ in range(abs(first - shown) if key == "f" else 0):
        page.wait_for_timeout(1000 * KEY_S)
        page.keyboard.press("ArrowRight" if shown < first else "ArrowLeft")
        keys += 1
    page.wait_for_timeout(1000 * KEY_S)
    page.keyboard.press(key)
    return keys + 1


def truth_of(root: Path) -> list[int]:
    """First failing frame of each episode: as filmed, or from the dataset's column."""
    if (root / "truth.json").exists():
        return json.loads((root / "truth.json").read_text())
    labels = FailureLabels.load(root)
    episodes = [labels.failure[labels.episode == e] for e in range(labels.episode.max() + 1)]
    return [int(np.r_[e, 1].argmax()) for e in episodes]


def right_guess(said: str, first: int, length: int) -> bool:
    """Whether what the page suggests is the truth."""
    return said.endswith("never fails" if first == length else f" {first}")


def kills(root: Path, trials: int = 100) -> dict:
    """Label as fast as the server answers, kill it at a random moment, and look for every label it ever confirmed."""
    context = multiprocessing.get_context("forkserver")  # the server's imports are done once, not 100 times
    context.set_forkserver_preload(["lerobot_latentsafe.labeling.app", "lerobot.datasets.dataset_metadata", "uvicorn"])
    lengths = truth_of(root)
    rng, expected, confirmed, lost, unreadable = random.Random(2), read_verdicts(root), 0, 0, 0
    for trial in range(trials):
        receiver, sender = context.Pipe(duplex=False)
        server = context.Process(target=serve_once, args=(root, sender), daemon=True)
        server.start()
        sender.close()
        address, episode = receiver.recv(), None
        seen = [entry["at"] for entry in get(address, "api/labels/failure")["entries"]]
        killer = threading.Timer(rng.uniform(0.02, 0.8), server.kill)
        killer.start()
        with contextlib.suppress(OSError, http.client.HTTPException):
            for episode in rng.sample(range(len(lengths)), len(lengths)):
                asked = {
                    "episode": episode,
                    "first": rng.randrange(min(lengths)),
                    "seen": seen[episode],
                    "tab": "bench",
                }
                expected[episode] = post(address, "api/labels/failure", asked)["entry"]["first"]
                confirmed += 1
        server.join()
        try:
            found = read_verdicts(root)
        except ValueError:
            unreadable += 1
            break
        # The label that was asked for and not confirmed may have been saved or not; both are right.
        lost += sum(found[e] != first for e, first in expected.items() if e != episode)
        expected = found
        print(f"trial {trial}: {confirmed} labels confirmed, {lost} lost", flush=True)
    return {"trials": trial + 1, "labels_confirmed": confirmed, "labels_lost": lost, "unreadable_files": unreadable}


def serve_once(root: Path, sender: Connection) -> None:
    """The server of `latentsafe label` in a process that will be killed; sends its address."""
    frames = DatasetFrames(LeRobotDatasetMetadata("bench/cup", root=root))
    server = LabelServer(LabelStore(root, "bench/cup", ["failure"]), frames, "bench")
    said = io.StringIO()
    # The socket listens before the address is printed, so whoever has the address is answered.
    threading.Timer(0.3, lambda: sender.send(re.search(r"http://\S+/", said.getvalue()).group())).start()
    with contextlib.redirect_stdout(said):
        serve(server, listen("127.0.0.1", 0))


def get(address: str, path: str) -> dict:
    """Of the page's interface."""
    return json.load(urllib.request.urlopen(address + path, timeout=30))


def post(address: str, path: str, body: dict) -> dict:
    """To the page's interface."""
    origin = re.match(r"http://[^/]+", address).group()
    request = urllib.request.Request(
        address + path, json.dumps(body).encode(), {"Content-Type": "application/json", "Origin": origin}
    )
    return json.load(urllib.request.urlopen(request, timeout=30))


MEASURES = {"latency": latency, "hand": hand, "kills": kills}


def measure(what: str, root: Path, policy: str | None = None) -> None:
    """Measure on a copy of a filmed dataset that shares its videos, and write results/labels/<what>.json."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "filmed"
        shutil.copytree(root, copy, copy_function=os.link, ignore=shutil.ignore_patterns("labels"))
        row = MEASURES[what](copy, **({"policy": policy} if policy else {}))
        info = json.loads((copy / "meta" / "info.json").read_text())
    cameras = sum(f["dtype"] in ("image", "video") for f in info["features"].values())
    row |= {"dataset": {"episodes": info["total_episodes"], "cameras": cameras, "fps": info["fps"]}}
    row |= {"load_average": round(os.getloadavg()[0], 1), **provenance(seeds=[0])}
    print(json.dumps(row, indent=2))
    write_json(Path("results/labels") / f"{what}{'_suggested' if policy else ''}.json", row)
