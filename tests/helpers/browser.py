"""A real browser for tests of pages: the Chromium that is installed, without a screen, drawing WebGL on the CPU."""

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Page, sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome")
ARGUMENTS = (
    "--no-sandbox",  # which root cannot have
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-quic",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)

PATIENCE_S = 90.0
"""Browsers that draw on the CPU take seconds for a picture where others compute."""

chromium = next(filter(None, map(shutil.which, NAMES)), None)
needs_browser = pytest.mark.skipif(chromium is None, reason="no Chromium is installed")


@contextmanager
def open_page(width: int = 1280, height: int = 800, **context: object) -> Iterator[Page]:
    """An empty page of this size in pixels; `context` is Playwright's, such as `has_touch=True` for a phone."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(ARGUMENTS))
        try:
            yield browser.new_context(viewport={"width": width, "height": height}, **context).new_page()
        finally:
            browser.close()


def until(condition: Callable[[], object], what: str, *, wait: Callable[[float], object] = time.sleep) -> None:
    """Wait for a condition; `wait` lets the browser of this thread go on meanwhile, for so long [s]."""
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, f"never: {what}"
        wait(0.05)
