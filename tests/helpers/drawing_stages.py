"""A pipeline whose pictures are drawn by hand: frames -> film, with the real stage of films.

`drawing.json` in the job's folder says what happens meanwhile: `{"wait": 3, "fail": 5, "pause_s": 0.1}` lets frame 3
wait until there is a preview movie, of which it keeps a copy, `seen.mp4`, fails frame 5, and lets each take so long.
"""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from pipeline.base.files import make_folder
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import Task, TaskId
from pipeline.stages.base import Stage
from pipeline.stages.movie import MovieStage
from render.pictures import read_picture

if TYPE_CHECKING:
    from pipeline.base.layout import JobLayout
    from pipeline.model.job import Job
    from pipeline.stages.base import TaskContext

REFERENCE = "drawing_stages:STAGES"
WITH_CACHE = "drawing_stages:STAGES_WITH_CACHE"
SIZE = (96, 64)
PATIENCE_S = 60.0


class ComputeStage(Stage):
    """What pictures may be drawn of: a file a frame, that gravity decides, and a checkpoint."""

    name = "simulate"
    version = 1

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        outputs = tuple(layout.frame_cache(frame) for frame in range(job.frame_count))
        parameters = ParameterSet.of(stage=self.name, version=self.version, tools={}, gravity=job.gravity)
        return [Task(TaskId("simulate"), self.name, (), outputs, parameters, checkpointed=True)]

    def run(self, context: TaskContext) -> None:
        make_folder(context.layout.checkpoints, within=context.layout.root)
        (context.layout.checkpoints / "000000.h5").write_text("a state")
        for output in context.task.outputs:
            if not context.is_committed(output):
                with context.committing(output, Path.read_bytes) as path:
                    path.write_text(f"gravity {context.job.gravity}")


class DrawStage(Stage):
    """Plain pictures, brighter by eight levels a frame; their green is gravity's."""

    name = "render"
    version = 1

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        parameters = ParameterSet.of(stage=self.name, version=self.version, tools={"brush": "7.1"}, gravity=job.gravity)
        return [
            Task(
                id=TaskId(f"render/{frame:06d}"),
                stage=self.name,
                inputs=(),
                outputs=(layout.picture(frame),),
                parameters=parameters,
                frame=frame,
            )
            for frame in range(job.frame_count)
        ]

    def run(self, context: TaskContext) -> None:
        frame, layout = context.task.frame, context.layout
        orders = layout.root / "drawing.json"
        told = json.loads(orders.read_text()) if orders.exists() else {}
        time.sleep(told.get("pause_s", 0.0))
        if told.get("fail") == frame:
            raise ValueError("as it was told")
        if told.get("wait") == frame:
            until = time.monotonic() + PATIENCE_S
            while not layout.preview_movie.exists():
                assert time.monotonic() < until, "no preview movie"
                time.sleep(0.02)
            shutil.copy(layout.preview_movie, layout.root / "seen.mp4")
        with context.committing(context.task.outputs[0], read_picture) as path:
            color = (8 * frame % 256, int(-10 * context.job.gravity[2]), 20)
            Image.new("RGB", SIZE, color).save(path, format="PNG")


STAGES = (DrawStage(), MovieStage())
STAGES_WITH_CACHE = (ComputeStage(), *STAGES)
