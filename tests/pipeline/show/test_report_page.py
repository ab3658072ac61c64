"""The report as a browser shows it: one file with its film, versions and job file, and nothing from elsewhere."""

import io
import socket
from dataclasses import replace
from pathlib import Path

import drawing_stages
import pytest
from browser import needs_browser, open_page
from drawn_films import draw_film
from numbered_frames import commit, submitted
from PIL import Image

from pipeline.base.errors import MissingInputError
from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath, Task
from pipeline.show.report import film
from pipeline.show.report.job_report import JobReport, gather
from pipeline.show.report.page import write_report
from pipeline.store.receipts import Receipt

SIZE = drawing_stages.SIZE
FRAMES = 6


@pytest.fixture
def layout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> JobLayout:
    """A job with pictures and a film; its file has a comment that looks like markup."""
    monkeypatch.setattr("pipeline.stages.STAGES", drawing_stages.STAGES)
    layout = submitted(tmp_path / "tank")
    text = layout.job_file.read_text().replace("frames = 30", f"frames = {FRAMES}\ngravity = [0.0, 0.0, -9.0]")
    text += f'# <script src="https://example.org/x.js"></script>\n[render]\nresolution = {list(SIZE)}\n'
    layout.job_file.write_text(text)
    for frame in range(FRAMES):
        commit(layout, frame, kinetic_energy=float(frame), potential_energy=2.0, momentum_x=0.1 * frame)
    draw_film(layout)
    return layout


def report_of(layout: JobLayout) -> JobReport:
    return gather(layout, title="tank")


def change(layout: JobLayout, old: str, new: str) -> None:
    """Submit another version of the job."""
    text = layout.job_file.read_text()
    assert old in text
    layout.job_file.write_text(text.replace(old, new))


def test_the_film_is_in_the_page_and_a_large_one_is_a_loop(layout, monkeypatch):
    whole = report_of(layout).film
    assert whole is not None
    assert (whole.mime, whole.content, whole.remark) == ("video/mp4", layout.film.read_bytes(), "")
    monkeypatch.setattr(film, "MOST_BYTES", len(whole.content) - 1)
    loop = report_of(layout).film
    assert loop is not None
    assert (loop.mime, loop.width, loop.height) == ("image/webp", *SIZE)
    assert "too large for this page" in loop.remark


def test_a_film_without_a_receipt_is_not_shown(layout):
    layout.receipt(ArtifactPath("movie.mp4")).unlink()
    assert report_of(layout).film is None


def test_a_film_and_frames_of_an_earlier_version_of_the_job_are_told_from_those_of_this_one(layout, monkeypatch):
    change(layout, "-9.0", "-20.0")
    old = report_of(layout)
    assert old.film is not None
    assert old.film.remark == "movie.mp4 is of an earlier version of the job."
    assert old.sheet is not None
    assert old.sheet_remark == "its frames are not as the job would be made now; what differs: render"
    # Pictures of another size: WebP does not take both into one loop.
    monkeypatch.setattr(drawing_stages, "SIZE", (120, 80))
    monkeypatch.setattr(film, "MOST_BYTES", 10)
    draw_film(layout, frames=2)
    new = report_of(layout)
    assert new.film is not None
    assert new.film.mime == "image/webp"
    assert "of an earlier version of the job" in new.film.remark
    with Image.open(io.BytesIO(new.film.content)) as loop:
        assert loop.n_frames <= 2
        red, green, _ = loop.convert("RGB").getpixel((40, 20))
    assert green > 150 > red
    assert new.sheet is not None
    assert new.sheet_remark == "4 frames are of an earlier version of the job, and not shown"
    write_report([layout], layout.report)
    assert new.sheet_remark in layout.report.read_text()


def test_a_report_whose_job_lacks_a_file_of_its_own_says_that_versions_cannot_be_told(layout, monkeypatch):
    def plan(*_: object) -> list[Task]:
        raise MissingInputError("the mesh duck.obj is not there")

    monkeypatch.setattr(drawing_stages.DrawStage, "plan", plan)
    report = report_of(layout)
    assert report.film is not None
    assert report.film.remark == "Whether movie.mp4 is of the job as it is now cannot be told."
    assert report.sheet is not None
    assert "duck.obj" in report.sheet_remark


def test_every_machine_is_told_with_the_files_that_it_made(layout):
    for frame in (1, 4):
        path = layout.receipt(layout.picture(frame))
        receipt = Receipt.from_json(path.read_text())
        path.write_text(replace(receipt, host="studio-3").to_json())
    drawn = {each.host: each.files for each in report_of(layout).versions if each.stage == "render"}
    assert drawn == {socket.gethostname(): 4, "studio-3": 2}


@needs_browser
def test_a_browser_shows_the_report_without_any_other_file(layout):
    write_report([layout], layout.report)
    requests: list[str] = []
    complaints: list[str] = []
    with open_page(900, 700) as browser:
        browser.set_default_timeout(90_000)
        browser.on("request", lambda request: requests.append(request.url))
        browser.on("console", lambda message: complaints.append(message.text))
        browser.on("pageerror", lambda error: complaints.append(str(error)))
        browser.goto(layout.report.as_uri())
        film_is_there = "() => { const film = document.querySelector('video'); return film && film.readyState >= 2; }"
        browser.wait_for_function(film_is_there)
        assert browser.evaluate("document.querySelector('video').videoWidth") == SIZE[0]
        assert browser.evaluate("document.querySelector('.sheet').naturalWidth") > 0
        assert browser.get_by_text("Where the time went").is_visible()
        browser.get_by_text("Versions", exact=True).click()
        assert browser.get_by_text("brush 7.1").first.is_visible()
        browser.get_by_text("Job file", exact=True).click()
        assert 'src="https://example.org/x.js"' in browser.locator("pre").inner_text()
        boxes = browser.evaluate(
            "[...document.querySelectorAll('figure')].map(each => each.getBoundingClientRect().width)"
        )
        assert min(boxes) > 300
        assert browser.evaluate("document.documentElement.scrollWidth") <= 900
    assert [url for url in requests if not url.startswith("data:")] == [layout.report.as_uri()]
    assert complaints == []
