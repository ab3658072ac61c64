"""Spoiled job files are refused by a sentence: a short run of `python tests/helpers/fuzz_jobs.py`."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from fuzz_jobs import Watch, fuzz


@pytest.mark.parametrize(
    "change",
    [
        lambda path: path.write_text("x"),
        lambda path: os.close(os.open(path, os.O_WRONLY | os.O_CREAT)),
        lambda path: path.mkdir(),
        lambda path: path.parent.rename(path.parent.with_name("other")),
        lambda path: (path.parent / "there").unlink(),
    ],
)
def test_what_a_job_file_must_not_lead_to_is_seen(tmp_path: Path, change: Callable[[Path], object]) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "there").touch()
    watch = Watch()
    with watch.armed():
        (folder / "there").read_bytes()
        assert watch.seen == []
        change(folder / "new")
    assert len(watch.seen) == 1


@pytest.mark.slow
def test_spoiled_job_files_start_nothing_and_never_end_in_a_traceback(tmp_path: Path) -> None:
    report = fuzz(seed=20, count=60, folder=tmp_path)
    assert report.broken == []
    assert report.refused.total() > 30
    assert report.refused.total() + report.accepted == 60
