"""Temporary folders: gone at the end, after a kill at the next start, and never while their process lives."""

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from places import PROJECT

from render.temporary_folder import temporary_folder

HOLDER = """
from render.temporary_folder import temporary_folder
with temporary_folder("worker") as folder:
    (folder / "picture.png").write_bytes(b"half")
    print(folder, flush=True)
    input()
"""


@pytest.fixture(autouse=True)
def _places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


@pytest.fixture
def holder(tmp_path: Path):
    """A process that has a temporary folder, and the folder."""
    environment = {**os.environ, "TMPDIR": str(tmp_path), "PYTHONPATH": str(PROJECT)}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", HOLDER], env=environment, **pipes) as process:
        yield process, Path(process.stdout.readline().strip())
        process.kill()


def test_the_folder_of_a_killed_process_goes_when_the_next_is_made(holder, tmp_path):
    process, folder = holder
    with temporary_folder("still") as own:
        assert {folder, own} == {*tmp_path.iterdir()}  # its process lives
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert [*folder.iterdir()]
    with temporary_folder("still") as own:
        assert [*tmp_path.iterdir()] == [own]
    assert [*tmp_path.iterdir()] == []


def test_what_another_program_or_a_link_has_there_stays(tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "film").write_text("mine")
    (tmp_path / "pipeline-tmp-link").symlink_to(elsewhere)
    (tmp_path / "pipeline-tmp-file").write_text("mine")
    with temporary_folder("still"):
        pass
    assert (elsewhere / "film").read_text() == (tmp_path / "pipeline-tmp-file").read_text() == "mine"
    assert (tmp_path / "pipeline-tmp-link").is_symlink()


def test_where_folders_cannot_be_locked_none_is_taken_for_a_dead_ones(tmp_path, monkeypatch):
    def refuse(*_arguments: object) -> None:
        raise OSError("no locks here")

    monkeypatch.setattr("render.temporary_folder.fcntl.flock", refuse)
    with temporary_folder("worker") as first, temporary_folder("still") as second:
        assert {first, second} == {*tmp_path.iterdir()}
    assert [*tmp_path.iterdir()] == []
