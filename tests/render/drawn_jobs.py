"""What the tests of moving bodies and cameras share: a red ball, and a frame of a job drawn by its render task."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from inline_tasks import run_task

from pipeline.cache import write_frame
from pipeline.executors.base import Finished
from pipeline.layout import JobLayout
from pipeline.stages import render as render_stage
from pipeline.task import Task
from render.parameters import MaterialParameters
from sim.snapshots import Snapshot
from sim.world import FrameReport

# Fully rough, so that no highlight hides the colour.
RED = MaterialParameters(look="plastic", color=(0.8, 0.02, 0.02), roughness=1.0)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


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
    render_stage._close_renderers()
    assert isinstance(ended, Finished), ended
    layout.path(layout.picture(frame)).rename(picture)
