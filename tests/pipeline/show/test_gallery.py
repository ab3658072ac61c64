"""The gallery tells what was submitted and drawn, not what the job file of today says, and keeps what is not drawn."""

import os
from dataclasses import replace
from pathlib import Path

import drawing_stages
import numpy as np
import pytest
from drawn_films import draw_film
from PIL import Image

from benchmarks import gallery
from benchmarks.gallery import main, section, sections_of, shot_of, spread_in_time, write_overview
from pipeline.base.layout import JobLayout
from pipeline.record.manifest import Manifest
from pipeline.store.receipts import read_receipt

SUBMITTED = """name = "ball"
frames = 4
[render]
resolution = [96, 64]
quality = "draft"
[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.1 }
"""
TODAY = "# A ball.\n" + SUBMITTED.replace("frames = 4", "frames = 90").replace("[96, 64]", "[1280, 720]").replace(
    'quality = "draft"', ""
)


@pytest.fixture
def job_file(tmp_path: Path) -> Path:
    path = tmp_path / "ball.toml"
    path.write_text(TODAY)
    return path


@pytest.fixture
def layout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> JobLayout:
    """The job with three of its four frames, of which each took three seconds and has a master beside it."""
    monkeypatch.setattr("pipeline.stages.STAGES", drawing_stages.STAGES)
    layout = JobLayout(tmp_path / "renders" / "ball")
    layout.root.mkdir(parents=True)
    layout.job_file.write_text(SUBMITTED)
    draw_film(layout, frames=3)
    with Manifest(layout.manifest) as manifest:
        for frame in range(3):
            receipt = read_receipt(layout, layout.picture(frame))
            assert receipt is not None
            manifest.record_artifact(replace(receipt, artifact=layout.master(frame)))
    return layout


def told(job_file: Path, layout: JobLayout) -> str:
    shot, _ = shot_of(job_file, layout)
    return section(shot, "an abacus")


def test_size_quality_and_times_are_those_of_what_was_drawn(job_file, layout):
    assert len(shot_of(job_file, layout)[1]) == 3
    assert "A ball." in told(job_file, layout)
    expected = "96x64, draft quality; 3 of 4 frames drawn, on an abacus. A frame took: render 3 s."
    assert expected in told(job_file, layout)


def test_a_record_that_was_made_anew_of_receipts_has_no_times_and_is_told(job_file, layout):
    receipts = [read_receipt(layout, layout.picture(frame)) for frame in range(3)]
    for file in layout.root.glob(f"{layout.manifest.name}*"):
        file.unlink()
    with Manifest(layout.manifest) as manifest:
        manifest.record_artifacts(receipts)
    assert "3 of 4 frames drawn, on an abacus.\n" in told(job_file, layout)


def still(layout: JobLayout, name: str, size: tuple[int, int]) -> Path:
    layout.stills.mkdir(exist_ok=True)
    Image.new("RGB", size, (90, 120, 150)).save(layout.stills / name)
    return layout.stills / name


def test_the_best_still_of_the_chosen_frame_is_shown_large_and_told(job_file, layout):
    still(layout, "000002-draft-192x128.png", (192, 128))
    best = still(layout, "000002-preview-192x128.png", (192, 128))
    still(layout, "000002-final-384x256-0a1b2c.png", (384, 256))  # with other keys
    still(layout, "000001-final-384x256.png", (384, 256))  # of another frame
    assert shot_of(job_file, layout)[0].hero.picture == best
    expected = "Large: frame 2, 192x128, preview quality. Below: 96x64, draft quality; 3 of 4 frames drawn"
    assert expected in told(job_file, layout)


def test_a_still_of_a_job_as_it_was_before_it_was_submitted_again_is_not_shown(job_file, layout):
    picture = still(layout, "000002-final-192x128.png", (192, 128))
    before = layout.job_file.stat().st_mtime - 60.0
    os.utime(picture, (before, before))
    assert shot_of(job_file, layout)[0].hero.picture == layout.path(layout.picture(2))


def test_jobs_that_are_not_drawn_keep_their_sections_and_pictures(job_file, layout, monkeypatch, tmp_path):
    for name in ("apple", "zebra", "lemon"):
        job_file.with_name(f"{name}.toml").write_text(TODAY.replace('"ball"', f'"{name}"'))
    docs = tmp_path / "docs"
    docs.mkdir()
    kept = {name: f"## {name}\nDrawn on a slide rule.\n" for name in ("zebra", "apple")}
    gone = {name: f"## {name}\nDrawn on sand.\n" for name in ("ball", "of a job that is no more")}
    (docs / "gallery.md").write_text("\n".join(["# Gallery\n", *kept.values(), *gone.values()]))
    monkeypatch.setattr(gallery, "JOBS", tmp_path)
    arguments = ["gallery", str(tmp_path / "renders"), "--machine", "an abacus", "-o", str(docs)]
    monkeypatch.setattr("sys.argv", arguments)
    main()
    sections = sections_of(docs / "gallery.md")
    assert list(sections) == ["apple", "ball", "zebra"]
    assert {name: sections[name] for name in kept} == kept
    assert sections["ball"] == told(job_file, layout)
    drawn = sorted(path.name for path in (docs / "images").iterdir())
    assert drawn == ["gallery-ball-sheet.webp", "gallery-ball.webp", "jobs.webp"]
    once = (docs / "gallery.md").read_text()
    main()
    assert (docs / "gallery.md").read_text() == once


def test_the_overview_shows_the_large_pictures_in_rows_of_four_by_the_order_of_their_names(tmp_path):
    colors = {
        "apple": (200, 0, 0),
        "ball": (0, 200, 0),
        "kite": (0, 0, 200),
        "lemon": (200, 200, 0),
        "sea": (0, 200, 200),
    }
    for name, color in colors.items():
        Image.new("RGB", (640, 360), color).save(tmp_path / f"gallery-{name}.webp")
    write_overview(list(colors), tmp_path)
    with Image.open(tmp_path / "jobs.webp") as picture:
        overview = np.asarray(picture.convert("RGB"), np.int16)
    height, width = overview.shape[:2]
    assert width == 1288
    middles = overview[height // 4 :: height // 2, width // 8 :: width // 4].reshape(8, 3)
    np.testing.assert_allclose(middles[:5], list(colors.values()), atol=12)
    assert middles[5:].max() < 30  # empty places are dark


def test_a_sheet_has_all_frames_that_are_there_if_they_are_few_and_else_those_next_to_even_steps():
    def pictures(frames: list[int]) -> list[Path]:
        return [Path(f"{frame:06d}.png") for frame in frames]

    few = pictures([0, 30, 44, 45, 46, 90])
    assert spread_in_time(few, 6) == few
    assert spread_in_time(pictures([0, 10, 29, 31, 44, 46, 61, 90]), 4) == pictures([0, 29, 61, 90])
