"""Drawing a frame: by the warm renderer of this worker process, and once more if the picture fails the checks."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InvalidArtifactError
from pipeline.gpu_kernels import compiled_once
from pipeline.job.models import Job
from pipeline.parameter_set import digest_of
from pipeline.stages.base import TaskContext
from pipeline.stages.inputs import blender_version
from pipeline.stages.render_scene import framed_points, render_spec
from pipeline.stages.sight import BodyAtFrame, expected_cells
from render.camera_path import View

if TYPE_CHECKING:
    from render.blender import Renderer
    from render.pictures import PictureStatistics

STAGE_PIXELS = 96
"""Along the longer side of the empty stage that pictures are held against: half a percent of it is 25 pixels."""

WHITE_SHARE = 0.8
"""Of a picture that is white, from which it is warned of: 0.4 of a white studio in twice its light is."""

BAD_PICTURE = "bad picture"
NEARLY_WHITE = "nearly white"
NO_GPU = "no GPU"
CPU = "CPU"
"""What a renderer calls its device when it draws on none of the GPUs."""


def draw_until_good(context: TaskContext, paths: list[Path], view: View, bodies: Sequence[BodyAtFrame]) -> None:
    """Draw a frame, and once more if its picture fails the checks; a picture that fails again is kept.

    Args:
        context: of the frame's task.
        paths: of the picture, and of the EXR if the job asks for one.
        view: of the camera at the frame.
        bodies: what is to be seen.

    Raises:
        InvalidArtifactError: it failed again.
    """
    from render.errors import InvalidFileError

    frame = context.task.frame
    assert frame is not None
    for once_more in (True, False):
        try:
            _draw(context, frame, paths)
            statistics = _check_picture(context, frame, paths[0], view, bodies)
        except InvalidFileError as error:
            if once_more:
                close_renderers()  # what went wrong in it may stay so
                context.warn(BAD_PICTURE, f"frame {frame}: the picture {error.reason}; it is drawn once more")
                continue
            rejected = context.layout.rejected_picture(frame)
            rejected.parent.mkdir(exist_ok=True)
            shutil.copyfile(paths[0], rejected)
            raise InvalidArtifactError(
                f"frame {frame}: the picture {error.reason}; twice; it is kept as {rejected}"
            ) from error
        # What stands before white on purpose is no mistake, and light that was asked for is no failure of Blender's.
        if statistics.white_share > WHITE_SHARE and not may_be_empty(context.job):
            context.warn(
                NEARLY_WHITE,
                f"frame {frame}: {100 * statistics.white_share:.0f} % of the picture is white; see stage.strength, "
                "the power of [[light]] and render.exposure",
            )
        return


def _draw(context: TaskContext, frame: int, paths: list[Path]) -> None:
    """Draw a frame; the first one of this process on a GPU takes what compiling takes."""
    renderer = warm_renderer(context)
    if context.gpu is not None and renderer.device == CPU:
        context.warn(NO_GPU, f"frame {frame}: Cycles finds no GPU {context.gpu} any more; drawn on the processor")
    if renderer.device == CPU or renderer.device in _COMPILED:
        renderer.render(frame, *paths)
        return

    def tell(message: str) -> None:
        context.progress(0, 1, message, preparing=True)

    with compiled_once(renderer.device, blender_version(context.job.render.blender), tell):
        renderer.render(frame, *paths)
    _COMPILED.add(renderer.device)
    context.progress(0, 1)


def _check_picture(
    context: TaskContext, frame: int, path: Path, view: View, bodies: Sequence[BodyAtFrame]
) -> PictureStatistics:
    """What a picture looks like in numbers.

    Raises:
        InvalidFileError: it is damaged, black, of one colour, or shows the stage without its bodies.
    """
    from render.pictures import read_shown, require_more_than_stage, validate_picture

    job = context.job
    statistics = validate_picture(path, job.render.resolution, may_be_empty=may_be_empty(job))
    width, height = job.render.resolution
    scale = min(1.0, STAGE_PIXELS / max(width, height))
    columns, rows = max(4, round(scale * width)), max(4, round(scale * height))
    cells = expected_cells(job, view, bodies, (rows, columns))
    if cells is None:
        return statistics
    if job.placed_camera.moves or "still" not in _EMPTY_STAGE:
        with tempfile.TemporaryDirectory(prefix="stage-") as folder:
            picture = Path(folder) / "stage.png"
            warm_renderer(context).render_stage(frame, picture, resolution=(columns, rows))
            stage = read_shown(picture)
        if not job.placed_camera.moves:
            _EMPTY_STAGE["still"] = stage
    else:
        stage = _EMPTY_STAGE["still"]
    require_more_than_stage(path, stage, cells)
    return statistics


def may_be_empty(job: Job) -> bool:
    """Whether nothing is left of a picture where no body is."""
    return job.stage.background != "stage"


_WARM: dict[str, Renderer] = {}
"""The renderer of this worker process, by the digest of its specification, thread count and GPU; at most one."""


def warm_renderer(context: TaskContext) -> Renderer:
    """This process's renderer for a task, opened where the one that there is draws something else."""
    from render.blender import open_renderer

    spec = render_spec(context.job, context.layout, framed_points(context.job, context.layout))
    key = digest_of(f"{context.layout.root} {context.threads} {context.gpu} {spec.model_dump_json()}")
    if key not in _WARM:
        close_renderers()
        path = context.layout.root / "scene.json"
        part = context.layout.root / f".scene.json.part.{os.getpid()}"
        spec.write(part)
        part.replace(path)
        blender = context.job.render.blender
        _WARM[key] = open_renderer(path, threads=context.threads, blender=blender, gpu=context.gpu)
    return _WARM[key]


_COMPILED: set[str] = set()
"""The devices on which this process has drawn."""


_EMPTY_STAGE: dict[str, NDArray[np.uint8]] = {}
"""What the warm renderer draws without any body, (rows, columns, 3); kept for a camera that stands still."""


def close_renderers() -> None:
    """Let go of this process's renderer; idempotent."""
    for renderer in _WARM.values():
        renderer.close()
    _WARM.clear()
    _EMPTY_STAGE.clear()
