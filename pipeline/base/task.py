"""Tasks: what the plan is made of.

A *task* is one stage over one frame (or over the whole job, as for the simulation). It reads and writes *artifacts*,
files of the job's folder that are named by their path relative to it. Tasks depend on artifacts, not on tasks, so a
later stage starts on a frame as soon as that frame's inputs are committed.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import NewType

from pipeline.base.parameter_set import ParameterSet

TaskId = NewType("TaskId", str)
ArtifactPath = NewType("ArtifactPath", str)
"""POSIX path relative to the job's folder."""


@dataclass(frozen=True, slots=True)
class Resources:
    """Resources of a task while it runs. `cores = 0` stands for all of the machine's."""

    cores: int = 1
    memory_bytes: int = 0
    gpus: int = 0


@dataclass(frozen=True, slots=True)
class Task:
    """One unit of work, decided by `Stage.plan` from the job alone.

    Attributes:
        id: unique in the job, e.g. `render/000012`; safe as a relative path.
        stage: name of its stage.
        inputs: artifacts it reads.
        outputs: artifacts it commits, in order.
        parameters: everything else that decides its outputs; shared by all tasks of the stage and subject.
        subject: the body it is about, or "".
        frame: the frame it is about, or None for the whole job.
        resources: what it occupies.
        checkpointed: it commits its outputs one by one and continues where it stopped.
        on_first_gpu: if it needs a GPU, it computes on the machine's first one and cannot be given another.
    """

    id: TaskId
    stage: str
    inputs: tuple[ArtifactPath, ...]
    outputs: tuple[ArtifactPath, ...]
    parameters: ParameterSet
    subject: str = ""
    frame: int | None = None
    resources: Resources = field(default=Resources())
    checkpointed: bool = False
    on_first_gpu: bool = False


class TaskState(StrEnum):
    """State of a task."""

    PENDING = "pending"
    READY = "ready"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    UP_TO_DATE = "up to date"
    FAILED = "failed"
    UPSTREAM_FAILED = "upstream failed"
    CANCELLED = "cancelled"


class FailureKind(StrEnum):
    """Kind of failure of an attempt. The machine's faults are retried; the task's own are not."""

    FAILED = "failed"
    TIMED_OUT = "timed out"
    STALLED = "stalled"
    OUT_OF_MEMORY = "out of memory"
    WORKER_LOST = "worker lost"
    DISK_FULL = "disk full"
    CANCELLED = "cancelled"
    DIVERGED = "diverged"
