"""What the tests of moving bodies and cameras share: a red ball that moves, and a frame of its job, drawn."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from blender_scenes import RED, sphere, write_mesh
from blender_stand_in import write_blender_stand_in
from inline_tasks import run_task
from numpy.typing import ArrayLike, NDArray

from pipeline.base.layout import JobLayout
from pipeline.base.task import Task
from pipeline.job.loading import load_job
from pipeline.model.job import Job
from pipeline.run.events import Finished
from pipeline.stages import render_drawing
from pipeline.store.cache import write_frame
from render.spec import MovingMeshObject
from sim.core.snapshots import Snapshot
from sim.core.world import FrameReport

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
BALL = MovingMeshObject(name="ball", file="ball.ply", body="ball", poses="poses/{frame}.json", material=RED)

JOB = """
name = "{name}"
frames = 3
[[rigid]]
name = "ball"
kind = "kinematic"
shape = {{ type = "sphere", radius = 0.1 }}
position = [-0.4, 0.0, 0.5]
velocity = [24.0, 0.0, 0.0]
[material.ball]
look = "plastic"
color = [0.8, 0.02, 0.02]
roughness = 1.0
[render]
resolution = [64, 36]
quality = "draft"
samples = 32
denoise = false
device = "cpu"
blender = '{blender}'
"""


def pose(
    position: ArrayLike = (0.0, 0.0, 0.5),
    orientation: ArrayLike = UPRIGHT,
    velocity: ArrayLike = (0.0, 0.0, 0.0),
    angular_velocity: ArrayLike = (0.0, 0.0, 0.0),
) -> dict[str, dict[str, NDArray[np.float64]]]:
    """Where the ball is and how it moves, at rest if nothing is said."""
    arrays = {
        "position": position,
        "orientation": orientation,
        "velocity": velocity,
        "angular_velocity": angular_velocity,
    }
    return {"ball": {key: np.array(value, dtype=np.float64) for key, value in arrays.items()}}


def job_of_the_ball(folder: Path, name: str, more: str) -> tuple[Job, JobLayout]:
    """A job in which the ball flies along x, with more tables in its file; the meshes of its bodies are there."""
    layout = JobLayout(folder / name)
    layout.root.mkdir()
    layout.job_file.write_text(JOB.format(name=name, blender=write_blender_stand_in(folder)) + more)
    job = load_job(layout.job_file)
    for body in job.rigid:
        write_mesh(layout.path(layout.body_mesh(body.name)), *sphere((0.0, 0.0, 0.0), 0.1))
    return job, layout


def draw_frame(task: Task, layout: JobLayout, frame: int, snapshots: Mapping[str, Snapshot], *, picture: Path) -> None:
    """Draw a frame of a job whose simulation left these snapshots.

    Args:
        task: the render task of the frame.
        layout: the job's folder, with its meshes.
        frame: its number.
        snapshots: what the frame's cache holds, by body.
        picture: where the picture goes.
    """
    cache = layout.path(layout.frame_cache(frame))
    cache.parent.mkdir()
    write_frame(cache, snapshots, FrameReport(frame, frame / 60, {}, {}, {}), device="cpu")
    ended = run_task(task, layout)
    render_drawing.close_renderers()
    assert isinstance(ended, Finished), ended
    layout.path(layout.picture(frame)).rename(picture)
