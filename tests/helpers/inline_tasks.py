"""Runs one task of a job in this process, as a worker would."""

from collections.abc import Mapping
from types import MappingProxyType

from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath, Task
from pipeline.run.events import TaskEvent
from pipeline.run.executors.base import Assignment
from pipeline.run.executors.inline import InlineExecutor


def run_task(
    task: Task,
    layout: JobLayout,
    *,
    attempt: int = 1,
    threads: int = 1,
    fingerprint: str = "f",
    inputs: Mapping[ArtifactPath, str] = MappingProxyType({}),
    stages: str = "pipeline.stages:STAGES",
) -> TaskEvent:
    """Run a task of a real stage, whose inputs are there; returns how it ended."""
    assignment = Assignment(
        task=task,
        attempt=attempt,
        fingerprint=fingerprint,
        inputs=inputs,
        threads=threads,
        job_file=layout.job_file,
        root=layout.root,
        stages=stages,
    )
    with InlineExecutor() as executor:
        executor.submit(assignment)
        return executor.wait(0.0)[-1]
