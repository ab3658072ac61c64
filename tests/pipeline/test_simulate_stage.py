"""The simulation as a task, run for real in this process: which device its frames come from."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from pipeline.cache import read_frame
from pipeline.executors.base import Assignment, Failed, Finished, TaskEvent
from pipeline.executors.inline import InlineExecutor
from pipeline.job.loading import load_job
from pipeline.layout import JobLayout
from pipeline.stages.simulate import SimulateStage
from sim import runtime

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


def simulate(layout: JobLayout, *, frames: int) -> TaskEvent:
    """Run the task until it ends; returns how it ended."""
    layout.root.mkdir(exist_ok=True)
    layout.job_file.write_text(JOB.format(frames=frames))
    (task,) = SimulateStage().plan(load_job(layout.job_file), layout)
    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    assignment = Assignment(
        task=task,
        attempt=1,
        fingerprint="f",
        inputs={},
        threads=threads,  # as every other test of this process that starts Taichi
        job_file=layout.job_file,
        root=layout.root,
        stages="pipeline.stages:STAGES",
    )
    with InlineExecutor() as executor:
        executor.submit(assignment)
        return executor.wait(0.0)[-1]


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
