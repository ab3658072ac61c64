"""The report as a browser shows it: one file with its film, versions and job file, and nothing from elsewhere."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from browser import needs_browser, open_page
from numbered_frames import commit, submitted
from PIL import Image

from pipeline.artifacts import committing
from pipeline.job.loading import load_job
from pipeline.layout import JobLayout
from pipeline.manifest import Manifest
from pipeline.parameter_set import ParameterSet
from pipeline.report import film
from pipeline.report.film import film_of
from pipeline.report.writing import write_report
from pipeline.task import ArtifactPath, Task, TaskId, TaskState
from render.movie import encode_segment
from render.parameters import MovieParameters

SIZE = (64, 36)
FRAMES = 6


def put(layout: JobLayout, artifact: str, stage: str, make) -> None:
    """Commit a file of a stage, and put it on record."""
    path = ArtifactPath(artifact)
    task = Task(
        TaskId(f"{stage}/{Path(artifact).stem}"), stage, (), (path,),
        ParameterSet.of(stage=stage, version=1, tools={"brush": "7.1"}),
    )  # fmt: skip
    with committing(layout, path, task=task, attempt=1, fingerprint="x", validate=lambda _: None) as new:
        make(new.path)
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan([task])
        attempt = manifest.start_attempt(task.id)
        manifest.record_artifact(new.receipt)
        manifest.finish_attempt(task.id, attempt, seconds=3.0)
        manifest.set_states({task.id: TaskState.SUCCEEDED})


def picture(frame: int):
    def make(path: Path) -> None:
        pixels = np.full((SIZE[1], SIZE[0], 3), (200, 40 + 30 * frame, 20), np.uint8)
        Image.fromarray(pixels).save(path, format="PNG")

    return make


@pytest.fixture
def layout(tmp_path: Path) -> JobLayout:
    """A job with pictures and a film; its file has a comment that looks like markup."""
    layout = submitted(tmp_path / "tank")
    with layout.job_file.open("a") as file:
        file.write(f'# <script src="https://example.org/x.js"></script>\n[render]\nresolution = {list(SIZE)}\n')
    for frame in range(FRAMES):
        commit(layout, frame, kinetic_energy=float(frame), potential_energy=2.0, momentum_x=0.1 * frame)
        put(layout, layout.picture(frame), "render", picture(frame))
    pictures = [layout.path(layout.picture(frame)) for frame in range(FRAMES)]
    parameters = MovieParameters()
    put(layout, "movie.mp4", "movie", lambda path: encode_segment(pictures, path, fps=60, parameters=parameters))
    return layout


def test_the_film_is_in_the_page_and_a_large_one_is_a_loop(layout, monkeypatch):
    job = load_job(layout.job_file)
    whole = film_of(layout, job)
    assert whole is not None
    assert (whole.mime, whole.content) == ("video/mp4", layout.film.read_bytes())
    monkeypatch.setattr(film, "MOST_BYTES", len(whole.content) - 1)
    loop = film_of(layout, job)
    assert loop is not None
    assert (loop.mime, loop.width, loop.height) == ("image/webp", *SIZE)
    assert "too large for this page" in loop.remark


def test_a_film_without_a_receipt_is_not_shown(layout):
    layout.receipt(ArtifactPath("movie.mp4")).unlink()
    assert film_of(layout, load_job(layout.job_file)) is None


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
