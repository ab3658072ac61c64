"""`pipeline still --sheet`: frames of a job on one picture."""

from pathlib import Path

import drawing_stages
import pytest
from command_line import pipeline
from drawn_films import draw_film
from PIL import Image

from pipeline.base.layout import JobLayout
from pipeline.show.picture_set import evenly_spread

JOB = """
name = "film"
frames = 10
gravity = [0.0, 0.0, {gravity}]
[[rigid]]
name = "ball"
shape = {{ type = "sphere", radius = 0.1 }}
"""


@pytest.fixture
def job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A job's folder with ten frames, of which the last has no receipt: it is being written."""
    monkeypatch.setattr("pipeline.stages.STAGES", drawing_stages.STAGES)
    layout = JobLayout(tmp_path / "film")
    layout.root.mkdir()
    layout.job_file.write_text(JOB.format(gravity=-9.0))
    draw_film(layout, frames=9)
    layout.path(layout.picture(9)).write_bytes(layout.path(layout.picture(8)).read_bytes()[:50])
    return layout.root


def colors(sheet: Path) -> set[tuple[int, ...]]:
    with Image.open(sheet) as picture:
        return {color for _, color in picture.convert("RGB").getcolors(maxcolors=1 << 20)}


def test_a_sheet_shows_the_finished_frames(job):
    result = pipeline("still", "--sheet", job, "--pictures", "10", "--columns", "3")
    assert result.exit_code == 0, result.output
    shown = colors(job / "sheet.png")
    assert {(8 * frame, 90, 20) for frame in range(9)} <= shown
    assert (72, 90, 20) not in shown


def test_a_sheet_shows_frames_of_one_version_of_the_job_and_says_if_it_is_an_earlier_one(job):
    (job / "job.toml").write_text(JOB.format(gravity=-20.0))
    result = pipeline("still", "--sheet", job)
    assert result.exit_code == 0
    assert result.stderr == "film: its frames are not as the job would be made now; what differs: render\n"
    assert {(8 * frame, 90, 20) for frame in range(9)} <= colors(job / "sheet.png")
    draw_film(JobLayout(job), frames=2)
    result = pipeline("still", "--sheet", job)
    assert (result.exit_code, result.stderr) == (0, "")
    shown = colors(job / "sheet.png")
    assert {(0, 200, 20), (8, 200, 20)} <= shown
    assert not {(8 * frame, 90, 20) for frame in range(9)} & shown


def test_a_sheet_of_an_unknown_kind_is_refused(job):
    result = pipeline("still", "--sheet", job, "-o", job / "sheet.doc")
    assert result.exit_code == 1
    assert '".doc" is no kind of picture' in result.output


def test_a_job_without_frames_says_so(job):
    for picture in (job / "frames").iterdir():
        picture.unlink()
    result = pipeline("still", "--sheet", job)
    assert result.exit_code == 1
    assert "no frame of" in result.output


@pytest.mark.parametrize(("frames", "count"), [(10, 4), (10, 1), (3, 12), (60, 9)])
def test_frames_are_spread_evenly_from_first_to_last(frames, count):
    paths = [Path(str(number)) for number in range(frames)]
    chosen = evenly_spread(paths, count)
    assert len(chosen) == min(frames, count)
    assert chosen[-1] == paths[-1]
    assert len(set(chosen)) == len(chosen)
    if count > 1:
        assert chosen[0] == paths[0]
