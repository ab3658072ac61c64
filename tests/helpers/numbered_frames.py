"""A submitted job whose frames were written by hand, with the diagnostics that a test wants."""

from pathlib import Path

import numpy as np

from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import Task, TaskId
from pipeline.record.manifest import Manifest
from pipeline.store.artifacts import committing
from pipeline.store.cache import validate_frame, write_frame
from pipeline.store.receipts import Receipt
from render.point_clouds import PointCloud, validate_point_cloud, write_point_cloud
from sim.core.snapshots import Snapshot
from sim.core.world import FrameReport

JOB = """
name = "{name}"
frames = 30
[whitewater.water]
[[fluid]]
name = "water"
[[fluid.block]]
shape = {{ type = "box", size = [0.3, 0.3, 0.3] }}
"""


def submitted(folder: Path, *, name: str = "tank") -> JobLayout:
    """A job without a single frame, whose fluid has whitewater."""
    layout = JobLayout(folder)
    layout.root.mkdir(parents=True)
    layout.job_file.write_text(JOB.format(name=name))
    plan(layout, whitewater_task(layout, 0))
    return layout


def plan(layout: JobLayout, *tasks: Task) -> None:
    """Make these the job's tasks."""
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(tasks)


def whitewater_task(layout: JobLayout, frame: int, *, fluid: str = "water", **parameters: float) -> Task:
    """The task of a fluid's whitewater of one frame."""
    return Task(
        TaskId(f"whitewater/{fluid}/{frame:06d}"),
        "whitewater",
        (layout.frame_cache(frame),),
        (layout.whitewater(fluid, frame),),
        ParameterSet.of(stage="whitewater", version=1, tools={}, **parameters),
        subject=fluid,
        frame=frame,
    )


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


def commit_whitewater(
    layout: JobLayout,
    frame: int,
    cached: Receipt,
    *,
    points: int = 3,
    not_made: int = 0,
    fluid: str = "water",
    **parameters: float,
) -> Receipt:
    """The fluid's whitewater of a frame, as it is committed; `cached` is the receipt of that frame of the cache."""
    vectors, numbers = np.zeros((points, 3), np.float32), np.ones(points, np.float32)
    task = whitewater_task(layout, frame, fluid=fluid, **parameters)
    with committing(
        layout,
        task.outputs[0],
        task=task,
        attempt=1,
        fingerprint=f"w{frame}",
        validate=validate_point_cloud,
        inputs={cached.artifact: cached.hash},
    ) as new:
        cloud = PointCloud(vectors, vectors, numbers, numbers, np.zeros(points, np.uint8), not_made)
        write_point_cloud(new.path, cloud)
    return new.receipt
