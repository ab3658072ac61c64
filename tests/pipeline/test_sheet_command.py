"""`pipeline sheet`: frames of a job on one picture."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import pipeline
from PIL import Image

from pipeline.committed_pictures import evenly_spread


@pytest.fixture
def job(tmp_path: Path) -> Path:
    """A job's folder with ten frames, of which the last has no receipt: it is being written."""
    folder = tmp_path / "film"
    (folder / "frames").mkdir(parents=True)
    (folder / ".receipts" / "frames").mkdir(parents=True)
    (folder / "job.toml").write_text('name = "film"\n')
    (folder / "manifest.db").touch()
    for frame in range(10):
        Image.new("RGB", (32, 18), (20 * frame, 90, 60)).save(folder / "frames" / f"{frame:06d}.png")
        if frame < 9:
            (folder / ".receipts" / "frames" / f"{frame:06d}.png.json").write_text("{}")
    return folder


def test_a_sheet_shows_the_finished_frames(job):
    result = pipeline("sheet", job, "--pictures", "9", "--columns", "3")
    assert result.exit_code == 0, result.output
    with Image.open(job / "sheet.png") as sheet:
        colours = sheet.convert("RGB").getcolors(maxcolors=1 << 20)
    shown = {colour for _, colour in colours}
    # Reds of the frames: 0, 20, ... 160 are shown, 180 is the frame that has no receipt yet.
    assert {(20 * frame, 90, 60) for frame in range(9)} <= shown
    assert (180, 90, 60) not in shown


def test_a_sheet_of_an_unknown_kind_is_refused(job):
    result = pipeline("sheet", job, "--to", job / "sheet.doc")
    assert result.exit_code == 1
    assert '".doc" is no kind of picture' in result.output


def test_a_job_without_frames_says_so(job):
    for receipt in (job / ".receipts" / "frames").iterdir():
        receipt.unlink()
    result = pipeline("sheet", job)
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
