"""The simulation as a task, run for real: which device its frames come from, and what a kill or a full disk leaves."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import killed_simulation
import pytest

from pipeline.artifacts import is_committed, sweep_parts
from pipeline.cache import read_frame, write_frame
from pipeline.executors.base import Failed, Finished, TaskEvent
from pipeline.layout import JobLayout
from pipeline.task import FailureKind
from sim import runtime

PROJECT = Path(__file__).resolve().parents[2]

JOB = """
name = "drop"
frames = {frames}

[[fluid]]
name = "water"
particle_radius = 0.04
[[fluid.block]]
shape = {{ type = "box", size = [0.3, 0.3, 0.3] }}
position = [0.0, 0.0, 0.3]
"""


def simulate(layout: JobLayout, *, frames: int, attempt: int = 1) -> TaskEvent:
    """Run the task of a job of so many frames until it ends; returns how it ended."""
    layout.root.mkdir(exist_ok=True)
    layout.job_file.write_text(JOB.format(frames=frames))
    return killed_simulation.simulate(layout, attempt=attempt)


@pytest.fixture
def layout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> JobLayout:
    monkeypatch.setattr("sim.runtime.available_devices", lambda: {"cpu": "ok"})
    return JobLayout(tmp_path / "drop")


def test_frames_of_two_devices_are_not_mixed(layout: JobLayout, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two frames from a machine with a GPU, whose checkpoint is gone, are continued on one without."""
    start = runtime.initialize
    with monkeypatch.context() as other_machine:
        # Only the name is another machine's: what it would compute is not what this is about.
        other_machine.setattr("sim.runtime.initialize", lambda device, **options: start(device, **options) and "cuda")
        assert isinstance(simulate(layout, frames=2), Finished)
    assert read_frame(layout.path(layout.frame_cache(1))).device == "cuda"
    shutil.rmtree(layout.checkpoints)
    ended = simulate(layout, frames=3)
    assert isinstance(ended, Failed)
    assert "this job was simulated on cuda so far, and this machine offers cpu" in ended.message
    assert not layout.path(layout.frame_cache(2)).exists()


def test_frames_of_the_same_device_are_continued_without_a_checkpoint(layout: JobLayout) -> None:
    assert isinstance(simulate(layout, frames=2), Finished)
    shutil.rmtree(layout.checkpoints)
    assert isinstance(simulate(layout, frames=3), Finished)
    assert read_frame(layout.path(layout.frame_cache(2))).device == "cpu"


def frames_of(layout: JobLayout, count: int) -> list[bytes]:
    return [layout.path(layout.frame_cache(frame)).read_bytes() for frame in range(count)]


@pytest.mark.parametrize("write", ["write_frame", "write_checkpoint"])
def test_killed_in_the_middle_of_a_write_it_continues_to_the_same_frames(layout: JobLayout, write: str) -> None:
    """Frames are written while later ones are computed: what is killed has computed more than it has written."""
    undisturbed = JobLayout(layout.root.with_name("undisturbed"))
    assert isinstance(simulate(undisturbed, frames=6), Finished)
    layout.root.mkdir()
    layout.job_file.write_text(JOB.format(frames=6))
    script = Path(killed_simulation.__file__)
    killed = subprocess.run(
        [sys.executable, script, layout.root, write, "3"],
        env={**os.environ, "PYTHONPATH": str(PROJECT)},
        timeout=120,
        check=False,
    )
    assert killed.returncode == -signal.SIGKILL
    committed = [frame for frame in range(6) if is_committed(layout, layout.frame_cache(frame), "f")]
    assert committed == ([0, 1, 2] if write == "write_frame" else [0, 1, 2, 3])
    # A checkpoint ahead of the frames would have to be thrown away, and the work before it be done again.
    assert sorted(path.name for path in layout.checkpoints.glob("[0-9]*.h5")) == ["000001.h5", "000002.h5"]
    sweep_parts(layout)
    assert isinstance(simulate(layout, frames=6, attempt=2), Finished)
    assert "starting at frame 2" in layout.log(killed_simulation.TASK, 2).read_text()
    assert frames_of(layout, 6) == frames_of(undisturbed, 6)


def test_a_disk_that_is_full_for_a_frame_is_told_as_such(layout: JobLayout, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill_up(path: Path, bodies, report, **options) -> None:
        if report.frame == 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write_frame(path, bodies, report, **options)

    with monkeypatch.context() as full_disk:
        full_disk.setattr("pipeline.stages.simulate.write_frame", fill_up)
        ended = simulate(layout, frames=6)
    assert isinstance(ended, Failed)
    assert ended.kind is FailureKind.DISK_FULL
    assert not list(layout.checkpoints.glob("*.h5"))  # it would be ahead of the frames
    assert isinstance(simulate(layout, frames=6, attempt=2), Finished)
