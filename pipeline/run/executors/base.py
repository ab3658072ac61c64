"""The executor's protocol: it runs assignments somewhere and reports what becomes of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath, Resources, Task, TaskId
from pipeline.run.events import ExecutorEvent


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
        """The file that the attempt's output goes to."""
        return self.layout.log(self.task.id, self.attempt)


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
