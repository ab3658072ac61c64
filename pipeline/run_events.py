"""What a run tells those who watch it: the progress display, the log, `--json`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from pipeline.executors.base import Failed, TaskEvent
from pipeline.plan import Assessment
from pipeline.scheduler_events import JobOutcome
from pipeline.task import TaskId, TaskState


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


class Observer(Protocol):
    """Watches a run. Called from the run's own loop, so it should be quick, and must not raise."""

    def notify(self, event: RunEvent) -> None:
        """Something happened."""


class Observers:
    """Several observers; each is told everything, in order."""

    def __init__(self, *observers: Observer) -> None:
        self._observers = observers

    def notify(self, event: RunEvent) -> None:
        """Pass it on."""
        for observer in self._observers:
            observer.notify(event)


class SilentObserver:
    """Watches and says nothing."""

    def notify(self, event: RunEvent) -> None:
        """Take note of nothing."""
