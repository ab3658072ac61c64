"""The base of executors, which run assignments somewhere and report what becomes of them."""

import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath, Resources, Task, TaskId
from pipeline.model.limits import DEFAULT_STALL_S
from pipeline.run.events import ExecutorEvent


@dataclass(frozen=True, slots=True)
class Assignment:
    """One attempt of a task, with all that a worker elsewhere needs to run it. Paths, never arrays."""

    task: Task
    attempt: int  # number of this try; grows for ever, also across runs
    fingerprint: str  # what its outputs are committed under
    inputs: Mapping[ArtifactPath, str]  # hash of each input artifact, as it is now; goes into the receipts
    threads: int  # how many threads it may use
    job_file: Path  # the job as submitted
    root: Path
    stages: str  # where the stages are, as `module:ATTRIBUTE`
    timeout_s: float | None = None  # longest time that the attempt may take [s], or None
    stall_s: float = DEFAULT_STALL_S  # longest time that it may show no sign of life [s]
    memory_bytes: int | None = None  # most memory that its processes may hold together; None: the executor's own limit
    # what it occupies while it runs, for executors that choose among machines
    need: Resources = field(default=Resources())
    # which of its machine's GPUs it has for itself, counted from 0; None: none. The executor chooses
    gpu: int | None = None

    @property
    def layout(self) -> JobLayout:
        """The job's folder."""
        return JobLayout(self.root)

    @property
    def log(self) -> Path:
        """The file that the attempt's output goes to."""
        return self.layout.log(self.task.id, self.attempt)


class Executor(ABC):
    """Runs assignments at once as they are submitted; when and how many is the scheduler's business.

    Of every submitted attempt exactly one `Finished` or `Failed` is reported, and nothing after it. A context manager
    that shuts down at its end.
    """

    def __init__(self) -> None:
        self._events: list[ExecutorEvent] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()

    @abstractmethod
    def submit(self, assignment: Assignment) -> None:
        """Run this attempt. No other attempt of the same task may be under way."""

    def wait(self, timeout_s: float) -> list[ExecutorEvent]:
        """What happened since the last call; returns as soon as there is something, or empty after `timeout_s` [s]."""
        until = time.monotonic() + timeout_s
        while True:
            remaining = 0.0 if self._events else until - time.monotonic()
            self._turn(remaining)
            if self._events or remaining <= 0:
                break
        events, self._events = self._events, []
        return events

    @abstractmethod
    def _turn(self, timeout_s: float) -> None:
        """Wait for `timeout_s` [s] at most until something happens, and act on it; what there is to tell is kept."""

    @abstractmethod
    def cancel(self, task_id: TaskId, *, grace_s: float) -> None:
        """Ask a task to stop, and end it by force when it still runs after `grace_s` [s].

        It is then reported as Failed with CANCELLED, or as Finished when it was quicker.
        """

    @abstractmethod
    def shutdown(self) -> None:
        """End everything, by force where need be. No process is left behind. May be called twice."""
