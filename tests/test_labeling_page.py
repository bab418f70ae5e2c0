"""The labelling page, and a report, in a real browser: Debian's Chromium, driven by Playwright."""

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
import tiny
from lerobot.utils.io_utils import write_video

from lerobot_latentsafe.reports import html

pytest.importorskip("starlette", reason="needs the label extra")
sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright (the dev extra)")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium (Debian: apt-get install chromium)")

PATIENCE_MS = 120_000
"""For what happens at once unless the machine is busy."""
SERVER = """
import sys
from lerobot_latentsafe.cli import main
main(["label", *sys.argv[1:]])
"""


class Server:
    """`latentsafe label` as a process."""

    def __init__(self, root, port=0):
        command = [sys.executable, "-c", SERVER, f"--dataset.repo_id={tiny.REPO_ID}", f"--dataset.root={root}"]
        self.process = subprocess.Popen(
            [*command, "--specifications=[spilled,dropped]", f"--port={port}", "--user=ann"],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.address = re.search(r"http://\S+/", self._line()).group()
        self.port = int(self.address.split(":")[2].split("/")[0])

    def _line(self):
        while line := self.process.stdout.readline():
            if "http://" in line:
                return line
        raise AssertionError("latentsafe label stopped before it listened")

    def kill(self):
        os.kill(self.process.pid, signal.SIGKILL)
        self.process.wait()


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """12 episodes of three small cameras."""
    from lerobot_latentsafe.experiments.labelling_cost import CAMERAS, film

    root = tmp_path_factory.mktemp("filmed") / "cup"
    film(root, 12, size=64, repo_id=tiny.REPO_ID, cameras=(*CAMERAS, "observation.images.side"))
    return root


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def server(filmed):
    started = Server(filmed)
    yield started
    started.kill()


def verdicts(server, specification):
    """First failing frames as the server has them."""
    import httpx

    entries = httpx.get(f"{server.address}api/labels/{specification}", timeout=60).json()["entries"]
    return [entry["first"] for entry in entries]


@contextlib.contextmanager
def opened(browser, address, context=None):
    page = (context or browser.new_context(viewport={"width": 1366, "height": 768})).new_page()
    page.set_default_timeout(PATIENCE_MS)
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(address)
    page.wait_for_selector("#view[data-ready]")
    yield page
    assert not errors
    page.close()


SHOWN = """() => view.dataset.shown ===
  `${view.dataset.episode}:${document.getElementById('frame').textContent.match(/[0-9]+/)}`"""
"""Whether the cameras show the frame that the page is at."""


def shown(page):
    """The episode on the screen, once the picture of its frame is there."""
    page.wait_for_function(SHOWN)
    return int(page.get_attribute("#view", "data-episode"))


def press(page, *keys):
    for key in keys:
        shown(page)
        page.keyboard.press(key)


def choose(page, key, specification):
    """Press the key of a specification; returns once its labels are there and the episode was opened anew."""
    page.evaluate("""() => {
      window.chosen = false;
      new MutationObserver(() => { window.chosen = true; }).observe(view, {attributeFilter: ['data-episode']});
    }""")
    press(page, key)
    page.wait_for_function("name => chosen && document.getElementById('specification').value === name",
                           arg=specification)  # fmt: skip


def saved(page):
    page.wait_for_function("() => document.getElementById('saved').textContent.startsWith('saved')")


def test_ten_episodes_by_keyboard_reload_and_undo(server, browser):
    with opened(browser, server.address) as page:
        expected = {}
        for i in range(10):
            episode = shown(page)
            press(page, *["ArrowRight"] * i, "f" if i % 2 else "s")
            expected[episode] = i if i % 2 else None
        saved(page)
        assert list(expected) == list(range(10))  # the next open one, each time
        first = verdicts(server, "spilled")
        assert all(first[e] == f for e, f in expected.items() if f is not None) and first[10:] == [None, None]
        assert "10 of 12" in page.inner_text("#progress")
        page.reload()
        page.wait_for_selector("#view[data-ready]")
        assert shown(page) == 10 and "10 of 12" in page.inner_text("#progress")
        press(page, "z")
        page.wait_for_function("() => view.dataset.episode === '9' && view.dataset.verdict === 'open'")
        press(page, "z")
        page.wait_for_function("() => view.dataset.episode === '8' && view.dataset.verdict === 'open'")
        assert verdicts(server, "spilled")[8:] == [None] * 4
        assert verdicts(server, "dropped") == [None] * 12


def test_an_episode_without_a_suggestion_says_why(server, browser):
    def silence(route):
        answer = route.fetch()
        told = answer.json()
        for entry in told["entries"][3:4]:
            entry["silent"] = "<b>joint_2</b> is nan"
        route.fulfill(response=answer, json=told)

    context = browser.new_context()
    context.route("**/api/labels/spilled", silence)
    with opened(browser, server.address, context) as page:
        title = page.get_attribute("#episodes li[data-episode='3']", "title")
        assert title.endswith("no suggestion, because <b>joint_2</b> is nan")
        page.click("#episodes li[data-episode='3']")
        assert shown(page) == 3  # the time line says the same
    context.close()


PICTURES_AGREE = """([episode, index]) => Promise.all([...document.querySelectorAll('#cameras canvas')].map(
  async (canvas, camera) => {
    const content = await (await fetch(`api/frames/${camera}/${episode}`)).arrayBuffer();
    const sizes = new Uint32Array(content, 4, new DataView(content).getUint32(0, true));
    const at = 4 * (sizes.length + 1) + sizes.slice(0, index).reduce((a, b) => a + b, 0);
    const image = await createImageBitmap(new Blob([content.slice(at, at + sizes[index])]));
    const stored = new OffscreenCanvas(image.width, image.height);
    stored.getContext('2d').drawImage(image, 0, 0);
    const pixels = c => c.getContext('2d').getImageData(0, 0, c.width, c.height).data.join();
    return pixels(canvas) === pixels(stored);
  }))"""
"""Whether each camera's canvas shows the stored picture of this frame."""


def test_cameras_stay_in_step_while_moving(server, browser):
    with opened(browser, server.address) as page:
        shown(page)
        page.keyboard.press("Home")
        for _ in range(15):
            page.keyboard.press("ArrowRight")
        page.keyboard.press("Shift+ArrowRight")
        page.wait_for_function("() => view.dataset.shown?.endsWith(':25')")
        assert "frame 25 of" in page.inner_text("#frame")
        assert page.evaluate(PICTURES_AGREE, [shown(page), 25]) == [True] * 3
        box = page.locator("#timeline").bounding_box()
        page.mouse.click(box["x"] + 1, box["y"] + 10)
        page.wait_for_function("() => view.dataset.shown?.endsWith(':0')")
        page.clock.install(time=0)
        page.clock.pause_at(3600)
        page.keyboard.press("Space")
        page.clock.run_for(530)  # at twice the recorded 15 frames a second
        page.keyboard.press("Space")
        episode = shown(page)
        assert page.get_attribute("#view", "data-shown") == f"{episode}:15"
        assert page.evaluate(PICTURES_AGREE, [episode, 15]) == [True] * 3


def test_other_specifications_have_labels_of_their_own(server, browser):
    with opened(browser, server.address) as page:
        choose(page, "2", "dropped")
        episode, before = shown(page), verdicts(server, "spilled")
        press(page, "f")
        saved(page)
        assert verdicts(server, "dropped")[episode] is not None and verdicts(server, "spilled") == before


def test_two_tabs_see_each_other_and_lose_nothing(server, browser):
    context = browser.new_context()
    with opened(browser, server.address, context) as one, opened(browser, server.address, context) as two:
        for page in (one, two):
            shown(page)
            page.click("#episodes li[data-episode='10']")
            page.wait_for_function("() => view.dataset.shown?.startsWith('10:')")
        press(one, "f")
        saved(one)
        two.wait_for_function("() => view.dataset.episode === '10' && view.dataset.verdict !== 'open'")
        # Both decide on the same state at once: the first counts, the second is told.
        for page in (one, two):
            page.click("#episodes li[data-episode='11']")
            page.wait_for_function("() => view.dataset.shown?.startsWith('11:')")
        with two.expect_event("requestfailed"):  # then no answer is under way that could tell the second
            two.route("**/api/labels/*?since=*", lambda route: route.abort())
        press(one, "s")
        saved(one)
        press(two, "f")
        two.wait_for_function("() => document.getElementById('toast').textContent.includes('changed by ann')")
        length = len(verdicts(server, "spilled"))
        assert verdicts(server, "spilled")[11] not in (None, 0) and length == 12


def test_a_key_held_down_labels_one_episode(server, browser):
    with opened(browser, server.address) as page:
        choose(page, "2", "dropped")
        press(page, "n")
        shown(page)
        before = verdicts(server, "dropped").count(None)
        page.keyboard.down("s")
        for _ in range(5):
            page.keyboard.down("s")
        page.keyboard.up("s")
        saved(page)
        assert verdicts(server, "dropped").count(None) == before - 1


def test_labels_survive_a_kill_in_the_middle(filmed, browser, tmp_path):
    root = shutil.copytree(filmed, tmp_path / "cup", ignore=shutil.ignore_patterns("labels"))
    first = Server(root)
    context = browser.new_context()
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.goto(first.address)
    page.wait_for_selector("#view[data-ready]")
    press(page, "s", "s")
    saved(page)
    shown(page)
    first.kill()
    press(page, "s")
    sync_api.expect(page.locator("#banner")).to_contain_text("1 label is kept in this browser", timeout=PATIENCE_MS)
    assert page.is_visible("#banner")
    second = Server(root, port=first.port)
    try:
        page.wait_for_function("() => banner.textContent.includes('open the address it printed')")
        page.close(run_before_unload=False)
        with opened(browser, second.address, context) as page:
            saved(page)
            lengths = page.evaluate("async () => (await (await fetch('api/dataset')).json()).lengths")
            assert verdicts(second, "spilled") == [*lengths[:3], *[None] * 9]
    finally:
        second.kill()


def test_a_report_shows_videos_on_screen_and_frames_on_paper(browser, tmp_path):
    grey = [np.full((32, 48, 3), level, np.uint8) for level in range(0, 200, 20)]
    write_video(str(tmp_path / "run.mp4"), grey, 5)
    frames = html.strip(grey[:2], ["first", "second"])
    parts = [html.video(tmp_path / "run.mp4", "a run"), html.player(tmp_path / "run.mp4", [], 2.0, "", frames)]
    html.write_report(tmp_path / "report.html", "runs", parts)
    page = browser.new_page()
    page.goto(f"file://{tmp_path / 'report.html'}")
    for medium, videos, strips in (("screen", True, False), ("print", False, True)):
        page.emulate_media(media=medium)
        for selector, shown in (("video", videos), (".strip", strips)):
            assert [element.is_visible() for element in page.locator(selector).all()] == [shown, shown]
    page.close()
