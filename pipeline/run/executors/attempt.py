"""One attempt of a task, the same in every executor: run the stage, commit through receipts, name the failure."""

from __future__ import annotations

import os
import platform
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.base.errors import PipelineError
from pipeline.base.memory import peak_memory_bytes, reset_peak_memory
from pipeline.base.task import ArtifactPath, FailureKind
from pipeline.run.events import Committed, Failed, Finished, Progress, Started, TaskEvent, Warned
from pipeline.run.executors.base import Assignment
from pipeline.run.executors.failures import classify, describe, full_place
from pipeline.store import artifacts, receipts

if TYPE_CHECKING:
    from pipeline.model.job import Job
    from pipeline.stages.base import Stage

STAGES_REFERENCE = "pipeline.stages:STAGES"
PROGRESS_INTERVAL_S = 0.2
"""Shortest time between two reports of progress [s]."""


def load_stages(reference: str) -> Sequence[Stage]:
    """The stages that a reference `module:ATTRIBUTE` names."""
    module, _, attribute = reference.partition(":")
    stages: Sequence[Stage] = getattr(import_module(module), attribute)
    return stages


class AttemptContext:
    """The context of a running task; implements `TaskContext`."""

    def __init__(
        self, assignment: Assignment, emit: Callable[[TaskEvent], None], stop_requested: Callable[[], bool]
    ) -> None:
        from pipeline.job.loading import load_job

        self.job: Job = load_job(assignment.job_file)
        self.layout = assignment.layout
        self.task = assignment.task
        self.attempt = assignment.attempt
        self.fingerprint = assignment.fingerprint
        self.threads = assignment.threads
        self.gpu = assignment.gpu
        self.committed: set[ArtifactPath] = set()
        self._inputs = assignment.inputs
        self._emit = emit
        self.stop_requested = stop_requested
        self._progress_told_at = 0.0
        self._preparing = False

    @contextmanager
    def committing(
        self, artifact: ArtifactPath, validate: Callable[[Path], None], *, device: str = ""
    ) -> Iterator[Path]:
        """Yield the path to write to; on leaving, validate, fsync, rename and receipt it, and tell the runner."""
        if artifact not in self.task.outputs:
            raise PipelineError(f"{self.task.id} commits {artifact}, which is not one of its outputs")
        with artifacts.committing(
            self.layout,
            artifact,
            task=self.task,
            attempt=self.attempt,
            fingerprint=self.fingerprint,
            validate=validate,
            inputs=self._inputs,
            device=device,
        ) as commit:
            yield commit.path
        if commit.kept_aside is not None:
            print(f"{artifact} had been edited by hand; the edited file is kept as {commit.kept_aside}", flush=True)
        self.committed.add(artifact)
        self._emit(Committed(self.task.id, self.attempt, commit.receipt))

    def is_committed(self, artifact: ArtifactPath) -> bool:
        """Whether this artifact is there, whole, and of this task's fingerprint."""
        return receipts.is_committed(self.layout, artifact, self.fingerprint)

    def progress(self, done: float, total: float, message: str = "", *, preparing: bool = False) -> None:
        """Tell how far the task is; too frequent calls are dropped, except the last one."""
        now = time.monotonic()
        steady = not (preparing or self._preparing)
        if done < total and steady and now - self._progress_told_at < PROGRESS_INTERVAL_S:
            return
        self._progress_told_at = now
        self._preparing = preparing
        self._emit(Progress(self.task.id, self.attempt, done, total, message, preparing))

    def warn(self, kind: str, message: str) -> None:
        """Tell what is worth a look, in the log and to the runner; the task goes on."""
        print(f"warning: {message}", flush=True)
        self._emit(Warned(self.task.id, self.attempt, kind, message))


def run_attempt(
    assignment: Assignment,
    emit: Callable[[TaskEvent], None],
    *,
    stop_requested: Callable[[], bool],
    prepare: Callable[[], None] = lambda: None,
) -> None:
    """Run one attempt from `Started` to `Finished` or `Failed`; whatever the stage raises becomes `Failed`.

    `prepare` is called first, under the same care, and opens the log. `emit` takes the events as they happen.
    """
    task, attempt = assignment.task, assignment.attempt
    began = time.monotonic()
    reset_peak_memory()
    emit(Started(task.id, attempt, platform.node(), os.getpid()))
    try:
        prepare()
        print(f"{task.id}, attempt {attempt}, on {platform.node()}, process {os.getpid()}", flush=True)
        context = AttemptContext(assignment, emit, stop_requested)
        _stage_of(assignment).run(context)
        missing = [
            artifact
            for artifact in task.outputs
            if artifact not in context.committed and not context.is_committed(artifact)
        ]
    except (Exception, SystemExit) as error:
        details = traceback.format_exc()
        with suppress(OSError):  # on a full disk the failure must get through, even if its traceback cannot
            print(details, end="", flush=True)
        kind, message, full = classify(error), describe(error), full_place(error)
    else:
        details = full = ""
        if not missing:
            emit(Finished(task.id, attempt, time.monotonic() - began, peak_memory_bytes()))
            return
        done = len(task.outputs) - len(missing)
        if stop_requested():
            kind, message = FailureKind.CANCELLED, f"stopped after {done} of {len(task.outputs)} outputs"
        else:
            kind, message = FailureKind.FAILED, f"the stage returned without committing {missing[0]}"
    emit(Failed(task.id, attempt, kind, message, details, time.monotonic() - began, peak_memory_bytes(), full))


def _stage_of(assignment: Assignment) -> Stage:
    for stage in load_stages(assignment.stages):
        if stage.name == assignment.task.stage:
            return stage
    raise PipelineError(f"{assignment.stages} has no stage {assignment.task.stage!r}")
