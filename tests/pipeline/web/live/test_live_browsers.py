"""Several browsers at a session, one that does not read, one that goes and comes again, and what blows up meanwhile."""

import asyncio
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import numpy as np
import pytest
import viser
from browser import PATIENCE_S, needs_browser, open_page, until
from live_jobs import BALL_OVER_SHEET, served
from many_pages import crowd
from playwright.sync_api import Page
from websockets.sync.client import connect

from pipeline.web.live.running import run
from pipeline.web.live.session import Session

pytestmark = pytest.mark.usefixtures("taichi")

STATE_BYTES = 40_000
"""Messages that are longer have the positions of a sheet of 61 x 61 nodes; no others do."""


def opened(page: Page, address: str) -> Page:
    page.set_default_timeout(1e3 * PATIENCE_S)
    page.goto(address)
    page.get_by_role("button", name="Reset").wait_for()
    return page


def stiffness_in(page: Page) -> str:
    """What the field of the sheet's stiffness shows."""
    return page.locator("form").filter(has_text="stretch stiffness").get_by_role("textbox").first.input_value()


def frame_of(session: Session) -> int:
    """How far the scene is, as another thread may ask; -1 while the session builds its world anew."""
    world = getattr(session, "world", None)
    return -1 if world is None else world.frame


def two_play(address: str, session: Session) -> None:
    """What two people do at once."""
    with open_page(760, 480) as first:
        browser = first.context.browser
        other_place = browser.new_context(viewport={"width": 760, "height": 480})
        other = opened(other_place.new_page(), address)
        opened(first, address)
        before = session.values["cloth.sheet.stretch_stiffness"]
        stiffness = first.get_by_role("slider").nth(2)
        stiffness.focus()
        for _ in range(5):
            first.keyboard.press("ArrowLeft")
        until(lambda: session.values["cloth.sheet.stretch_stiffness"] < 0.9 * before, "the slider does nothing")
        # Some of the presses may still be on their way.
        until(
            lambda: stiffness_in(other) == f"{session.values['cloth.sheet.stretch_stiffness']:g}",
            "the other browser does not show it",
        )

        other.get_by_role("button", name="Go on").click()
        first.get_by_role("button", name="Pause").click()
        until(lambda: session.is_paused and frame_of(session) > 0, "time stands still, or goes on")

        first.get_by_role("button", name="Reset").click()
        stiffness.focus()
        first.keyboard.press("End")
        until(lambda: session.values["cloth.sheet.stretch_stiffness"] == 1.0e5, "the slider does nothing")
        session.ask(lambda: session.world.solvers["rigid"].bodies.velocity.fill(np.nan))
        other.get_by_role("button", name="Step").click()
        for page in (first, other):
            page.get_by_text("It blew up").wait_for()
            page.get_by_text("Changed last: cloth.sheet.stretch_stiffness = 100000").wait_for()
            page.get_by_role("button", name="Go on").wait_for()  # at the start, with the job's values
        until(lambda: stiffness_in(first) == "500", "the job's value is not shown")

        other_place.close()  # gone in the middle, with everything that it was shown
        frame = frame_of(session)
        first.get_by_role("button", name="Step").click()
        until(lambda: frame_of(session) == frame + 1, "the page is dead")
        again = opened(browser.new_context().new_page(), address)
        again.get_by_role("button", name="Step").click()
        until(lambda: frame_of(session) == frame + 2, "the page that came again is dead")


@needs_browser
def test_two_browsers_share_knobs_and_outlive_a_blow_up_and_each_other(tmp_path):
    coarse = BALL_OVER_SHEET.replace("counts = [17, 17]", "counts = [9, 9]")
    with served(tmp_path, coarse) as (session, page, server), ThreadPoolExecutor(1) as browser:
        playing = browser.submit(two_play, f"http://127.0.0.1:{server.get_port()}", session)
        run(session, page, ends=playing.done)
        playing.result()


def test_many_pages_that_come_and_go_end_no_session(tmp_path, caplog):
    with served(tmp_path, BALL_OVER_SHEET) as (session, page, server), ThreadPoolExecutor(1) as pages:
        session.is_paused = False
        address = f"ws://127.0.0.1:{server.get_port()}"
        crowded = pages.submit(lambda: asyncio.run(crowd(address, pages=20, seconds=6.0, seed=1)))
        run(session, page, ends=crowded.done)
        seen = crowded.result()
    assert seen["visits"] >= 20
    assert seen["malformed"]
    assert seen["messages"]
    assert not seen["refused"]
    assert not [record for record in caplog.records if record.exc_info]


def test_a_browser_that_never_reads_holds_up_neither_the_scene_nor_another_browser(tmp_path):
    ball, post = BALL_OVER_SHEET.index("[[rigid]]"), BALL_OVER_SHEET.rindex("[[rigid]]")
    quick = "counts = [61, 61]", "substeps = 2\nself_collision = false"
    sheet = BALL_OVER_SHEET[post:].replace("counts = [17, 17]", quick[0]).replace("substeps = 8", quick[1])
    with served(tmp_path, BALL_OVER_SHEET[:ball] + sheet) as (session, page, server):
        address, protocol = f"ws://127.0.0.1:{server.get_port()}", f"viser-v{viser.__version__}"
        full = socket.create_connection(("127.0.0.1", server.get_port()))
        full.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        received: list[int] = []
        ended = threading.Event()

        def states() -> int:
            return sum(size > STATE_BYTES for size in received)

        def read() -> None:
            with connect(address, subprotocols=[protocol], max_size=None, compression=None) as client:
                while not ended.is_set():
                    try:
                        received.append(len(client.recv(timeout=0.2)))
                    except TimeoutError:
                        continue

        reader = threading.Thread(target=read)
        with connect(
            address, sock=full, subprotocols=[protocol], max_size=None, compression=None, max_queue=1
        ) as stuck:
            reader.start()
            try:
                longest = 0.0
                for _ in range(150):  # of 45 kB each, faster than browsers get them: the newest replaces the others
                    session.advance()
                    began = time.perf_counter()
                    page.show()
                    longest = max(longest, time.perf_counter() - began)
                quiet = time.monotonic()
                count = len(received)
                while time.monotonic() < quiet + 1.0:  # until the other browser has all that it will get of these
                    if len(received) != count:
                        quiet, count = time.monotonic(), len(received)
                    time.sleep(0.05)
                for _ in range(30):
                    before = states()
                    session.advance()
                    page.show()
                    until(lambda before=before: states() > before, "a picture does not reach the other browser")
            finally:
                ended.set()
                reader.join()
            late = 0
            with suppress(TimeoutError):
                while True:
                    late += len(stuck.recv(timeout=1.0)) > STATE_BYTES
            # What its connection keeps, and the newest: 1. The other one gets each of the last 30 at least, and so does
            # one that reads with a buffer of the usual size.
            assert late < states() / 2, "it was not held up at all"
        # A picture takes 3 ms; a wait for a full connection would end with the timeout of a ping, after 20 s.
        assert longest < 2.0
