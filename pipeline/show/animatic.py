"""Animatics: a job's whole film in plain pictures, in seconds, to see how it moves before it is rendered."""

from collections.abc import Callable
from pathlib import Path

from pipeline.base.errors import PipelineError
from pipeline.base.files import replacing
from pipeline.base.layout import JobLayout
from pipeline.base.task import Task
from pipeline.job.loading import LoadedJob
from pipeline.show.stills import Survey, scratch_folder, survey
from pipeline.stages.render_scene import framed_points, render_spec, write_motion
from render.blender import FrameRenderError
from render.movie import encode_segment, validate_movie
from render.parameters import MovieParameters
from render.temporary_folder import temporary_folder
from render.workbench import draw_frames

QUALITY = MovieParameters(crf=20, preset="veryfast")

RENDER = "render"


def drawable_frames(found: Survey) -> int:
    """How many frames, from the first on, can be drawn of what is there and of what can be made of it."""
    frames = {task.frame for task in found.todo if task.stage == RENDER}
    return next(frame for frame in range(len(frames) + 1) if frame not in frames)


def made_before(found: Survey, frames: int) -> list[Task]:
    """What is to be made before these frames are drawn, makers first."""
    return [task for task in found.todo if task.stage != RENDER and (task.frame is None or task.frame < frames)]


def make_animatic(
    loaded: LoadedJob,
    layout: JobLayout,
    frames: int,
    target: Path,
    *,
    threads: int,
    drawn: Callable[[int], None],
) -> None:
    """Draw the first frames of a job with Workbench and put them together to an MP4.

    The job has the resolution that the film is to have; its folder holds all that these frames are drawn of. `drawn` is
    called with each frame that is there. Raises PipelineError: a frame could not be drawn.
    """
    job = loaded.job
    found = survey(loaded, layout, range(frames))
    with scratch_folder(loaded, found, layout) as scratch, temporary_folder("animatic") as folder:
        spec = scratch.root / "scene.json"
        render_spec(job, scratch, framed_points(job, scratch)).model_copy(update={"engine": "workbench"}).write(spec)
        for frame in range(frames):
            write_motion(job, scratch, frame, attempt=1)
        try:
            pictures = draw_frames(
                spec, range(frames), folder, threads=threads, blender=job.render.blender, drawn=drawn
            )
        except FrameRenderError as error:
            raise PipelineError(str(error)) from error
        with replacing(target) as part:
            fps = job.movie.playback_fps or job.fps
            encode_segment(pictures, part, fps=fps, parameters=QUALITY, threads=threads)
            validate_movie(part, frames)
