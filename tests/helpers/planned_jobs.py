"""Plans of jobs by the real stages, without any file."""

import json
from pathlib import Path
from typing import Any

from pipeline.base.layout import JobLayout
from pipeline.base.task import Task
from pipeline.model.job import Job
from pipeline.run.plan import plan_job
from pipeline.stages import STAGES

LAYOUT = JobLayout(Path("renders/tank"))


def planned(job: Job) -> dict[str, Task]:
    """The tasks of a job by their ids."""
    return {task.id: task for task in plan_job(job, LAYOUT, STAGES)}


def first_of(job: Job, stage: str) -> Task:
    """The first task of a stage."""
    return next(task for task in planned(job).values() if task.stage == stage)


def parameters_of(job: Job, stage: str) -> dict[str, Any]:
    """What decides the outputs of a stage's first task."""
    parameters: dict[str, Any] = json.loads(first_of(job, stage).parameters.canonical)
    return parameters


def digests(job: Job) -> dict[str, str]:
    """Digests of the parameters of each stage, of its last task."""
    return {task.stage: task.parameters.digest for task in planned(job).values()}


def concerned(before: Job, after: Job) -> set[str]:
    """The stages whose outputs a change decides."""
    old, new = digests(before), digests(after)
    return {stage for stage in old if old[stage] != new[stage]}
