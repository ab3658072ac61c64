"""Events of a run: one vocabulary for executors, scheduler, record and observers, and the scheduler's instructions.

What an attempt of a task reports goes from the executor through the record to the scheduler, and to the observers, as
the same object.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

from pipeline.base.task import FailureKind, Resources, Task, TaskId, TaskState
from pipeline.store.receipts import Receipt

if TYPE_CHECKING:
    from pipeline.run.plan import Assessment

# --- reported by attempts, through their executor ---


@dataclass(frozen=True, slots=True)
class _OfAttempt:
    task_id: TaskId
    attempt: int


@dataclass(frozen=True, slots=True)
class Started(_OfAttempt):
    """The attempt runs, in process `pid` of `host`."""

    host: str
    pid: int


@dataclass(frozen=True, slots=True)
class Progress(_OfAttempt):
    """How far the attempt is: `done` of `total`, in units of the stage's choice.

    While `preparing`, it does what is done once on a machine, such as compiling: no limit of time counts that.
    """

    done: float
    total: float
    message: str = ""
    preparing: bool = False


@dataclass(frozen=True, slots=True)
class Committed(_OfAttempt):
    """An output is in place, with its receipt beside it."""

    receipt: Receipt


@dataclass(frozen=True, slots=True)
class Warned(_OfAttempt):
    """The attempt goes on, but something is worth a look.

    All tasks that warn of the same have the same `kind`, a word or two; `message` is a sentence for the user.
    """

    kind: str
    message: str


@dataclass(frozen=True, slots=True)
class Finished(_OfAttempt):
    """The attempt succeeded: all outputs are committed."""

    seconds: float
    peak_memory_bytes: int


@dataclass(frozen=True, slots=True)
class Failed(_OfAttempt):
    """The attempt ended without success."""

    kind: FailureKind  # whose fault it is
    message: str  # one line for the user
    details: str = ""  # traceback, or the last lines of the log where the process could say nothing any more
    seconds: float = 0.0  # how long it ran [s]
    peak_memory_bytes: int = 0  # largest resident memory seen; 0 when unknown
    full_place: str = ""  # what could not be written as its disk is full, maybe outside the job's folder; "" if unknown


TaskEvent = Started | Progress | Committed | Warned | Finished | Failed


@dataclass(frozen=True, slots=True)
class CapacityChanged:
    """Machines came or went: all there are now offer this much together; what runs goes on."""

    capacity: Resources


@dataclass(frozen=True, slots=True)
class GpuWithdrawn:
    """A GPU of this machine failed a task, and no other task gets it in this run; comes before the task's failure."""

    left: int  # how many GPUs remain
    message: str  # one line for the user


ExecutorEvent = TaskEvent | CapacityChanged | GpuWithdrawn

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


SchedulerEvent = (
    Committed | Finished | Skipped | Failed | CapacityChanged | GpuWithdrawn | DrainRequested | CancelRequested | Tick
)

# --- instructions of the scheduler ---


class JobOutcome(StrEnum):
    """How a run of the job ended."""

    SUCCEEDED = "succeeded"
    FAILED = "failed"
    TOO_MANY_FAILURES = "too many failures"
    DISK_FULL = "disk full"
    NO_GPU = "no GPU left"
    OUTGROWN = "outgrew memory"
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
    """How a run ended."""

    kind: JobOutcome  # in one word
    ran: int = 0  # how many tasks succeeded in this run
    failures: tuple[Failed, ...] = ()  # the last failure of each task that failed for good, in order
    counts: dict[tuple[str, TaskState], int] = field(default_factory=dict)  # number of tasks by stage and state
    seconds: float = 0.0  # how long the run took [s]
    full_place: str = ""  # what a task could not write as its disk is full; "" where none says so

    @property
    def exit_code(self) -> int:
        """What a command that ran the job exits with; a PipelineError shares only that of a full disk."""
        return _EXIT_CODES[self.kind]


_EXIT_CODES = {
    JobOutcome.SUCCEEDED: 0,
    JobOutcome.FAILED: 5,
    JobOutcome.TOO_MANY_FAILURES: 6,
    JobOutcome.DISK_FULL: 7,
    JobOutcome.NO_GPU: 9,
    JobOutcome.OUTGROWN: 10,
    JobOutcome.DRAINED: 130,  # as shells report a program that Ctrl-C ended
    JobOutcome.CANCELLED: 130,
}


@dataclass(frozen=True, slots=True)
class RunEnded:
    """The run is over; nothing follows."""

    outcome: Outcome


RunEvent = RunStarted | StateChanged | TaskEvent | Notice | RunEnded

Observer = Callable[[RunEvent], None]
"""Gets every event of a run, in order. Called from the run's own loop, so it should be quick, and must not raise."""
