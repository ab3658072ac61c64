"""Tasks of the stages that turn one body of one cached frame into one file."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.parameter_set import ParameterSet
from pipeline.task import ArtifactPath, Resources, Task, TaskId


def tasks_of_bodies(
    stage: str,
    job: Job,
    layout: JobLayout,
    *,
    bodies: Iterable[tuple[str, Resources]],
    output: Callable[[str, int], ArtifactPath],
    parameters: ParameterSet,
) -> list[Task]:
    """One task a body and frame, each from that frame of the cache alone.

    Args:
        stage: the stage's name, which the tasks' ids begin with.
        job: the job, for its number of frames.
        layout: the job's folder.
        bodies: name of each body, and what a task of it takes.
        output: where the file of a body and frame goes.
        parameters: what decides the files besides the cache.
    """
    return [
        Task(
            id=TaskId(f"{stage}/{body}/{frame:06d}"),
            stage=stage,
            inputs=(layout.frame_cache(frame),),
            outputs=(output(body, frame),),
            parameters=parameters,
            subject=body,
            frame=frame,
            resources=resources,
        )
        for body, resources in bodies
        for frame in range(job.frame_count)
    ]
