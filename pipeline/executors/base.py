"""What an executor is: it runs assignments somewhere and reports what becomes of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from pipeline.layout import JobLayout
from pipeline.receipts import Receipt
from pipeline.task import ArtifactPath, FailureKind, Resources, Task, TaskId


@dataclass(frozen=True, slots=True)
class Assignment:
    """One attempt of a task, with all that a worker elsewhere needs to run it. Paths, never arrays.

    Attributes:
        task: what to do.
        attempt: number of this try; grows for ever, also across runs.
        fingerprint: what its outputs are committed under.
        inputs: hash of each input artifact, as it is now; goes into the receipts.
        threads: how many threads it may use.
        job_file: the job as submitted.
        root: the job's folder.
        stages: where the stages are, as `module:ATTRIBUTE`.
        timeout_s: longest time that the attempt may take [s], or None.
        stall_s: longest time that it may show no sign of life [s]; None: the executor's own limit.
        memory_bytes: most memory that its processes may hold together; None: the executor's own limit.
        need: what it occupies while it runs, for executors that choose among machines.
        gpu: which of its machine's GPUs it has for itself, counted from 0; None: none. The executor chooses.
    """

    task: Task
    attempt: int
    fingerprint: str
    inputs: Mapping[ArtifactPath, str]
    threads: int
    job_file: Path
    root: Path
    stages: str
    timeout_s: float | None = None
    stall_s: float | None = None
    memory_bytes: int | None = None
    need: Resources = field(default=Resources())
    gpu: int | None = None

    @property
    def layout(self) -> JobLayout:
        """The job's folder."""
        return JobLayout(self.root)

    @property
    def log(self) -> Path:
        """Where the attempt's output goes."""
        return self.layout.log(self.task.id, self.attempt)


@dataclass(frozen=True, slots=True)
class Started:
    """The attempt runs, in process `pid` of `host`."""

    task_id: TaskId
    attempt: int
    host: str
    pid: int


@dataclass(frozen=True, slots=True)
class Progress:
    """How far the attempt is: `done` of `total`, in units of the stage's choice.

    While `preparing`, it does what is done once on a machine, such as compiling: no limit of time counts that.
    """

    task_id: TaskId
    attempt: int
    done: float
    total: float
    message: str = ""
    preparing: bool = False


@dataclass(frozen=True, slots=True)
class Committed:
    """An output is in place, with its receipt beside it."""

    task_id: TaskId
    attempt: int
    receipt: Receipt


@dataclass(frozen=True, slots=True)
class Finished:
    """The attempt succeeded: all outputs are committed."""

    task_id: TaskId
    attempt: int
    seconds: float
    peak_memory_bytes: int


@dataclass(frozen=True, slots=True)
class Failed:
    """The attempt ended without success.

    Attributes:
        task_id: its task.
        attempt: its number.
        kind: whose fault it is.
        message: one line for the user.
        details: traceback, or the last lines of the log where the process could tell nothing any more.
        seconds: how long it ran [s].
        peak_memory_bytes: largest resident memory seen; 0 when unknown.
        full_place: what could not be written as its disk is full, "" where that is not known; it may lie outside the
            job's folder.
    """

    task_id: TaskId
    attempt: int
    kind: FailureKind
    message: str
    details: str = ""
    seconds: float = 0.0
    peak_memory_bytes: int = 0
    full_place: str = ""


@dataclass(frozen=True, slots=True)
class Warned:
    """The attempt goes on, but something is worth a look.

    Attributes:
        task_id: its task.
        attempt: its number.
        kind: what it is about, in a word: the same for all tasks that tell the same.
        message: a sentence for the user.
    """

    task_id: TaskId
    attempt: int
    kind: str
    message: str


TaskEvent = Started | Progress | Committed | Warned | Finished | Failed


@dataclass(frozen=True, slots=True)
class CapacityChanged:
    """Machines came or went: all that there are now offer this much together."""

    capacity: Resources


ExecutorEvent = TaskEvent | CapacityChanged


class ShutDownOnExit(ABC):
    """Lets a `with` block shut an executor down at its end."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.shutdown()

    @abstractmethod
    def shutdown(self) -> None:
        """End everything."""


class Executor(Protocol):
    """Runs assignments at once as they are submitted; when and how many is the scheduler's business.

    Of every submitted attempt exactly one `Finished` or `Failed` is reported, and nothing after it.
    """

    def submit(self, assignment: Assignment) -> None:
        """Run this attempt. No other attempt of the same task may be under way."""

    def wait(self, timeout_s: float) -> Sequence[ExecutorEvent]:
        """What happened; returns as soon as there is something, and empty after `timeout_s` [s]."""

    def cancel(self, task_id: TaskId, *, grace_s: float) -> None:
        """Ask a task to stop, and end it by force when it still runs after `grace_s` [s].

        It is then reported as Failed with CANCELLED, or as Finished when it was quicker.
        """

    def shutdown(self) -> None:
        """End everything, by force where need be. No process is left behind. May be called twice."""
