"""`pipeline view` in a real browser: what it draws, and what its controls do."""

import io
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viewed_job
from browser import PATIENCE_S, needs_browser, open_page, until
from PIL import Image

from pipeline.base.layout import JobLayout
from pipeline.web.serving import address, page_server
from pipeline.web.viewer.page import ViewPage

pytestmark = needs_browser

SCENE = {"x": 0, "y": 160, "width": 340, "height": 320}
"""Of the page, below a note about WebGL and beside the controls [pixels]."""


@dataclass
class Served:
    """A page's server side, and where browsers find it."""

    page: ViewPage
    url: str


@contextmanager
def served(layout: JobLayout, **limits: int) -> Iterator[Served]:
    with page_server(port=0, label="view") as server:
        page = ViewPage(server, layout, **{"most_particles": 10_000, "most_bytes": 10**8, **limits})
        stop = threading.Event()
        loop = threading.Thread(target=page.run, args=(stop,))
        loop.start()
        try:
            yield Served(page, address(server))
        finally:
            stop.set()
            loop.join()


@pytest.fixture(scope="module")
def window() -> Iterator[Any]:
    """An empty page; its browser is started once for all tests."""
    with open_page(720, 480) as page:
        yield page


@contextmanager
def opened(window: Any, served: Served) -> Iterator[Any]:
    """A page of its own, as of another person."""
    context = window.context.browser.new_context(viewport=window.viewport_size)
    context.set_default_timeout(PATIENCE_S * 1000)
    try:
        browser = context.new_page()
        browser.goto(served.url)
        browser.wait_for_selector("canvas")
        yield browser
    finally:
        context.close()


def wait_for(condition: Callable[[], object], what: str, browser: Any) -> None:
    until(condition, what, wait=lambda seconds: browser.wait_for_timeout(1000 * seconds))


def picture(browser: Any) -> np.ndarray:
    with Image.open(io.BytesIO(browser.screenshot(clip=SCENE))) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def drawn(browser: Any) -> np.ndarray:
    """The scene, as soon as there is something to be seen in it."""
    found: list[np.ndarray] = []

    def is_drawn() -> bool:
        found[:] = [picture(browser)]
        return len(np.unique(found[0].reshape(-1, 3), axis=0)) > 50

    wait_for(is_drawn, "anything in the scene", browser)
    return found[0]


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """Share of the pixels that differ."""
    return float((np.abs(before - after).max(axis=2) > 24).mean())


def test_a_job_is_drawn_scrubbed_and_played_in_two_pages(tmp_path: Path, window: Any):
    layout = viewed_job.submitted(tmp_path / "job")
    for frame in range(6):
        receipt = viewed_job.commit(layout, frame)
        viewed_job.commit_spray(layout, receipt, frame)
        viewed_job.commit_drops(layout, receipt, frame)
    with served(layout, most_particles=500) as view, opened(window, view) as browser:
        complaints: list[str] = []
        browser.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
        browser.on("pageerror", lambda error: complaints.append(str(error)))
        wait_for(lambda: view.page.frame == 0, "frame 0", browser)
        first = drawn(browser)
        assert {
            "/fluid/water",
            "/rigid/ball/body",
            "/cloth/flag",
            "/pin/flag",
            "/smoke/plume",
            "/domain",
            "/camera",
            "/whitewater/water",
            "/drops/water",
        } == view.page.canvas.names
        plotted = "Object.values(window.__viserTestpoints.uplots).map(each => each.chart.scales.y.max > 0)"
        wait_for(lambda: browser.evaluate(plotted) == [True], "a plot of the numbers", browser)
        assert browser.get_by_text("500 of 1,000 particles are drawn").is_visible()

        track = browser.locator(".mantine-Slider-track").first.bounding_box()
        # By the mouse: arrow keys would turn the camera as well, and the picture would differ anyway.
        browser.mouse.click(track["x"] + 4 / 5 * track["width"], track["y"] + track["height"] / 2)
        wait_for(lambda: view.page.frame == 4, "the slider's frame", browser)
        browser.get_by_text("frame 4 · 0.133 s").wait_for()
        wait_for(lambda: changed(first, picture(browser)) > 0.01, "another picture", browser)
        assert "/pin/flag" not in view.page.canvas.names  # let go at 0.1 s

        with opened(window, view) as other:
            other.get_by_text("frame 4 · 0.133 s").wait_for()
            other.get_by_role("button", name="first").click()
            wait_for(lambda: view.page.frame == 0, "the other browser's step", other)
        browser.get_by_text("frame 0 · 0.000 s").wait_for()

        browser.get_by_role("button", name="Play").click()
        wait_for(lambda: view.page.playback.plays, "playing", browser)
        seen = set()
        wait_for(lambda: seen.add(view.page.frame) or len(seen) >= 4, "several frames", browser)
        browser.get_by_role("button", name="Pause").click()
        wait_for(lambda: not view.page.playback.plays, "pausing", browser)
        browser.get_by_role("tab", name="Numbers").click()
        browser.get_by_text("kinetic energy", exact=True).wait_for()
        assert complaints == []


def test_frames_of_a_running_job_appear_and_a_spoilt_one_is_a_line(tmp_path: Path, window: Any):
    layout = viewed_job.submitted(tmp_path / "job")
    with served(layout) as view, opened(window, view) as browser:
        browser.get_by_text("has no frame yet").wait_for()
        viewed_job.commit(layout, 0)
        wait_for(lambda: view.page.frame == 0, "the first frame", browser)
        receipt = viewed_job.commit(layout, 1)
        wait_for(lambda: view.page.frame == 1, "the newest frame, as it waited for the first", browser)
        browser.get_by_text("2 of 10 frames simulated").wait_for()

        browser.get_by_role("checkbox", name="Surfaces").click()
        browser.get_by_text("frame 1 has no surface yet").wait_for()
        viewed_job.commit_surface(layout, receipt, 1)
        wait_for(lambda: "/surface/water" in view.page.canvas.names, "the surface", browser)

        viewed_job.commit(layout, 2)
        layout.path(layout.frame_cache(2)).write_bytes(b"nothing")
        browser.get_by_role("button", name="last").click()
        browser.get_by_text("frame 2 cannot be read").wait_for()
        browser.get_by_role("button", name="first").click()
        wait_for(lambda: view.page.frame == 0, "a frame that can be read", browser)
        assert "/fluid/water" in view.page.canvas.names
