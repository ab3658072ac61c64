"""Movie: pictures into segments, segments into the film."""

from collections.abc import Mapping
from functools import partial
from math import prod
from pathlib import Path

from pipeline.base.content import tool_version
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import Task, TaskId
from pipeline.kinds.base import Work
from pipeline.model.job import Job
from pipeline.stages.base import FileWork, Stage, TaskContext
from render.continuity import Continuity
from render.movie import SEGMENT_FRAMES, encode_segment, join_segments, missing_encoder, validate_movie

PIXEL_S = 25e-9
"""Time of encoding a pixel, and of reading its picture [s]."""


class MovieStage(Stage):
    """Segments of closed groups of pictures, joined without encoding again."""

    name = "movie"
    about = "the film"
    draws = True
    version = 2

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a segment, and one that joins them."""
        parameters = ParameterSet.of(
            stage=self.name,
            version=self.version,
            tools={"av": tool_version("av")},
            movie=job.movie.model_dump(exclude={"so_far"}) | {"crf": job.movie.rate_factor},
            fps=job.movie.playback_fps or job.fps,
        )
        starts = range(0, job.frame_count, SEGMENT_FRAMES)
        segments = [
            Task(
                id=TaskId(f"movie/segment-{index:04d}"),
                stage=self.name,
                inputs=tuple(
                    layout.picture(frame) for frame in range(start, min(start + SEGMENT_FRAMES, job.frame_count))
                ),
                outputs=(layout.segment(index, job.movie.suffix),),
                parameters=parameters,
                subject="segment",
                frame=start,
            )
            for index, start in enumerate(starts)
        ]
        film = Task(
            id=TaskId("movie/film"),
            stage=self.name,
            inputs=tuple(output for segment in segments for output in segment.outputs),
            outputs=(layout.movie(job.movie.suffix),),
            parameters=parameters,
        )
        return [*segments, film]

    def work(self, job: Job, elements: Mapping[str, float], *, on_gpu: bool) -> FileWork:  # noqa: ARG002
        """By the pixels of a segment and of the film."""
        return FileWork("film", Work(0.0, PIXEL_S * prod(job.render.resolution) * min(job.frame_count, SEGMENT_FRAMES)))

    def preflight(self, job: Job) -> list[str]:
        """An encoder that this build of FFmpeg lacks."""
        name = missing_encoder(job.movie.codec)
        if name is None:
            return []
        return [
            f'"{job.movie.codec}" needs the encoder {name}, which the FFmpeg of the package av lacks here; '
            "install its wheel (pip install --only-binary av av) or choose another codec"
        ]

    def run(self, context: TaskContext) -> None:
        """Encode one segment, or join them all."""
        task, job = context.task, context.job
        inputs = [context.layout.path(artifact) for artifact in task.inputs]
        if task.frame is not None:
            with context.committing(task.outputs[0], partial(validate_movie, frames=len(inputs))) as path:
                encode_segment(
                    inputs,
                    path,
                    fps=job.movie.playback_fps or job.fps,
                    parameters=job.movie,
                    threads=context.threads,
                )
            context.progress(1, 1)
            return
        film = Continuity()

        def validate(path: Path) -> None:
            validate_movie(path, job.frame_count, see=film.see)

        with context.committing(task.outputs[0], validate) as path:
            join_segments(inputs, path)
        for found in film.breaks():
            context.warn(f"{found.kind} in the film", f"{found}; look at it: {context.layout.picture(found.frame)}")
        context.progress(1, 1)
