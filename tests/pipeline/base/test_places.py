"""What stands in the place of a job's files and folders is told before any work, with what to do."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.base.errors import PipelineError
from pipeline.base.layout import JobLayout
from pipeline.base.places import check_places, is_inside

PICTURES = [JobLayout.picture(frame) for frame in range(3)]


@pytest.mark.parametrize("path", ["/x", "..", "../x", "frames/../../x", "frames/..", "", "frames/\0"])
def test_paths_that_lead_elsewhere(path: str) -> None:
    assert not is_inside(path)


@pytest.mark.parametrize("path", ["movie.mp4", "frames/000001.png", "meshes/a..b.ply", "..a/b"])
def test_paths_that_lead_into_the_folder(path: str) -> None:
    assert is_inside(path)


def link(path: Path) -> None:
    path.symlink_to("/elsewhere")


@pytest.mark.parametrize(
    ("place", "put", "told"),
    [
        ("frames", Path.touch, "frames is a file, where the job must have a folder of its own: move it away"),
        ("frames", link, "frames is a link to /elsewhere, where the job must have a folder"),
        ("frames/000001.png", Path.mkdir, "frames/000001.png is a folder, where the job must have a file"),
        ("frames/000001.png", os.mkfifo, "frames/000001.png is no file, where"),
        (".receipts/frames/000001.png.json", Path.mkdir, "000001.png.json is a folder, where the job must have a file"),
        (".receipts/frames", Path.touch, ".receipts/frames is a file, where the job must have a folder"),
        ("cache", link, "cache is a link to /elsewhere"),
        ("manifest.db", Path.mkdir, "manifest.db is a folder, where the job must have a file"),
        ("job.toml", Path.mkdir, "job.toml is a folder"),
        ("runner.lease", link, "runner.lease is a link"),
    ],
)
def test_what_is_in_the_way_is_told(tmp_path: Path, place: str, put: Callable[[Path], None], told: str) -> None:
    layout = JobLayout(tmp_path)
    check_places(layout, PICTURES)
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    put(tmp_path / place)
    with pytest.raises(PipelineError) as refused:
        check_places(layout, PICTURES)
    (line,) = str(refused.value).splitlines()
    assert told in line


def test_only_the_first_of_many_are_told(tmp_path: Path) -> None:
    for picture in map(JobLayout.picture, range(9)):
        (tmp_path / picture).mkdir(parents=True)
    with pytest.raises(PipelineError) as refused:
        check_places(JobLayout(tmp_path), map(JobLayout.picture, range(9)))
    *told, last = str(refused.value).splitlines()
    assert (len(told), last) == (5, "and 4 more")
