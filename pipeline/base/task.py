"""Tasks, what the plan is made of: their resources, states, failures and limits of retries.

A *task* is one stage over one frame (or over the whole job, as for the simulation). It reads and writes *artifacts*,
files of the job's folder that are named by their path relative to it. Tasks depend on artifacts, not on tasks, so a
later stage starts on a frame as soon as that frame's inputs are committed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from json.encoder import encode_basestring_ascii as _quoted
from typing import NewType

from pipeline.base.parameter_set import ParameterSet, digest_of

TaskId = NewType("TaskId", str)
ArtifactPath = NewType("ArtifactPath", str)  # POSIX path relative to the job's folder


@dataclass(frozen=True, slots=True)
class Resources:
    """Resources of a task while it runs. `cores = 0` stands for all of the machine's."""

    cores: int = 1
    memory_bytes: int = 0
    gpus: int = 0

    def __add__(self, other: Resources) -> Resources:
        return Resources(self.cores + other.cores, self.memory_bytes + other.memory_bytes, self.gpus + other.gpus)

    def __sub__(self, other: Resources) -> Resources:
        return Resources(self.cores - other.cores, self.memory_bytes - other.memory_bytes, self.gpus - other.gpus)

    def fits(self, room: Resources) -> bool:
        """Whether they are within others in every respect."""
        return self.cores <= room.cores and self.memory_bytes <= room.memory_bytes and self.gpus <= room.gpus

    def at_least(self, other: Resources) -> Resources:
        """The more of each."""
        return Resources(
            max(self.cores, other.cores), max(self.memory_bytes, other.memory_bytes), max(self.gpus, other.gpus)
        )


@dataclass(frozen=True, slots=True)
class Task:
    """One unit of work, decided by `Stage.plan` from the job alone."""

    id: TaskId  # unique in the job, e.g. `render/000012`; safe as a relative path
    stage: str
    inputs: tuple[ArtifactPath, ...]
    outputs: tuple[ArtifactPath, ...]  # in the order in which it commits them
    parameters: ParameterSet  # what decides its outputs beside the inputs; shared by all tasks of stage and subject
    subject: str = ""  # the body that it is about
    frame: int | None = None  # None: the whole job
    resources: Resources = field(default=Resources())
    checkpointed: bool = False  # it commits its outputs one by one and continues where it stopped
    lowest_gpu: bool = False  # of several GPUs it is given the lowest that is free, others the highest


def task_fingerprint(task: Task, hashes: Mapping[ArtifactPath, str]) -> str:
    """Digest of everything that decides what a task's outputs hold: its parameters, and paths and hashes of its inputs.

    `hashes` are those of its inputs' contents, and maybe of more files. Raises KeyError if an input has none.
    """
    # As json.dumps(..., separators=(",", ":")) writes [digest, [[path, hash], ...]], in a third of its time.
    inputs = ",".join([f"[{_quoted(path)},{_quoted(hashes[path])}]" for path in task.inputs])
    return digest_of(f"[{_quoted(task.parameters.digest)},[{inputs}]]")


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
    GPU_ERROR = "GPU error"
    DISK_FULL = "disk full"
    CANCELLED = "cancelled"
    DIVERGED = "diverged"
    OUTGROWN = "outgrew memory"


@dataclass(frozen=True, slots=True)
class Policy:
    """Limits of retries and of failures."""

    attempts: int = 3  # how often a task is tried when the machine is at fault
    out_of_memory_attempts: int = 2  # the same, when memory ran out; every retry has the machine for itself
    backoff_s: float = 2.0  # pause before the second attempt [s]; doubles with each further one
    failure_share: float = 0.25  # a stage in which this share of the ended tasks failed stops the job ...
    failure_count: int = 10  # ... once this many of its tasks failed
