"""What a stage is, and what it gets to run a task with."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NamedTuple, Protocol, Self

from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath, Task
from pipeline.kinds.base import Work
from pipeline.model.job import Job


class TaskContext(Protocol):
    """What the worker hands to `Stage.run`: the job, and the only way to write an artifact."""

    job: Job
    layout: JobLayout
    task: Task
    attempt: int
    threads: int
    gpu: int | None  # which of the machine's GPUs the task has for itself, counted from 0; None: none
    fingerprint: str  # fingerprint of the task: what its artifacts are receipted with, and what a checkpoint must match

    def committing(
        self, artifact: ArtifactPath, validate: Callable[[Path], None], *, device: str = ""
    ) -> AbstractContextManager[Path]:
        """Yield the path to write to; on leaving, validate, fsync, rename and receipt it.

        `validate` decodes the file and raises InvalidArtifactError; `device` goes into the receipt: what computed it,
        if that decides its last bits. An exception inside the block removes the part.
        """

    def is_committed(self, artifact: ArtifactPath) -> bool:
        """Whether this artifact is there, whole, and of this task's fingerprint."""

    def progress(self, done: float, total: float, message: str = "", *, preparing: bool = False) -> None:
        """Tell how far the task is; also the sign of life that keeps it from counting as stalled.

        After a call with `preparing` no limit of time counts until the next one without.
        """

    def warn(self, kind: str, message: str) -> None:
        """Tell what is worth a look: in the log, on record, and the first of each kind (a word) while it runs."""

    def stop_requested(self) -> bool:
        """Whether the task should checkpoint and return."""


FILE_S = 0.04
"""Time of a small file: reading what it is made of, checking it, and its share of a worker's start [s]."""


class FileWork(NamedTuple):
    """What making a file of a stage takes on the reference machine of `pipeline.kinds.work`."""

    what: str = ""  # in a word, for what is learnt of it
    work: Work = Work()
    start_s: float = 0.0  # time before the first file [s]
    compiling_s: float = 0.0  # the same where it never ran before, for compiling [s]
    memory_bytes: float | None = None  # of a task; None: as it claims


class Stage(Protocol):
    """A stage of the pipeline: one file here, one line in STAGES."""

    name: str
    version: int  # raised when the same parameters and inputs give other outputs; part of the fingerprint
    about: str = ""  # what it makes, in a few words for people
    draws: bool = False  # whether it needs what the job says about pictures: camera, looks, lights
    on_demand: bool = False  # whether it is no part of the film, and planned only for who asks for it

    @abstractmethod
    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """The tasks of this stage. Pure."""

    def of_frames(self, frames: frozenset[int] | None) -> Self:  # noqa: ARG002
        """The stage for these frames alone; None: for all. One that does not choose is as it was."""
        return self

    def preflight(self, job: Job) -> list[str]:  # noqa: ARG002
        """Why this machine cannot run this stage of this job, a sentence each with a remedy; empty if it can."""
        return []

    def lighter(self, job: Job) -> str:  # noqa: ARG002
        """What of a job its tasks need less memory with, for people; empty if nobody can say."""
        return ""

    def work(self, job: Job, elements: Mapping[str, float], *, on_gpu: bool) -> FileWork:  # noqa: ARG002
        """What a file takes of a job with so many elements of each kind of body."""
        return FileWork()

    @abstractmethod
    def run(self, context: TaskContext) -> None:
        """Commit the task's outputs. Idempotent; shares no state with other tasks but warm caches."""
