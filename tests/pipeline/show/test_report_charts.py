"""The report in a real browser without a network: its charts are drawn, told by hovering and zoomed by dragging."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from browser import needs_browser, open_page, until
from numbered_frames import commit, submitted
from playwright.sync_api import Page

from pipeline.show.report.page import write_report

pytestmark = needs_browser

LEGENDS = "[...document.querySelectorAll('.u-legend .u-series:first-child .u-value')].map(e => e.innerText)"
PAINTED = """[...document.querySelectorAll('figure canvas')].map(canvas => {
    const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
    const colours = new Set();
    for (let i = 0; i < data.length; i += 4) if (data[i + 3] > 250) colours.add(data.slice(i, i + 3).join());
    return [...colours];
})"""


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    """Of two jobs with frames that differ, one of them shorter, whose water moves twice as fast."""
    folder = tmp_path_factory.mktemp("report")
    layouts = [submitted(folder / name, name=name) for name in ("slow", "fast")]
    for index, layout in enumerate(layouts):
        for frame in range(40 - 20 * index):
            energy = 2.0 + math.sin(0.3 * frame * (1 + index))
            commit(layout, frame, kinetic_energy=energy, potential_energy=3.0, density_error=10.0 ** -(frame % 7))
    write_report(layouts, folder / "both.html")
    return folder / "both.html"


def wait_for(page: Page, condition: Callable[[], bool], what: str) -> None:
    until(condition, what, wait=lambda seconds: page.wait_for_timeout(1e3 * seconds))


def place(page: Page, share: float) -> tuple[float, float]:
    """In the first chart, at a share of its width [pixels of the window]."""
    chart = page.locator("figure .u-over").first
    chart.scroll_into_view_if_needed()
    box = chart.bounding_box()
    return box["x"] + share * box["width"], box["y"] + 0.5 * box["height"]


def until_painted(page: Page, colours: set[str]) -> None:
    """Wait until every chart has these colours."""
    wait_for(page, lambda: all(colours <= set(each) for each in page.evaluate(PAINTED)), "lines in all charts")


def told_seconds(page: Page, share: float) -> float:
    """The time that the first chart tells below the mouse at a share of its width."""
    page.mouse.move(*place(page, share))
    told = page.locator("figure .u-legend .u-series:first-child .u-value").first
    wait_for(page, lambda: told.inner_text() not in ("", "–"), "a value")
    return float(told.inner_text())


def test_charts_are_drawn_in_light_and_dark_tell_values_and_zoom(report: Path):
    faults: list[str] = []
    asked: list[str] = []
    with open_page(1200, 900, offline=True) as page:
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.emulate_media(color_scheme="light")
        page.goto(report.as_uri())
        assert page.locator("figure canvas").count() == page.locator("figure").count() > 3
        until_painted(page, {"42,120,214", "217,84,30"})  # both jobs' lines
        assert told_seconds(page, 0.5) == pytest.approx(39 / 60 / 2, abs=0.02)
        legends = page.evaluate(LEGENDS)
        assert all(legend == legends[0] for legend in legends), "the charts do not follow each other"

        page.mouse.move(*place(page, 0.25))
        page.mouse.down()
        page.mouse.move(*place(page, 0.5), steps=4)
        page.mouse.up()
        assert told_seconds(page, 0.99) == pytest.approx(39 / 60 / 2, abs=0.02), "it was not zoomed"
        page.mouse.dblclick(*place(page, 0.5))
        assert told_seconds(page, 0.99) == pytest.approx(39 / 60, abs=0.02), "a double click does not show all again"

        page.emulate_media(color_scheme="dark")
        until_painted(page, {"90,159,238", "240,124,74"})
        page.set_viewport_size({"width": 500, "height": 800})
        page.wait_for_timeout(100)
        assert page.evaluate("document.documentElement.scrollWidth <= 500"), "charts are wider than a small window"
    assert faults == []
    assert asked == [report.as_uri()]
