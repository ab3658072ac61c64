"""What a submission makes sure of, and what a command leaves of a job that has ended, also by a killed runner."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import pipeline
from places import PROJECT

from pipeline.base.layout import JobLayout
from pipeline.queue.submitting import make_folder

SCENE = """
name = "small"
frames = 1
device = "cpu"

[[rigid]]
name = "ball"
kind = "dynamic"
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.3]
density = 500
"""
KILLED = """
import os, signal, sys
from pipeline.show.report import page
from render.temporary_folder import temporary_folder
def write_report(layouts, path):
    with temporary_folder("report"):
        os.kill(os.getpid(), signal.SIGKILL)
page.write_report = write_report
from pipeline.cli.main import main
main(sys.argv[1:])
"""


@pytest.mark.slow
@pytest.mark.parametrize("command", [["submit", "small"], ["resume", "small"]])
def test_what_a_runner_left_undone_that_was_killed_while_it_wrote_the_report_is_made_good(
    tmp_path, monkeypatch, command
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    Path("small.toml").write_text(SCENE)
    environment = {**os.environ, "TMPDIR": str(tmp_path / "temporary"), "PYTHONPATH": str(PROJECT)}
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, "submit", "small", "--until", "simulate"], env=environment, check=False
    )
    layout = JobLayout(tmp_path / "renders" / "small")
    assert killed.returncode == -signal.SIGKILL
    assert [each.name[:19] for each in (tmp_path / "temporary").iterdir()] == ["pipeline-tmp-report"]
    assert not layout.report.exists()
    until = ["--until", "simulate"] if command[0] == "submit" else []
    again = pipeline(*command, *until)
    assert (again.exit_code, again.stdout) == (0, "up to date: renders/small (until simulate)\n"), again.output
    assert [*(tmp_path / "temporary").iterdir()] == []
    assert "renders/small/report.html" in again.stderr
    assert layout.report.exists()
    assert "report" not in pipeline(*command, *until).stderr


def test_a_host_that_looks_at_the_same_moment_whether_the_folder_can_be_written_to_is_no_obstacle(
    tmp_path, monkeypatch
):
    touch = Path.touch

    def touched_and_removed(self: Path) -> None:
        touch(self)
        self.unlink()  # by the other host

    monkeypatch.setattr(Path, "touch", touched_and_removed)
    make_folder(JobLayout(tmp_path / "film"))
    assert [*(tmp_path / "film").iterdir()] == []
