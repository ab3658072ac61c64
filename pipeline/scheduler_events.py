"""What the scheduler is told, what it says, and the policy it goes by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from pipeline.errors import PipelineError
from pipeline.task import ArtifactPath, FailureKind, Resources, Task, TaskId, TaskState


class InvalidTransitionError(PipelineError):
    """An event that cannot happen in the task's state; carries the states it went through."""

    def __init__(self, task_id: TaskId, event: str, history: Sequence[TaskState]) -> None:
        super().__init__(task_id, event, list(history))
        self.task_id, self.event, self.history = task_id, event, list(history)

    def __str__(self) -> str:
        return f"{self.task_id}: {self.event} cannot happen after {' -> '.join(self.history)}"


class JobOutcome(StrEnum):
    """How a run of the job ended."""

    SUCCEEDED = "succeeded"
    FAILED = "failed"
    TOO_MANY_FAILURES = "too many failures"
    DISK_FULL = "disk full"
    DRAINED = "drained"
    CANCELLED = "cancelled"


@dataclass(frozen=True, slots=True)
class Policy:
    """When to try again, and when to give up.

    Attributes:
        attempts: how often a task is tried when the machine is at fault.
        out_of_memory_attempts: the same, when memory ran out; every retry has the machine for itself.
        backoff_s: pause before the second attempt [s]; doubles with each further one.
        failure_share: a stage in which this share of the ended tasks failed stops the job ...
        failure_count: ... once this many of its tasks failed.
    """

    attempts: int = 3
    out_of_memory_attempts: int = 2
    backoff_s: float = 2.0
    failure_share: float = 0.25
    failure_count: int = 10


# --- events ---


@dataclass(frozen=True, slots=True)
class ArtifactCommitted:
    """A running task committed one of its outputs."""

    task_id: TaskId
    artifact: ArtifactPath


@dataclass(frozen=True, slots=True)
class TaskSucceeded:
    """A running task ended with all of its outputs committed."""

    task_id: TaskId


@dataclass(frozen=True, slots=True)
class TaskSkipped:
    """A started task turned out to need no run: its outputs have the fingerprint they should have."""

    task_id: TaskId


@dataclass(frozen=True, slots=True)
class TaskFailed:
    """A running task ended without success, at monotonic time `now` [s]."""

    task_id: TaskId
    kind: FailureKind
    now: float


@dataclass(frozen=True, slots=True)
class DrainRequested:
    """Start nothing more; long tasks checkpoint and stop, short ones finish."""


@dataclass(frozen=True, slots=True)
class CancelRequested:
    """End everything now."""


@dataclass(frozen=True, slots=True)
class Tick:
    """It is `now` [s] on the monotonic clock."""

    now: float


@dataclass(frozen=True, slots=True)
class CapacityUpdated:
    """Machines came or went: tasks may use this much together from now on; what runs goes on."""

    capacity: Resources


Event = (
    ArtifactCommitted
    | TaskSucceeded
    | TaskSkipped
    | TaskFailed
    | DrainRequested
    | CancelRequested
    | Tick
    | CapacityUpdated
)


# --- instructions ---


@dataclass(frozen=True, slots=True)
class Start:
    """Run this task now, on this many threads; `need` is taken for it."""

    task: Task
    threads: int
    need: Resources


@dataclass(frozen=True, slots=True)
class Stop:
    """Ask this running task to checkpoint and return."""

    task_id: TaskId


@dataclass(frozen=True, slots=True)
class Kill:
    """End this running task at once."""

    task_id: TaskId


@dataclass(frozen=True, slots=True)
class Finish:
    """Nothing is running and nothing will: the run is over."""

    outcome: JobOutcome


Instruction = Start | Stop | Kill | Finish
