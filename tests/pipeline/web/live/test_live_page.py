"""The page in a real browser: it draws, and what a mouse does there reaches the scene."""

import io
import math
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from browser import PATIENCE_S, needs_browser, open_page, until
from live_jobs import BALL_OVER_SHEET, served
from PIL import Image
from playwright.sync_api import Page

from pipeline.web.live.running import run
from pipeline.web.live.session import Session

LOOKED_AT = (
    BALL_OVER_SHEET.replace("counts = [17, 17]", "counts = [9, 9]")
    + """
[camera]
position = [0.0, -1.2, 1.3]
look_at = [0.0, 0.0, 0.62]
"""
)
BALL, PIN, SHEET = (0.0, 0.0), (0.0, 93.0), (-45.0, 55.0)
"""Where they are at the start, from the middle of a picture of 480 rows [pixels]."""


def play(address: str, session: Session, folder: Path) -> None:
    """What somebody does at the page."""
    with open_page(760, 480) as page:
        page.set_default_timeout(1e3 * PATIENCE_S)
        page.goto(address)
        page.get_by_text("paused").wait_for()
        canvas = page.locator("canvas").first
        box = canvas.bounding_box()
        middle = box["x"] + box["width"] / 2.0, box["y"] + box["height"] / 2.0

        def colors() -> int:
            pixels = np.asarray(Image.open(io.BytesIO(canvas.screenshot())).convert("RGB"))
            return len(np.unique(pixels.reshape(-1, 3), axis=0))

        until(lambda: colors() > 200, "nothing is drawn")
        assert session.is_paused
        page.get_by_role("button", name="Go on").click()
        until(lambda: session.world.frame > 2, "time stands still")
        page.get_by_role("button", name="Reset").click()
        page.get_by_role("button", name="Pause").click()
        until(lambda: session.is_paused, "it goes on")
        page.get_by_role("button", name="Reset").click()
        until(lambda: session.world.frame == 0, "it was not reset")

        def drag_up(place: tuple[float, float], *, kind: str, name: str) -> None:
            x, y = middle[0] + place[0], middle[1] + place[1]
            page.mouse.move(x, y)
            page.mouse.down()
            for share in np.linspace(0.0, 1.0, 8):
                page.mouse.move(x, y - 60.0 * share)
                time.sleep(0.05)
            until(
                lambda: [held[:2] for held in list(session.drags.held)] == [(kind, name)],
                f"{kind} {name} is not in hand",
            )

        for place, kind, name in ((SHEET, "cloth", "sheet"), (PIN, "pin", "0")):
            drag_up(place, kind=kind, name=name)
            page.mouse.up()
            until(lambda: not session.drags.held, "it is not let go")
        drag_up(BALL, kind="rigid", name="ball")
        page.get_by_role("button", name="Go on").focus()
        page.keyboard.press("Enter")
        until(lambda: session.world.solvers["rigid"].bodies.position[0, 2] > 0.68, "the ball does not follow")
        page.mouse.up()
        until(lambda: not session.drags.held, "the ball is not let go")

        before = session.values["cloth.sheet.stretch_stiffness"]
        page.get_by_role("slider").nth(2).focus()
        for _ in range(10):
            page.keyboard.press("ArrowLeft")
        until(lambda: session.values["cloth.sheet.stretch_stiffness"] < 0.8 * before, "the slider does nothing")
        type_a_stiffness(page, session)
        page.get_by_role("button", name="Save as job").click()
        until((folder / "drape-live.toml").exists, "nothing was saved")
        page.get_by_text("drape-live.toml").wait_for()
        page.get_by_role("button", name="Record").click()
        page.get_by_role("button", name="Stop recording").click()
        page.get_by_text("frames: pipeline submit").wait_for()
        assert len(list((folder / "renders" / "drape-take" / "cache").glob("*.h5"))) > 1

        page.get_by_role("button", name="Pause").click()
        page.get_by_role("button", name="Reset").click()
        until(lambda: session.world.frame == 0, "it was not reset")
        time.sleep(1.0)  # until the ball is seen where it was
        drag_up(BALL, kind="rigid", name="ball")  # and the browser is closed


def type_a_stiffness(page: Page, session: Session) -> None:
    """The field shows the value in its unit and takes one; no powers of ten are seen; what is no value is refused."""
    name, label = "cloth.sheet.bend_stiffness", "bend stiffness [N m]"
    field = page.locator("form").filter(has_text=label).get_by_role("textbox").first
    slider = page.locator("form").filter(has_text=label).get_by_role("slider")
    assert float(field.input_value()) == pytest.approx(session.values[name], rel=1e-5)
    page.wait_for_timeout(200.0)  # viser's page may drop what comes within 50 ms of another control's change
    field.fill("2.5e-4")
    field.press("Enter")
    until(lambda: session.values[name] == 2.5e-4, "the field does nothing")
    until(lambda: float(slider.get_attribute("aria-valuenow")) == pytest.approx(-3.6), "the slider stays")
    slider.focus()
    slider.press("ArrowRight")
    until(lambda: field.input_value() == "0.000263", "the field does not follow the slider")
    until(lambda: session.values[name] == 2.63e-4, "the slider does nothing")
    for refused in ("soft", "7", "nan"):
        page.wait_for_timeout(200.0)
        field.fill(refused)
        field.press("Enter")
        page.get_by_text(f"must lie between 1e-08 and 0.1, got {refused}").wait_for()
        until(lambda: field.input_value() == "0.000263", "a refused value stays in the field")
    shown = [float(box.input_value()) for box in page.get_by_role("textbox").all() if box.is_visible()]
    assert len(shown) > 8
    assert not [value for value in shown if value < 0.0 and value not in session.values["gravity"]]


@needs_browser
@pytest.mark.usefixtures("taichi")
def test_a_page_draws_and_takes_drags_buttons_and_sliders_to_the_scene(tmp_path):
    with served(tmp_path, LOOKED_AT, longest_frame_s=math.inf) as (session, page, server):
        with ThreadPoolExecutor(1) as browser:
            playing = browser.submit(play, f"http://127.0.0.1:{server.get_port()}", session, tmp_path)
            run(session, page, ends=playing.done)
            playing.result()
        gone = time.monotonic() + PATIENCE_S
        run(session, page, ends=lambda: not session.drags.held or time.monotonic() > gone)
        assert not session.drags.held
