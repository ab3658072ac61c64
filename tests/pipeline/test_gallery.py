"""The gallery tells what was submitted and drawn, not what the job file of today says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drawing_stages
import pytest
from drawn_films import draw_film

from benchmarks.gallery import section, shot_of
from pipeline.layout import JobLayout
from pipeline.manifest import Manifest
from pipeline.receipts import read_receipt

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


def test_size_quality_and_times_are_those_of_what_was_drawn(job_file, layout):
    shot, pictures = shot_of(job_file, layout)
    assert len(pictures) == 3
    assert "A ball." in section(shot)
    assert "96x64, draft quality; 3 of 4 frames drawn. A frame took: render 3 s." in section(shot)


def test_a_record_that_was_made_anew_of_receipts_has_no_times_and_is_told(job_file, layout):
    receipts = [read_receipt(layout, layout.picture(frame)) for frame in range(3)]
    for file in layout.root.glob(f"{layout.manifest.name}*"):
        file.unlink()
    with Manifest(layout.manifest) as manifest:
        manifest.record_artifacts(receipts)
    assert "3 of 4 frames drawn.\n" in section(shot_of(job_file, layout)[0])
