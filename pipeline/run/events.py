"""Events of a run: one vocabulary for executors, scheduler, record and observers, and the scheduler's instructions.

What an attempt of a task reports goes from the executor through the record to the scheduler, and to the observers, as
the same object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

from pipeline.base.task import ArtifactPath, FailureKind, Resources, Task, TaskId, TaskState
from pipeline.store.receipts import Receipt

if TYPE_CHECKING:
    from pipeline.run.plan import Assessment

# --- reported by attempts, through their executor ---


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

    @property
    def artifact(self) -> ArtifactPath:
        """The output."""
        return self.receipt.artifact


@dataclass(frozen=True, slots=True)
class Warned:
    """The attempt goes on, but something is worth a look.

    Attributes:
        task_id: its task.
        attempt: its number.
        kind: what it is about, in a word: the same for all tasks that warn of the same.
        message: a sentence for the user.
    """

    task_id: TaskId
    attempt: int
    kind: str
    message: str


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
        details: traceback, or the last lines of the log where the process could say nothing any more.
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


TaskEvent = Started | Progress | Committed | Warned | Finished | Failed


@dataclass(frozen=True, slots=True)
class CapacityChanged:
    """Machines came or went: all there are now offer this much together; what runs goes on."""

    capacity: Resources


ExecutorEvent = TaskEvent | CapacityChanged

# --- added by the runner, for the scheduler ---


@dataclass(frozen=True, slots=True)
class Skipped:
    """A started task turned out to need no run: its outputs have the fingerprint they should have."""

    task_id: TaskId


@dataclass(frozen=True, slots=True)
class DrainRequested:
    """Start nothing more; long tasks checkpoint and stop, short ones finish."""


@dataclass(frozen=True, slots=True)
class CancelRequested:
    """End everything now."""


@dataclass(frozen=True, slots=True)
class Tick:
    """It is `now` [s] on the monotonic clock; the events that follow happen then."""

    now: float


SchedulerEvent = Committed | Finished | Skipped | Failed | CapacityChanged | DrainRequested | CancelRequested | Tick

# --- instructions of the scheduler ---


class JobOutcome(StrEnum):
    """How a run of the job ended."""

    SUCCEEDED = "succeeded"
    FAILED = "failed"
    TOO_MANY_FAILURES = "too many failures"
    DISK_FULL = "disk full"
    DRAINED = "drained"
    CANCELLED = "cancelled"


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

# --- added for those who watch a run ---


@dataclass(frozen=True, slots=True)
class RunStarted:
    """The plan stands, and work begins; `assessments` has every task, makers before users."""

    assessments: Sequence[Assessment]


@dataclass(frozen=True, slots=True)
class StateChanged:
    """A task went into another state."""

    task_id: TaskId
    stage: str
    state: TaskState


@dataclass(frozen=True, slots=True)
class Notice:
    """A sentence for the user."""

    message: str


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a run ended.

    Attributes:
        kind: in one word.
        ran: how many tasks succeeded in this run.
        failures: the last failure of each task that failed for good, in order.
        counts: number of tasks by stage and state.
        seconds: how long the run took [s].
        full_place: what a task could not write as its disk is full; "" where none says so.
    """

    kind: JobOutcome
    ran: int = 0
    failures: tuple[Failed, ...] = ()
    counts: dict[tuple[str, TaskState], int] = field(default_factory=dict)
    seconds: float = 0.0
    full_place: str = ""

    @property
    def exit_code(self) -> int:
        """What a command that ran the job exits with; a PipelineError shares only that of a full disk."""
        return _EXIT_CODES[self.kind]


_EXIT_CODES = {
    JobOutcome.SUCCEEDED: 0,
    JobOutcome.FAILED: 5,
    JobOutcome.TOO_MANY_FAILURES: 6,
    JobOutcome.DISK_FULL: 7,
    JobOutcome.DRAINED: 130,  # as shells report a program that Ctrl-C ended
    JobOutcome.CANCELLED: 130,
}


@dataclass(frozen=True, slots=True)
class RunEnded:
    """The run is over; nothing follows."""

    outcome: Outcome


RunEvent = RunStarted | StateChanged | TaskEvent | Notice | RunEnded
