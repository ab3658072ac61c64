"""A submitted job whose frames were written by hand, with the diagnostics that a test wants."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.artifacts import Receipt, committing
from pipeline.cache import validate_frame, write_frame
from pipeline.layout import JobLayout
from pipeline.manifest import Manifest
from pipeline.parameter_set import ParameterSet
from pipeline.task import Task, TaskId
from sim.snapshots import Snapshot
from sim.world import FrameReport

JOB = """
name = "{name}"
frames = 30
[[fluid]]
name = "water"
[[fluid.block]]
shape = {{ type = "box", size = [0.3, 0.3, 0.3] }}
"""


def submitted(folder: Path, *, name: str = "tank") -> JobLayout:
    """A job without a single frame."""
    layout = JobLayout(folder)
    layout.root.mkdir(parents=True)
    layout.job_file.write_text(JOB.format(name=name))
    Manifest(layout.manifest).close()
    return layout


def commit(layout: JobLayout, frame: int, *, fingerprint: str = "f", **water: float) -> Receipt:
    """A frame with these diagnostics of a fluid, as the simulation commits it."""
    task = Task(
        TaskId("simulate"),
        "simulate",
        (),
        (layout.frame_cache(frame),),
        ParameterSet.of(stage="simulate", version=1, tools={}),
    )
    snapshot = Snapshot("fluid", {"position": np.zeros((2, 3), np.float32)}, {"particle_radius": 0.01})
    steps, dt = ({"water": 12}, {"water": 1.25e-3}) if frame else ({}, {})
    report = FrameReport(frame, frame / 60, steps, dt, {"water": water})
    with committing(
        layout, task.outputs[0], task=task, attempt=1, fingerprint=fingerprint, validate=validate_frame
    ) as new:
        write_frame(new.path, {"water": snapshot}, report, device="cpu")
    return new.receipt
